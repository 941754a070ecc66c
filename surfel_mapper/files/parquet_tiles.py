# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A map as a Parquet dataset of tiles, which other programs read in parts.

A tile is a column of 256 x 256 voxels in i and j: 128 m at 0.5 m. Its file has the format of
write_map, so read_map reads it, and all tiles together are a dataset partitioned by tile:
``tile_i=3/tile_j=-2/surfels.parquet``.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re
from typing import NamedTuple

import numpy as np

from surfel_mapper.errors import FileFormatError, MapError
from surfel_mapper.files.atomic import cannot_write, make_directory, replace_directory
from surfel_mapper.files.parquet import read_map, write_map
from surfel_mapper.mapping.moments import unpack_keys
from surfel_mapper.mapping.surfel_map import SurfelMap

TILE_BITS = 8
"""A tile is 2^8 voxels wide."""

FILE = 'surfels.parquet'

TILE_PATH = re.compile(r'tile_i=(-?\d+)/tile_j=(-?\d+)/' + re.escape(FILE))


class Tile(NamedTuple):
    """A square of voxels: their indices shifted right by TILE_BITS."""

    i: int
    j: int

    @property
    def path(self) -> Path:
        """Path of its file in a dataset."""
        return Path(f'tile_i={self.i}', f'tile_j={self.j}', FILE)


def tiles_in(directory: str | Path) -> dict[Tile, Path]:
    """Return the files of a dataset by tile."""
    tiles = {}
    for path in sorted(Path(directory).glob(f'tile_i=*/tile_j=*/{FILE}')):
        match = TILE_PATH.fullmatch(path.relative_to(directory).as_posix())
        if match:
            tiles[Tile(int(match[1]), int(match[2]))] = path
    return tiles


def dataset_in(directory: str | Path) -> Path | None:
    """Return the dataset of tiles that a directory is, or has as ``map``; None without one."""
    both = (Path(directory) / 'map', Path(directory))
    return next((path for path in both if tiles_in(path)), None)


def read_tiles(directory: str | Path, *, voxel_size_m: float | None = None) -> SurfelMap:
    """
    Return the map in a dataset of tiles, whole in memory, exactly as written.

    Raises
    ------
    FileFormatError
        If there are no tiles, or one cannot be read, is damaged, or of another kind or voxel size.
    DependencyError
        If pyarrow is not installed.

    """
    whole: SurfelMap | None = None
    for path in tiles_in(directory).values():
        tile = read_map(path, voxel_size_m=voxel_size_m)
        if whole is None:
            whole = tile
            continue
        try:
            whole.merge(tile)
        except MapError as error:
            raise FileFormatError(f'{path}: {error}') from error
    if whole is None:
        raise FileFormatError(f'{directory}: no tiles of a map in this directory')
    return whole


def write_tiles(directory: str | Path, surfel_map: SurfelMap) -> None:
    """
    Write a map as a dataset of tiles, in place of an earlier one.

    Raises
    ------
    FileFormatError
        If the directory holds something else, or a file cannot be written.
    DependencyError
        If pyarrow is not installed.

    """
    check_dataset(directory)
    path = Path(directory).resolve()
    make_directory(path.parent)
    try:
        with replace_directory(path) as fresh:
            for tile, content in tiles_of(surfel_map):
                make_directory((fresh / tile.path).parent)
                write_map(fresh / tile.path, content)
    except OSError as error:
        raise cannot_write(directory, error) from error


def tiles_of(surfel_map: SurfelMap) -> Iterator[tuple[Tile, SurfelMap]]:
    """Yield the tiles of a map that have voxels, and the map in each."""
    moments = surfel_map.moments()
    index = unpack_keys(moments.key)[:, :2] >> TILE_BITS
    tiles, rows = np.unique(index, axis=0, return_inverse=True)
    for number, tile in enumerate(tiles.tolist()):
        content = surfel_map.emptied()
        content.insert(moments.select(np.flatnonzero(rows.ravel() == number)))
        yield Tile(*tile), content


def check_dataset(directory: str | Path) -> None:
    """Raise FileFormatError if a path exists and is no dataset of tiles."""
    path = Path(directory)
    if path.exists() and not (path.is_dir() and all(map(is_tiles, path.iterdir()))):
        raise FileFormatError(f'{path}: holds something else, expected tiles of a map, or none')


def is_tiles(path: Path) -> bool:
    """Return whether a path in a dataset is a directory of tiles."""
    return path.is_dir() and path.name.startswith('tile_i=')
