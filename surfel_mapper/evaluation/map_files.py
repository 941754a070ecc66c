# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Maps in files of any format as discs: position and normal of each surfel.

Reads files and directories of a replay or a merge, and points in any format of scans. Exact
formats give the digest too, so that two maps can be compared to the bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.arrays import is_cloud
from surfel_mapper.files.latest_map import DRAWABLE, map_in, TILES
from surfel_mapper.files.maps import load_surfel_map
from surfel_mapper.files.point_columns import normals_in
from surfel_mapper.files.scan_files import scan_reader, SUFFIXES
from surfel_mapper.mapping.surfel_map import SurfelMap

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Discs:
    """
    Surfels of a map, or points of a cloud.

    Attributes
    ----------
    position : (K, 3) float64, m
    normal : (K, 3) float64, or None
        Of unit length, or nan; None if the file has no normals.
    voxel_size_m : float, optional
        Voxel size of the map, if the file has it.
    digest : str, optional
        Digest of the map, if the file is exact.

    """

    position: Floats
    normal: Floats | None
    voxel_size_m: float | None = None
    digest: str | None = None

    def __len__(self) -> int:
        """Return the number of surfels or points."""
        return len(self.position)


def load_discs(path: str | Path, min_points: int, bin_columns: int | None = None) -> Discs:
    """
    Return the surfels of a map in a file, or of the map written last in a directory.

    Parameters
    ----------
    path : str or Path
        Output directory of a replay or a merge, a dataset of tiles, or a file: .parquet, .npz,
        or points in a format of scan_files.py.
    min_points : int
        Points that a voxel needs to count as a surfel, if the file has all voxels.
    bin_columns : int, optional
        Number of columns of a .bin; without, that which fits its values.

    Raises
    ------
    FileFormatError
        If there is no map, or it cannot be read.

    """
    file = map_in(path, DRAWABLE) if Path(path).is_dir() else Path(path)
    if file is None:
        raise FileFormatError(
            f'{path}: no map in this directory; expected map/tile_i=*/tile_j=*/ or one of '
            f'{", ".join(form for form in DRAWABLE if form != TILES)}'
        )
    suffix = file.suffix.lower()
    if file.is_dir() or suffix == '.parquet' or (suffix == '.npz' and not is_cloud(file)):
        return of_map(load_surfel_map(file), min_points)
    if suffix not in SUFFIXES:
        missing = '' if file.exists() else 'no such file or directory; '
        forms = f'a directory, .parquet, .npz, or points: {", ".join(SUFFIXES)}'
        raise FileFormatError(f'{path}: {missing}expected {forms}')
    return of_columns(*scan_reader([file], bin_columns)(file))


def of_map(surfel_map: SurfelMap, min_points: int) -> Discs:
    """Return the surfels of a map."""
    surfels = surfel_map.surfels(min_points)
    position = surfels.position + surfel_map.origin_m
    return Discs(position, surfels.normal, surfel_map.voxel_size_m, surfel_map.digest())


def of_columns(points: npt.NDArray[Any], columns: Mapping[str, npt.NDArray[Any]]) -> Discs:
    """Return the points of a cloud, with normals scaled to unit length; none if all are zero."""
    normal = normals_in(columns)
    if normal is not None:
        with np.errstate(invalid='ignore'):
            normal /= np.sqrt((normal * normal).sum(axis=1, keepdims=True))
        if not np.isfinite(normal).all(axis=1).any():  # PCL's PointNormal, never filled
            normal = None
    position = np.ascontiguousarray(points, np.float64)
    finite = np.isfinite(position).all(axis=1)
    return Discs(position[finite], None if normal is None else normal[finite])
