# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
SurfelMap.save and SurfelMap.load: the format of a map by the suffix of its file.

From a directory the exact map is loaded that was written last, as the verbs do. The package
registers this module (map_formats.py).
"""

from __future__ import annotations

from pathlib import Path

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files import las, latest_map, map_state, parquet, parquet_tiles, pcd, ply
from surfel_mapper.mapping.surfel_map import SurfelMap

EXACT = ('.npz', '.parquet')

SURFELS = ('.ply', '.pcd', *las.SUFFIXES)


def save_surfel_map(path: Path, surfel_map: SurfelMap) -> str:
    """Write a map; see SurfelMap.save."""
    suffix = path.suffix.lower()
    if suffix == '.npz':
        return map_state.save_map(path, surfel_map)
    if suffix == '.parquet':
        return parquet.write_map(path, surfel_map)
    if suffix not in SURFELS:
        raise FileFormatError(f'{path}: expected a file ending in {", ".join(EXACT + SURFELS)}')
    writers = {'.ply': ply.write_surfels, '.pcd': pcd.write_surfels}
    write = writers.get(suffix, las.write_surfels)
    write(path, surfel_map.surfels(covariance=True), surfel_map.origin_m)
    return surfel_map.digest()


def load_surfel_map(path: Path) -> SurfelMap:
    """Return a map; see SurfelMap.load."""
    if path.is_dir():
        path = latest_map.map_in(path, latest_map.EXACT) or path / map_state.FILE
    if path.is_dir():
        return parquet_tiles.read_tiles(path)
    if path.suffix.lower() == '.parquet':
        return parquet.read_map(path)
    if path.suffix.lower() in SURFELS:
        raise FileFormatError(
            f'{path}: surfels without their moments, from which no map can be made; expected a '
            f'file ending in {" or ".join(EXACT)}'
        )
    return map_state.load_map(path)[0]
