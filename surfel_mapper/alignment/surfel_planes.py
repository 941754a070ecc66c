# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The surfels of a map as planes for the cells of a scan, derived only where a cell meets them.

What an alignment costs depends on the scan and not on the size of the map. How far a cell may
be from a plane comes from the fit of the plane itself: the variance of a prediction is that of
the points about the plane, and grows with the distance from their mean as the normal is unsure,
by e0 e1 / (n (e1 - e0)^2). So a surfel of few points, of one ring of a lidar, or of a pole or a
bush says little without a threshold that would have to be set.

A surface that lies in a face between two voxels is cut in two by its own noise, each half with a
mean 0.8 standard deviations off; cells would stay on the side they start from. So surfels
near a face are merged with what continues them behind it.

Source: Kanatani 1996 (Statistical Optimization for Geometric Computation) for the normal.
"""

from __future__ import annotations

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
from surfel_mapper.geometry import Transform
from surfel_mapper.kernels.layout import BITS
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import Surfels

NOISE_IN_PLANE = 3.0
"""So many variances of a range may lie across a ring of a lidar, along the beam."""

MAX_TILT_SQ = 0.1
"""The variance of a normal, rad^2, from which on it is none."""

SIGMAS = 3.0
"""So many standard deviations from a face a surface may be cut by it."""

ALIKE = 0.9
"""Cosine between the normals of two surfels that may be one."""


class SurfelPlanes:
    """
    Planes of one map, which must not change meanwhile.

    Parameters
    ----------
    surfel_map : SurfelMap
    min_points : int
        Surfels of fewer points do not count.
    noise_m : float
        Standard deviation of a range: no plane is sharper.

    """

    def __init__(self, surfel_map: SurfelMap, min_points: int, noise_m: float) -> None:
        """Begin without any plane."""
        self._map = surfel_map
        self._min_points = min_points
        self._noise_sq = noise_m * noise_m
        self._scale = (1 << (BITS + surfel_map.level)) / surfel_map.voxel_size_m
        self._number = np.empty(0, np.int32)
        self._planes = np.empty((0, PLANE))

    def equations(
        self, cells: npt.NDArray[np.float64], T_map_sensor: Transform, width_m: float
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], float, float]:
        """
        Return the normal equations of a step from a pose.

        Parameters
        ----------
        cells : (K, 3) float64, m
            In the sensor frame.
        T_map_sensor : (4, 4) float64
            The pose.
        width_m : float
            Of the robust kernel.

        Returns
        -------
        hessian : (6, 6) float64
            Of position and turn about the sensor, along the axes of the map.
        gradient : (6,) float64
        overlap : float
            Share of the cells that meet a surfel which says something, in [0, 1].
        fit : float
            Share of these that fit it, in [0, 1].

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
        """Return the row of the plane that each cell meets at a pose, -1 for none."""
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
        """Return surfels as rows of planes; those that say nothing have an infinite variance."""
        surfels = self._continued(surfels)
        planes = np.empty((len(surfels), PLANE))
        planes[:, MEAN : MEAN + 3] = surfels.position
        planes[:, NORMAL : NORMAL + 3] = surfels.normal
        count = surfels.num_points
        low, middle = surfels.eigenvalues[:, 0] + self._noise_sq, surfels.eigenvalues[:, 1]
        by_noise = min(NOISE_IN_PLANE * self._noise_sq, self._map.voxel_size_m**2 / 48.0)
        gap = np.maximum(middle - surfels.eigenvalues[:, 0] - by_noise, 1e-9 * low)
        planes[:, VARIANCE] = low * (1.0 + 1.0 / count)
        planes[:, SPREAD] = low * middle / (count * gap * gap)
        says_nothing = (
            (count < self._min_points)
            | np.isnan(surfels.planarity)
            | (planes[:, SPREAD] > MAX_TILT_SQ)
        )
        planes[says_nothing, VARIANCE] = math.inf
        return planes

    def _continued(self, surfels: Surfels) -> Surfels:
        """Merge surfels near a face of their voxels with those behind it, where they are one."""
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


def merge(
    surfels: Surfels,
    rows: npt.NDArray[np.int64],
    other: Surfels,
    across_m: npt.NDArray[np.float64],
) -> None:
    """
    Merge surfels into some rows of others of about the same normals, in place.

    Parameters
    ----------
    surfels : Surfels
        Those that are changed.
    rows : (K,) int64
        Which of them.
    other : Surfels
        K more, one for each.
    across_m : (K,) float64
        How far these are along the normals of the first.

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
