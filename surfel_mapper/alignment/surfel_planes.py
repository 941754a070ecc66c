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
from functools import cached_property
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.kernels.planes import continuation_keys, fill_planes
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
from surfel_mapper.kernels.layout import BITS, HALF
from surfel_mapper.mapping.moments import ScanMoments, unpack_keys
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import Surfels

NOISE_IN_PLANE = 3.0
"""Upper bound of the variance across a ring of a lidar, along the beam, in variances of a
range."""

MAX_TILT_SQ = 0.1
"""Largest variance of a normal, rad^2; surfels with more are ignored."""

SIGMAS = 3.0
"""Distance in standard deviations within which a face may cut a surface."""

MAX_SURFACES = 5000
"""At most this many surfaces are compared with the view of a scan, an even selection of them."""

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

    @property
    def voxel_size_m(self) -> float:
        """Edge of a voxel, m."""
        return self._map.voxel_size_m

    def equations(
        self,
        cells: npt.NDArray[np.float64],
        T_map_sensor: Transform,
        width_m: float,
        rows: npt.NDArray[np.int32] | None = None,
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
        rows : (K,) int32, optional
            Result of ``rows_at`` at a pose nearby; by default the one at the pose.

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
        if rows is None:
            rows = self.rows_at(cells, T_map_sensor)
        hessian, gradient = np.empty((6, 6)), np.empty(6)
        met, fit = sum_equations(
            cells, pose, rows, self._planes, width_m * width_m, hessian, gradient
        )
        return hessian, gradient, met / max(len(cells), 1), fit / max(met, 1)

    def distances(
        self, cells: npt.NDArray[np.float64], T_map_sensor: Transform
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """
        Return the distance of cells (K, 3) from their planes at a pose, its variance, the normals.

        The variance of a cell without a usable plane is inf.
        """
        rows = self.rows_at(cells, T_map_sensor)
        none = np.full((1, PLANE), 0.0)
        none[0, VARIANCE] = math.inf
        planes = np.concatenate([self._planes, none])[rows]
        gap = cells @ T_map_sensor[:3, :3].T + T_map_sensor[:3, 3] - planes[:, MEAN:NORMAL]
        normal = planes[:, NORMAL:VARIANCE]
        distance_m = (gap * normal).sum(axis=1)
        along_sq = np.maximum((gap * gap).sum(axis=1) - distance_m**2, 0.0)
        return distance_m, planes[:, VARIANCE] + along_sq * planes[:, SPREAD], normal

    def rows_at(
        self, cells: npt.NDArray[np.float64], T_map_sensor: Transform
    ) -> npt.NDArray[np.int32]:
        """Return the row of the plane that each cell hits at a pose, -1 if none."""
        pose = np.ascontiguousarray(T_map_sensor[:3])
        keys = np.empty(len(cells), np.int64)
        cell_keys(cells, pose, self._scale, BITS + self._map.level, keys)
        rows = self._map.find(keys)
        missing = int(rows.max(initial=-1)) + 1 - len(self._number)
        if missing > 0:
            self._number = np.append(self._number, np.full(missing, -1, np.int32))
        num_known = len(self._planes)
        numbered = np.empty(num_known + len(cells), np.int32)
        num_now = number_rows(rows, self._number, numbered, num_known)
        if num_now > num_known:
            new = self._map.surfels_of(numbered[num_known:num_now])
            self._planes = np.concatenate([self._planes, self._as_planes(new)])
        return rows

    def _as_planes(self, surfels: Surfels) -> npt.NDArray[np.float64]:
        """
        Return surfels as rows of planes; unusable surfels get an infinite variance.

        Surfels near a face of their voxel are merged with their continuation behind it.
        """
        size_m = self._map.voxel_size_m
        keys = np.empty(len(surfels), np.int64)
        continuation_keys(
            surfels.position,
            surfels.normal,
            surfels.eigenvalues,
            surfels.voxel_index,
            (size_m, self._noise_sq, SIGMAS),
            keys,
        )
        rows = self._map.find(keys)
        continued = self._map.surfels_of(rows[rows >= 0])
        behind = np.where(rows >= 0, np.cumsum(rows >= 0) - 1, -1)
        ring_sq = min(NOISE_IN_PLANE * self._noise_sq, size_m**2 / 48.0)
        planes = np.empty((len(surfels), PLANE))
        fill_planes(
            (surfels.position, surfels.normal, surfels.eigenvalues, surfels.num_points),
            (continued.position, continued.normal, continued.eigenvalues, continued.num_points),
            behind,
            (self._noise_sq, SIGMAS, ALIKE, self._min_points, MAX_TILT_SQ, ring_sq),
            planes,
        )
        return planes


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
        self._maps = {0: surfel_map}
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
            self._planes[level] = SurfelPlanes(
                self._level(level), self._config.min_points, self._config.noise_m
            )
        return self._planes[level]

    @cached_property
    def surfaces(self) -> npt.NDArray[np.float64]:
        """Mean positions of voxels within reach of the scan, (S, 3) m, about MAX_SURFACES."""
        keys = self._map.keys_within(*self._box())
        step = -(-len(keys) // MAX_SURFACES) or 1
        return means(self._map.moments(unpack_keys(keys[::step])))

    def _level(self, level: int) -> SurfelMap:
        """Return the map of a level, made of the level below it, which is needed next."""
        if level not in self._maps:
            within = self._box() if level == 1 else None
            self._maps[level] = self._level(level - 1).coarsen(1, within)
        return self._maps[level]

    def _box(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return the box of voxels within reach of the scan at any heading."""
        reach_m = math.sqrt(float((self._cells**2).sum(axis=1).max(initial=0.0)))
        reach_m += self.voxel_size_m(self._config.coarse_levels)
        at = np.array([start[:3, 3] for start in self._starts])
        low = np.floor((at.min(axis=0) - reach_m) / self._map.voxel_size_m)
        high = np.floor((at.max(axis=0) + reach_m) / self._map.voxel_size_m)
        return low.astype(np.int64), high.astype(np.int64)


def means(moments: ScanMoments) -> npt.NDArray[np.float64]:
    """Return the mean of the points of every voxel, (K, 3) float64, m."""
    inside = moments.total / moments.count[:, None] + (HALF + 0.5)
    positions = (moments.voxel_index + inside / (1 << BITS)) * moments.voxel_size_m
    return np.ascontiguousarray(positions, np.float64)
