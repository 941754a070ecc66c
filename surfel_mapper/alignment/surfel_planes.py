# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The surfels of a map as planes for the cells of a scan, derived only for the voxels that cells hit.

The cost of an alignment depends on the scan and not on the size of the map. The tolerance of a
cell comes from the fit of the plane: the variance of a predicted distance is the variance of the
points about the plane, and grows with the distance from their mean by the uncertainty of the
normal, e0 e1 / (n (e1 - e0)^2). So a surfel of few points, of one ring of a lidar, or of a pole or
a bush gets little weight without a threshold to be tuned.

A surface that lies in a face between two voxels is cut in two by its own noise, each half with a
mean 0.8 standard deviations off, and cells would stay on the side where they start. So surfels
near a face are merged with their continuation behind it.

PlaneLevels makes the planes of the map and of its coarser levels when first requested. Most
alignments need only the map itself. A coarser level is made of the voxels within reach of the
scan, so that its cost does not depend on the size of the map either.

Source: Kanatani 1996 (Statistical Optimization for Geometric Computation) for the normal.
"""

from __future__ import annotations

from collections.abc import Iterable
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.kernels.registration import (
    cell_keys,
    MEAN,
    NORMAL,
    number_rows,
    PLANE,
    SPREAD,
    sum_equations,
    VARIANCE,
)
from surfel_mapper.config import RegistrationConfig
from surfel_mapper.geometry import Transform
from surfel_mapper.kernels.layout import BITS
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import Surfels

NOISE_IN_PLANE = 3.0
"""Upper bound of the variance across a ring of a lidar, along the beam, in variances of a
range."""

MAX_TILT_SQ = 0.1
"""Largest variance of a normal, rad^2; surfels with more are ignored."""

SIGMAS = 3.0
"""Distance in standard deviations within which a face may cut a surface."""

ALIKE = 0.9
"""Minimum cosine between the normals of two surfels to be merged."""


class SurfelPlanes:
    """
    Planes of a map, which must not change meanwhile.

    Parameters
    ----------
    surfel_map : SurfelMap
    min_points : int
        Surfels of fewer points are ignored.
    noise_m : float
        Standard deviation of a range, added to the thickness of every plane.

    """

    def __init__(self, surfel_map: SurfelMap, min_points: int, noise_m: float) -> None:
        self._map = surfel_map
        self._min_points = min_points
        self._noise_sq = noise_m * noise_m
        self._scale = (1 << (BITS + surfel_map.level)) / surfel_map.voxel_size_m
        self._number: npt.NDArray[np.int32] = np.empty(0, np.int32)
        self._planes: npt.NDArray[np.float64] = np.empty((0, PLANE))

    def equations(
        self, cells: npt.NDArray[np.float64], T_map_sensor: Transform, width_m: float
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], float, float]:
        """
        Return the normal equations of a Gauss-Newton step at a pose.

        Parameters
        ----------
        cells : (K, 3) float64, m
            In the sensor frame.
        T_map_sensor : (4, 4) float64
            The pose.
        width_m : float
            Width of the robust kernel.

        Returns
        -------
        hessian : (6, 6) float64
            For position and rotation about the sensor, along the axes of the map.
        gradient : (6,) float64
        overlap : float
            Share of the cells that hit a usable surfel, in [0, 1].
        fit : float
            Share of these cells that fit the surfel, in [0, 1].

        """
        pose = np.ascontiguousarray(T_map_sensor[:3])
        place = self._place(cells, pose)
        hessian, gradient = np.empty((6, 6)), np.empty(6)
        met, fit = sum_equations(
            cells, pose, place, self._planes, width_m * width_m, hessian, gradient
        )
        return hessian, gradient, met / max(len(cells), 1), fit / max(met, 1)

    def _place(
        self, cells: npt.NDArray[np.float64], pose: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.int32]:
        """Return the row of the plane that each cell hits at a pose, -1 if none."""
        keys = np.empty(len(cells), np.int64)
        cell_keys(cells, pose, self._scale, BITS + self._map.level, keys)
        found = self._map.find(keys)
        missing = int(found.max(initial=-1)) + 1 - len(self._number)
        if missing > 0:
            self._number = np.append(self._number, np.full(missing, -1, np.int32))
        num_known = len(self._planes)
        known = np.empty(num_known + len(cells), np.int32)
        num_now = number_rows(found, self._number, known, num_known)
        if num_now > num_known:
            new = self._map.surfels_of(known[num_known:num_now])
            self._planes = np.concatenate([self._planes, self._as_planes(new)])
        return found

    def _as_planes(self, surfels: Surfels) -> npt.NDArray[np.float64]:
        """Return surfels as rows of planes; unusable surfels get an infinite variance."""
        surfels = self._merged_across_faces(surfels)
        planes = np.empty((len(surfels), PLANE))
        planes[:, MEAN : MEAN + 3] = surfels.position
        planes[:, NORMAL : NORMAL + 3] = surfels.normal
        count = surfels.num_points
        low, middle = surfels.eigenvalues[:, 0] + self._noise_sq, surfels.eigenvalues[:, 1]
        by_noise = min(NOISE_IN_PLANE * self._noise_sq, self._map.voxel_size_m**2 / 48.0)
        gap = np.maximum(middle - surfels.eigenvalues[:, 0] - by_noise, 1e-9 * low)
        planes[:, VARIANCE] = low * (1.0 + 1.0 / count)
        planes[:, SPREAD] = low * middle / (count * gap * gap)
        unusable = (
            (count < self._min_points)
            | np.isnan(surfels.planarity)
            | (planes[:, SPREAD] > MAX_TILT_SQ)
        )
        planes[unusable, VARIANCE] = math.inf
        return planes

    def _merged_across_faces(self, surfels: Surfels) -> Surfels:
        """Merge surfels near a face of their voxel with their continuation behind it."""
        size_m = self._map.voxel_size_m
        every = np.arange(len(surfels))
        axis = np.argmax(np.abs(np.nan_to_num(surfels.normal)), axis=1)
        slope = surfels.normal[every, axis]
        inside_m = surfels.position[every, axis] - surfels.voxel_index[every, axis] * size_m
        reach_m = SIGMAS * np.sqrt(surfels.eigenvalues[:, 0] + self._noise_sq)
        side = np.where(inside_m < 0.5 * size_m, -1, 1)
        to_face_m = np.minimum(inside_m, size_m - inside_m) * np.abs(slope)
        near = np.flatnonzero(to_face_m < reach_m)
        behind = surfels.voxel_index[near]
        behind[np.arange(len(near)), axis[near]] += side[near]
        found = self._map.find(pack_keys(behind))
        near, found = near[found >= 0], found[found >= 0]
        other = self._map.surfels_of(found)
        across_m = ((other.position - surfels.position[near]) * surfels.normal[near]).sum(axis=1)
        alike = np.abs((other.normal * surfels.normal[near]).sum(axis=1)) > ALIKE
        one = alike & (np.abs(across_m) < 2.0 * reach_m[near])
        merge(surfels, near[one], other.select(one), across_m[one])
        return surfels


class PlaneLevels:
    """
    Planes of a map and of its coarser levels around a scan.

    Parameters
    ----------
    config : RegistrationConfig
    surfel_map : SurfelMap
        The map, level 0.
    cells : (K, 3) float64, m
        Cells of the scan in the sensor frame; they determine its reach.
    starts : iterable of (4, 4) float64
        Possible poses of the sensor.

    """

    def __init__(
        self,
        config: RegistrationConfig,
        surfel_map: SurfelMap,
        cells: npt.NDArray[np.float64],
        starts: Iterable[Transform],
    ) -> None:
        self._config = config
        self._map = surfel_map
        self._cells = cells
        self._starts = list(starts)
        self._planes: dict[int, SurfelPlanes] = {}

    def voxel_size_m(self, level: int) -> float:
        """Return the edge of a voxel of a level."""
        return float(self._map.voxel_size_m * 2**level)

    def planes(self, level: int) -> SurfelPlanes:
        """
        Return the planes of a level.

        Raises
        ------
        MapLimitError
            If a voxel of that level would hold too many points; see SurfelMap.coarsen.

        """
        if level not in self._planes:
            target = self._map.coarsen(level, self._box()) if level else self._map
            self._planes[level] = SurfelPlanes(
                target, self._config.min_points, self._config.noise_m
            )
        return self._planes[level]

    def _box(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return the box of voxels within reach of the scan at any heading."""
        reach_m = math.sqrt(float((self._cells**2).sum(axis=1).max(initial=0.0)))
        reach_m += self.voxel_size_m(self._config.coarse_levels)
        at = np.array([start[:3, 3] for start in self._starts])
        low = np.floor((at.min(axis=0) - reach_m) / self._map.voxel_size_m)
        high = np.floor((at.max(axis=0) + reach_m) / self._map.voxel_size_m)
        return low.astype(np.int64), high.astype(np.int64)


def merge(
    surfels: Surfels,
    rows: npt.NDArray[np.int64],
    other: Surfels,
    across_m: npt.NDArray[np.float64],
) -> None:
    """
    Merge surfels pairwise into others of similar normals, in place.

    Parameters
    ----------
    surfels : Surfels
        Surfels to change.
    rows : (K,) int64
        Rows to merge into.
    other : Surfels
        K surfels to merge, one for each row.
    across_m : (K,) float64
        Distance of these from the first along the normals of the first.

    """
    first, second = surfels.num_points[rows], other.num_points
    share = (second / (first + second))[:, None]
    turned = np.sign((other.normal * surfels.normal[rows]).sum(axis=1))[:, None] * other.normal
    normal = (1.0 - share) * surfels.normal[rows] + share * turned
    surfels.normal[rows] = normal / np.sqrt((normal**2).sum(axis=1))[:, None]
    surfels.position[rows] += share * (other.position - surfels.position[rows])
    surfels.eigenvalues[rows] += share * (other.eigenvalues - surfels.eigenvalues[rows])
    surfels.eigenvalues[rows, 0] += ((1.0 - share) * share)[:, 0] * across_m**2
    surfels.num_points[rows] = first + second
