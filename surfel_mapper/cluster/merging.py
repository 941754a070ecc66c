# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Tiles: parts of many maps into one map, a tile at a time.

No process holds more than one tile and what one part adds to it. The digest of the result is
taken by going through the tiles in the order of their voxels.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
import time

import numpy as np

from surfel_mapper.cluster.shards import peak_bytes
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.parquet_tiles import (
    Part,
    read_part,
    split_map,
    Tile,
    tile_part,
    tiles_in,
    write_shard,
    write_tile,
)
from surfel_mapper.mapping.surfels import Surfels

DATASET = 'map'
"""Where in the output directory of a replay the tiles are."""

FILE = 'map.parquet'
"""Where in the output directory of a replay by one process its map is."""

Parts = Mapping[Tile, list[Part]]


@dataclass(frozen=True, slots=True, kw_only=True)
class TileTask:
    """
    A tile to be made.

    Attributes
    ----------
    parts : tuple of Part
        What it is the sum of.
    path : str
        Where to write it.
    min_points : int
        From how many points on a voxel counts as a surfel.
    share : float
        So many of its surfels are sent back, for pictures; 1: all.

    """

    parts: tuple[Part, ...]
    path: str
    min_points: int
    share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TileResult:
    """What a tile holds, and some of its surfels."""

    voxel_size_m: float
    voxels: int
    points: int
    surfels: int
    core_s: float
    sample: Surfels
    peak_bytes: int


def merge_tile(task: TileTask) -> TileResult:
    """
    Add up the parts of a tile and write it; runs on a worker.

    Raises
    ------
    MapError
        If the parts are of maps that do not fit together.
    FileFormatError
        If a file cannot be read or written.

    """
    began_core = time.process_time()
    first, *others = task.parts
    surfel_map = read_part(first)
    for part in others:
        surfel_map.merge(read_part(part))
    write_tile(task.path, surfel_map)
    surfels = surfel_map.surfels(task.min_points)
    wanted = int(np.ceil(len(surfels) * task.share))
    rows = np.linspace(0, len(surfels) - 1, wanted).astype(np.int64)
    return TileResult(
        voxel_size_m=surfel_map.voxel_size_m,
        voxels=surfel_map.num_voxels,
        points=surfel_map.num_points,
        surfels=len(surfels),
        core_s=time.process_time() - began_core,
        sample=surfels.select(rows),
        peak_bytes=peak_bytes(),
    )


def gathered(parts: Iterable[Mapping[Tile, Part]]) -> dict[Tile, list[Part]]:
    """Return parts by tile, in the order given."""
    found: dict[Tile, list[Part]] = {}
    for mapping in parts:
        for tile, part in mapping.items():
            found.setdefault(tile, []).append(part)
    return found


def parts_of_map(source: str | Path, work: Path) -> list[dict[Tile, Part]]:
    """
    Return the parts of a finished map; one in a single file is cut into tiles first.

    Parameters
    ----------
    source : str or Path
        Output directory of a replay or a merge, a dataset of tiles, or a Parquet file.
    work : Path
        Directory for the parts of a map that is cut.

    Raises
    ------
    FileFormatError
        If there is no map, or it cannot be read.

    """
    path = Path(source)
    for directory in (path / DATASET, path):
        tiles = tiles_in(directory) if directory.is_dir() else {}
        if tiles:
            return [{tile: tile_part(file) for tile, file in tiles.items()}]
    file = path / FILE if path.is_dir() else path
    if not file.is_file():
        raise FileFormatError(
            f'{source}: no map; expected {DATASET}/tile_i=*/tile_j=*/, or the {FILE} of '
            'surfel-mapper replay --formats parquet'
        )
    return [
        write_shard(work / f'piece-{number}.parquet', piece)
        for number, piece in enumerate(split_map(file))
    ]
