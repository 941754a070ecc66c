# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A plain cloud of points in a file as a map, on which scans are localised.

All points count once, whatever scans they come from. A cloud of surfels, or one that was thinned,
has too few points a voxel for a normal, but may have normals: each point then stands for a disc.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FileFormatError, MapError
from surfel_mapper.files.point_columns import normals_in
from surfel_mapper.files.scan_files import read_scan, SUFFIXES
from surfel_mapper.mapping.moments import looks_like_other_unit, ScanMoments
from surfel_mapper.mapping.surfel_map import SurfelMap

Floats = npt.NDArray[np.float64]

LEAST_POINTS = 5
"""Points of a voxel with a normal, those of registration.min_points."""

LEAST_SHARE = 0.5
"""Least share of the points in voxels with normals; none of a hall in millimetres are."""

FAR_M = 1e4
"""Distance of a cloud from its origin from which on the map has its own, m: UTM, ECEF."""

ORIGIN_STEP_M = 1000.0
"""The own origin of a map is rounded to this, m."""

RADIUS = 0.25
"""Radius of the disc of a point with a normal, in voxels."""

SPOKES = 8
"""Points of such a disc."""


def is_cloud(path: Path) -> bool:
    """Return whether a file may be a cloud of points, by its ending."""
    return path.suffix.lower() in SUFFIXES and path.suffix.lower() != '.npz'


def read_cloud_map(path: Path, voxel_size_m: float) -> SurfelMap:
    """
    Return the map of the points in a file.

    Raises
    ------
    FileFormatError
        If the file cannot be read, has no points, or too few in a voxel for normals.

    """
    points, columns = read_scan(path)
    is_finite = np.isfinite(points).all(axis=1)
    if not is_finite.any():
        raise FileFormatError(f'{path}: no finite points among {len(points)}; expected a cloud')
    points = points[is_finite].astype(np.float64)
    surfel_map = SurfelMap(voxel_size_m, origin_m=origin_of(points))
    points -= surfel_map.origin_m
    try:
        moments = surfel_map.reduce(points)
        if usable_share(moments) < LEAST_SHARE and (normals := normals_in(columns)) is not None:
            moments = surfel_map.reduce(discs(points, normals[is_finite], RADIUS * voxel_size_m))
        check_density(path, moments, points)
        surfel_map.insert(moments)
    except MapError as error:
        raise FileFormatError(f'{path}: {error}') from error
    return surfel_map


def origin_of(points: Floats) -> Floats:
    """Return the origin of a map of points (N, 3), which is not 0 if they are far from it."""
    centre = np.median(points, axis=0)
    if not np.abs(centre).max() > FAR_M:
        return np.zeros(3)
    return np.asarray(np.rint(centre / ORIGIN_STEP_M) * ORIGIN_STEP_M + 0.0)


def usable_share(moments: ScanMoments) -> float:
    """Return the share of points in voxels with normals."""
    usable = moments.count[moments.count >= LEAST_POINTS]
    return float(usable.sum() / max(int(moments.count.sum()), 1))


def check_density(path: Path, moments: ScanMoments, points: Floats) -> None:
    """Raise unless most points are in voxels with normals."""
    share = usable_share(moments)
    if share >= LEAST_SHARE:
        return
    size_m = moments.voxel_size_m
    sides = ' x '.join(f'{side:.0f}' for side in np.ptp(points, axis=0))
    reason = (
        'is it in millimetres or centimetres? Metres are expected'
        if looks_like_other_unit(moments)
        else 'larger voxels (map.voxel_size_m), or a cloud with normals or more points, are needed'
    )
    raise FileFormatError(
        f'{path}: {len(points)} points in {len(moments)} voxels of {size_m:g} m, {sides} m: '
        f'{share:.0%} are in voxels of {LEAST_POINTS} or more, expected {LEAST_SHARE:.0%}; '
        f'{reason}'
    )


def discs(points: Floats, normals: Floats, radius_m: float) -> Floats:
    """Return points on circles about points (N, 3) with normals; those without one are kept."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    has_normal = (length[:, 0] > 0.0) & np.isfinite(length[:, 0])
    unit = normals[has_normal] / length[has_normal]
    axis = np.eye(3)[np.abs(unit).argmin(axis=1)]
    u = np.cross(unit, axis)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(unit, u)
    angles = 2.0 * np.pi * np.arange(SPOKES) / SPOKES
    circles = [
        points[has_normal] + radius_m * (np.cos(angle) * u + np.sin(angle) * v) for angle in angles
    ]
    return np.concatenate([points, *circles])
