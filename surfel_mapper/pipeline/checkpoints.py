# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Checkpoints of a map: saved every ``output.checkpoint_s``, and found again after a restart.

A checkpoint is a file as ~/save_map writes it. A complete one replaces the one before it at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import logging
from pathlib import Path
import time

from surfel_mapper.config import OutputConfig
from surfel_mapper.errors import FileFormatError, MapError
from surfel_mapper.files.atomic import make_directory
from surfel_mapper.pipeline.drops import described
from surfel_mapper.pipeline.mapper import Mapper
from surfel_mapper.pipeline.saved_state import CopiedMapper, layer_files, load_mapper

LATEST = 'latest'
"""Value of map.load: the newest map or checkpoint in output.directory."""

_log = logging.getLogger(__name__)


def at_once(write: Callable[[], Path]) -> Path:
    """Write a checkpoint in the calling thread."""
    return write()


class Checkpoints:
    """
    Saves the map of a mapper every ``output.checkpoint_s`` into ``output.directory``.

    Parameters
    ----------
    mapper : Mapper
        The mapper; its settings give the period and the directory.

    """

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._started_s = time.monotonic()
        self._version = mapper.map.version
        self._is_writing = False
        self._failure = ''

    @property
    def problem(self) -> str:
        """Why the last checkpoint failed, and the age of the last good one; empty if none did."""
        if not self._failure:
            return ''
        path, age = checkpoint_path(self._mapper.config.output), 'there is no good one'
        if path.is_file():
            age = f'the last good one is {time.time() - path.stat().st_mtime:.0f} s old'
        return f'checkpoints fail ({self._failure}); {age}'

    def save_if_due(self, run: Callable[[Callable[[], Path]], object] = at_once) -> Path | None:
        """
        Save the map if it has changed and the last checkpoint is old enough; return the file.

        Parameters
        ----------
        run : callable
            Called with the function that writes the files; another thread may call that.

        Raises
        ------
        FileFormatError, OSError
            If it cannot be written. The next attempt comes after ``output.checkpoint_s`` again.

        """
        mapper, now_s = self._mapper, time.monotonic()
        every_s = mapper.config.output.checkpoint_s
        is_due = every_s and now_s - self._started_s >= every_s and not self._is_writing
        if not is_due or mapper.map.version == self._version:
            return None
        return self.save(run)

    def save(self, run: Callable[[Callable[[], Path]], object] = at_once) -> Path:
        """Save the map now; see save_if_due."""
        self._started_s, version = time.monotonic(), self._mapper.map.version
        path = checkpoint_path(self._mapper.config.output)
        with self._reporting():
            make_directory(path.parent)
            for file in (path, *(file for file, _ in layer_files(path, self._mapper))):
                if file.is_symlink():
                    raise FileFormatError(f'{file}: a link, expected a file or none')
            copied = CopiedMapper(path, self._mapper)

        def write() -> Path:
            try:
                with self._reporting():
                    copied.write()
            finally:
                self._is_writing = False
            self._version, self._failure = version, ''
            return path

        self._is_writing = True
        run(write)
        return path

    @contextmanager
    def _reporting(self) -> Iterator[None]:
        """Keep the error of a with-block for ``problem``."""
        try:
            yield
        except Exception as error:  # MemoryError too
            self._failure = described(error)
            raise


def checkpoint_path(output: OutputConfig) -> Path:
    """Return the file of the checkpoints."""
    return Path(output.directory).expanduser().absolute() / f'{output.map_name}.checkpoint.npz'


def load_start(mapper: Mapper) -> None:
    """
    Give a mapper the map that ``map.load`` names, if any.

    A file is loaded without its window, so its surfels stay. ``latest`` continues with the newest
    map or checkpoint in ``output.directory`` and its window; a damaged one is skipped with a
    warning, and without any the map starts empty.

    Raises
    ------
    FileFormatError
        If the file cannot be read, or has another voxel size.
    MapError
        If the map has other columns than are configured.

    """
    config = mapper.config
    if config.map.load == LATEST:
        _load_latest(mapper)
    elif config.map.load:
        load_mapper(config.map.load, mapper, with_window=False)


def _load_latest(mapper: Mapper) -> None:
    checkpoint = checkpoint_path(mapper.config.output)
    saved = checkpoint.with_name(f'{mapper.config.output.map_name}.npz')
    paths = [path for path in (checkpoint, saved) if path.is_file()]
    paths.sort(key=lambda path: -path.stat().st_mtime_ns)
    for path in paths:
        try:
            load_mapper(path, mapper)
        except (FileFormatError, MapError, OSError, MemoryError) as error:
            _log.warning('map.load latest: %s; an older one is tried', error or repr(error))
            continue
        _log.info('map.load latest: starts from %s, digest %s', path, mapper.map.digest())
        return
    _log.warning('map.load latest: no map in %s, starts with an empty one', saved.parent)
