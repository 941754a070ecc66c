# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Errors of a map against the truth: positions, normals, completeness.

The truth is a world of known surfaces, or points with or without normals, such as another map.
A surfel is compared with the nearest place of the truth. Its error of position is the distance
to the surface there, along the normal, because a surfel may lie anywhere on its surface; if the
truth has no normals, the distance to the point. Angles are between axes; normals that point to
the other side are counted separately. Completeness is the share of the truth, evenly thinned,
that has a surfel near it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from surfel_mapper.evaluation.map_files import Discs

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """
    The places of the truth nearest to some positions.

    Attributes
    ----------
    distance_m : (K,) float64
        Distance; inf if there is no place.
    off_m : (K,) float64
        Distance of the positions from the surface there.
    normal : (K, 3) float64, or None
        Normal of the surface; None if unknown.
    place : (K, 3) float64, m
        The places; nan if there is none, or if it is on an edge of a known surface.

    """

    distance_m: Floats
    off_m: Floats
    normal: Floats | None
    point: Floats


class Truth(Protocol):
    """Reference that a map is compared with."""

    def nearest(self, position: Floats) -> Nearest:
        """Return the points of the truth nearest to positions (K, 3), m."""

    def samples(self) -> Floats | None:
        """Return places (N, 3), m, where a complete map has surfels; None if unknown."""


class CloudTruth:
    """
    Points as truth: a reference scan, or another map.

    Parameters
    ----------
    discs : Discs
        The points.

    """

    def __init__(self, discs: Discs) -> None:
        self._discs = discs
        self._tree = cKDTree(discs.position)

    def nearest(self, position: Floats) -> Nearest:
        """Return the points of the truth nearest to positions (K, 3), m."""
        distance_m, row = self._tree.query(position)
        if not len(self._discs):
            return Nearest(distance_m, distance_m, None, np.full((len(position), 3), np.nan))
        point = self._discs.position[row]
        if self._discs.normal is None:
            return Nearest(distance_m, distance_m, None, point)
        normal = self._discs.normal[row]
        off = np.einsum('ij,ij->i', position - point, normal)
        off_m = np.where(np.isfinite(off), np.abs(off), distance_m)
        return Nearest(distance_m, off_m, normal, point)

    def samples(self) -> Floats:
        """Return all points."""
        return self._discs.position


def evaluate(
    surfels: Discs, truth: Truth, *, max_distance_m: float, radius_m: float
) -> dict[str, Any]:
    """
    Return the errors of a map in numbers, for files and reports.

    Parameters
    ----------
    surfels : Discs
        The map.
    truth : Truth
        The reference.
    max_distance_m : float
        Surfels farther than this from the truth are not compared.
    radius_m : float
        A sample of the truth counts as found if a surfel is this near. Samples are thinned to one
        in a cube of this edge.

    """
    nearest = truth.nearest(surfels.position)
    near = nearest.distance_m <= max_distance_m
    result: dict[str, Any] = {
        'surfels': len(surfels),
        'compared': int(near.sum()),
        'position_m': spread(nearest.off_m[near]),
    }
    if surfels.normal is not None and nearest.normal is not None:
        cosine = np.einsum('ij,ij->i', surfels.normal, nearest.normal)[near]
        sine = np.sqrt((np.cross(surfels.normal, nearest.normal)[near] ** 2).sum(axis=1))
        angle_deg = np.degrees(np.arctan2(sine, np.abs(cosine)))
        defined = np.isfinite(angle_deg)
        result['normal_deg'] = spread(angle_deg[defined])
        result['normals_compared'] = int(defined.sum())
        result['normals_on_the_other_side'] = int((cosine[defined] < 0.0).sum())
    samples = truth.samples()
    if samples is not None:
        result['completeness'] = completeness(surfels.position, samples, radius_m)
        result['completeness_radius_m'] = radius_m
    return result


def spread(errors: Floats) -> dict[str, float | None]:
    """Return mean, median, 95th percentile and maximum; None for no errors."""
    if not len(errors):
        return dict.fromkeys(('mean', 'median', 'p95', 'max'))
    return {
        'mean': float(errors.mean()),
        'median': float(np.median(errors)),
        'p95': float(np.percentile(errors, 95)),
        'max': float(errors.max()),
    }


def completeness(position: Floats, samples: Floats, radius_m: float) -> float | None:
    """Return the share of thinned samples that have a position within a radius."""
    if not len(samples):
        return None
    cube = np.floor(samples / radius_m).astype(np.int64)
    _, first = np.unique(cube, axis=0, return_index=True)
    if not len(position):
        return 0.0
    distance_m, _ = cKDTree(position).query(samples[first], distance_upper_bound=radius_m)
    return float(np.isfinite(distance_m).mean())
