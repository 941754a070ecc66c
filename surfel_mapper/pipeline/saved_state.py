# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Saving and loading of a mapper: its map with the window, and the layers that keep a state.

A layer's file lies beside that of the map and has the layer's name in its own: ``map.npz`` and
``map.tsdf.npz``. It is written first, so that a map that is there has its layers; it stands alone
because a map is often wanted without its layers, which are larger.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import logging
from pathlib import Path

from surfel_mapper.files import parquet
from surfel_mapper.files.cloud_map import is_cloud, read_cloud_map
from surfel_mapper.files.latest_map import map_in, RESTORABLE
from surfel_mapper.files.map_state import FILE, load_map, save_map
from surfel_mapper.files.parquet_tiles import read_tiles
from surfel_mapper.layers import Layer
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import WindowedScan
from surfel_mapper.pipeline.mapper import Mapper

_log = logging.getLogger(__name__)


def save_mapper(path: Path, mapper: Mapper, *, with_window: bool = True) -> str:
    """
    Write map, window and layers of a mapper; return the digest of the map.

    A layer that is switched off may be inconsistent: its file is not written, and an older one is
    removed, since it belongs to another map.

    Parameters
    ----------
    path : Path
        The file of the map, with the extension npz.
    mapper : Mapper
        The mapper.
    with_window : bool
        With the scans that can leave; otherwise all surfels stay for good.

    Raises
    ------
    FileFormatError
        If a file cannot be written.

    """
    for write in layer_writers(path, mapper):
        write()
    return save_map(path, mapper.map, mapper.window if with_window else ())


class CopiedMapper:
    """
    Map, window and layers of a mapper at one moment, which any thread may write.

    Parameters
    ----------
    path : Path
        The file of the map, with the extension npz.
    mapper : Mapper
        The mapper; see save_mapper.

    """

    def __init__(self, path: Path, mapper: Mapper) -> None:
        self._path = path
        self._writers = layer_writers(path, mapper)
        self._moments = mapper.map.moments()
        self._window = list(mapper.window)
        self._empty = mapper.map.emptied()

    def map(self) -> SurfelMap:
        """Return the map."""
        if not self._empty.num_voxels:
            self._empty.insert(self._moments)
        return self._empty

    def write(self) -> str:
        """Write the files; see save_mapper."""
        for write in self._writers:
            write()
        return save_map(self._path, self.map(), self._window)


def layer_writers(path: Path, mapper: Mapper) -> list[Callable[[], object]]:
    """Return functions that write copies of layers; layers that cannot copy are written now."""
    writers: list[Callable[[], object]] = []
    for file, layer in layer_files(path, mapper):
        reason = mapper.counters.layers_off.get(layer.name)
        if reason is not None:
            file.unlink(missing_ok=True)
            _log.warning('%s: not written: layer %s is off: %s', file, layer.name, reason)
        elif (write := layer.save(file)) is not None:
            writers.append(write)
    return writers


def load_mapper(
    path: str | Path, mapper: Mapper, *, with_window: bool = True, any_voxel_size: bool = False
) -> int:
    """
    Replace map, window and layers by saved ones; return the number of scans in the window.

    Layers whose file is missing start empty. After an error nothing has changed.

    Parameters
    ----------
    path : str or Path
        As of load_map; or a dataset of tiles, map.parquet or a cloud of points, which have no
        window and no layers.
    mapper : Mapper
        Takes them.
    with_window : bool
        With the scans that can leave.
    any_voxel_size : bool
        Leave it to the mapper to refuse another voxel size.

    Raises
    ------
    FileFormatError
        If a file cannot be read, is damaged or was written with other settings.
    MapError
        If the map has other columns than are configured.

    """
    size_m = None if any_voxel_size else mapper.config.map.voxel_size_m
    path = Path(path)
    if path.is_dir():
        path = map_in(path, RESTORABLE) or path / FILE
    scans: list[WindowedScan] = []
    restores = []
    if path.is_dir():  # tiles: layers beside them are of the file of an earlier run
        surfel_map = read_tiles(path, voxel_size_m=size_m)
    elif path.suffix.lower() == '.parquet':
        surfel_map = parquet.read_map(path, voxel_size_m=size_m)
    elif is_cloud(path):
        surfel_map = read_cloud_map(path, mapper.config.map.voxel_size_m)
    else:
        surfel_map, scans = load_map(path, voxel_size_m=size_m)
        restores = [layer.load(file) for file, layer in layer_files(path, mapper) if file.exists()]
    scans = scans if with_window else []
    mapper.restore(surfel_map, scans)
    for restore in restores:
        restore()
    return len(scans)


def layer_files(path: Path, mapper: Mapper) -> Iterator[tuple[Path, Layer]]:
    """Yield the layers that keep a state, and the file of each beside that of the map."""
    for name, layer in mapper.layers.items():
        if type(layer).save is not Layer.save:
            yield path.with_suffix(f'.{name}.npz'), layer
