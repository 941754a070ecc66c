# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Saving and loading the map inside ``output.directory``, and nowhere else.

Otherwise any client of the node's services could write, or probe for, any file of its user.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from urllib.parse import unquote, urlsplit

from surfel_mapper.config import OutputConfig
from surfel_mapper.errors import ConfigError, counted
from surfel_mapper.files.atomic import make_directory
from surfel_mapper.files.ply import write_surfels
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.saved_state import CopiedMapper, layer_files, load_mapper
from surfel_mapper.ros.mapping_thread import MappingThread

MAX_PATH = 4096
"""Characters of a path, as many as Linux takes; resolving one takes 20 us a component."""


class MapWriter:
    """
    Writes copies of the map in a thread of its own, while scans are mapped.

    Parameters
    ----------
    mapper : Mapper
        The mapper.
    thread : MappingThread
        Copies the map between two scans.

    """

    def __init__(self, mapper: Mapper, thread: MappingThread) -> None:
        self._mapper = mapper
        self._thread = thread
        self._executor = ThreadPoolExecutor(1, 'writer')
        self._latest: Future[str] | None = None

    def save(self) -> Future[str]:
        """
        Write the map as it is after the clouds received so far; see copied_map.

        Equal requests are one: a save that has not begun is returned again.
        """
        latest = self._latest
        if latest is None or latest.running() or latest.done():
            latest = self._latest = self._executor.submit(self._save)
        return latest

    def _save(self) -> str:
        return self._thread.call(partial(copied_map, self._mapper)).result()()

    def write(self, function: Callable[[], object], done: Callable[[], object]) -> None:
        """Call a function that writes, then ``done`` in the mapping thread; count errors."""
        self._executor.submit(self._guarded, function, done)

    def _guarded(self, function: Callable[[], object], done: Callable[[], object]) -> None:
        try:
            function()
        except Exception as error:  # MemoryError too
            self._thread.report_failure('a checkpoint', error)
        else:
            self._thread.post(done)

    def close(self) -> None:
        """Wait for the files being written, after the mapping thread has ended."""
        self._executor.shutdown()


def save_map(mapper: Mapper) -> str:
    """Write the map to ``output.directory`` now; see copied_map."""
    return copied_map(mapper)()


def copied_map(mapper: Mapper) -> Callable[[], str]:
    """
    Copy the map; return the function that writes it to ``output.directory``, for any thread.

    ``output.map_name``.ply has the surfels in ``frames.fixed``, for other programs;
    ``output.map_name``.npz the exact map and its window, from which mapping can continue; layers
    that keep a state, as the distance field does, have a file each beside it. The function returns
    a sentence that states path, sizes and digest.

    Raises
    ------
    ConfigError
        If a file of that name is a link that leads out of the directory.
    FileFormatError, OSError
        If the file or its directory cannot be written.

    """
    output = mapper.config.output
    directory = directory_of(output)
    make_directory(directory)
    path = directory / f'{output.map_name}.ply'
    state = path.with_suffix('.npz')
    beside = [file for file, _ in layer_files(state, mapper)]
    for file in (path, state, *beside):
        if not is_inside(directory, file):
            raise ConfigError(f'{file}: a link that leads out of output.directory, {directory}')
    copied = CopiedMapper(state, mapper)
    min_points, is_adaptive = mapper.config.map.min_points, mapper.config.publish.adaptive
    scans = f'{counted(len(mapper.window), "scan")} ({mapper.counters.received} received)'
    layers = ''.join(f', {file.name}' for file in beside)

    def write() -> str:
        surfel_map = copied.map()
        surfels = (surfel_map.adaptive if is_adaptive else surfel_map.surfels)(min_points)
        write_surfels(path, surfels, surfel_map.origin_m)
        digest = copied.write()
        content = f'{counted(len(surfels), "surfel")} of {scans}, digest {digest}'
        return f'{path} and .npz{layers}: {content}'

    return write


def load_map(mapper: Mapper, url: str) -> str:
    """
    Replace the map by one that ``save_map`` wrote; return a sentence that states path and digest.

    After an error the map is unchanged.

    Parameters
    ----------
    mapper : Mapper
        Its map and window are replaced; later scans are added.
    url : str
        A file in ``output.directory``, relative to it or in full, as a path or a file: URL, with
        or without the extension; empty: ``output.map_name``.

    Raises
    ------
    ConfigError
        If it is not in the directory.
    FileNotFoundError
        If there is no such file.
    FileFormatError
        If it cannot be read, is damaged, or is not a map.
    MapError
        If it has another voxel size or other columns than this mapper.

    """
    output = mapper.config.output
    path = path_inside(directory_of(output), url or output.map_name)
    if not path.exists():
        raise FileNotFoundError(f'{path}: no such file; ~/save_map writes one')
    num_scans = load_mapper(path, mapper, any_voxel_size=True)
    surfels = mapper.map.surfels(mapper.config.map.min_points)
    return (
        f'loaded {path}: {counted(len(surfels), "surfel")} of {counted(num_scans, "scan")}, '
        f'digest {mapper.map.digest()}'
    )


def directory_of(output: OutputConfig) -> Path:
    """Return the full path of the directory of maps."""
    return Path(output.directory).expanduser().absolute()


def path_inside(directory: Path, url: str) -> Path:
    """Return the full path of a map in a directory; raise ConfigError if it is outside."""
    if len(url) > MAX_PATH:
        raise ConfigError(f'map_url: {len(url)} characters, expected {MAX_PATH} at most')
    try:
        address = urlsplit(url)
    except ValueError as error:
        raise ConfigError(f'map_url: {url!r}: {error}') from error
    if address.scheme not in ('', 'file') or address.netloc or '\0' in url:
        raise ConfigError(f'map_url: {url!r}, expected a file in output.directory, {directory}')
    wanted = unquote(address.path) if address.scheme else url
    path = directory / wanted
    if not path.name:
        raise ConfigError(f'map_url: {url!r}, expected the name of a map in {directory}')
    if path.suffix != '.npz':
        path = path.with_name(f'{path.name}.npz')
    if not is_inside(directory, path):
        raise ConfigError(f'map_url: {url!r} is not inside output.directory, {directory}')
    return path


def is_inside(directory: Path, path: Path) -> bool:
    """Return whether a path is inside a directory, after resolving links and ``..``."""
    if len(str(path)) > MAX_PATH:
        return False
    try:
        with suppress(FileNotFoundError, NotADirectoryError):
            path.resolve(strict=True)  # fails at a link that leads to itself
        return path.resolve().is_relative_to(directory.resolve())
    except (OSError, RuntimeError):  # the latter before Python 3.13
        return False
