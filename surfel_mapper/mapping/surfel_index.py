# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
SurfelIndex: look up surfels by position.

A snapshot: it does not follow later changes of the map, and any thread may query it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_numbers
from surfel_mapper.kernels.grouping import build_table
from surfel_mapper.kernels.layout import BITS
from surfel_mapper.mapping.kernels.queries import best_around, rows_at
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.mapping.surfels import Surfels


class SurfelIndex:
    """
    Surfels of a map, indexed by position.

    Parameters
    ----------
    surfels : Surfels
        Surfels to index; results are row indices into them.
    voxel_size_m : float
        Edge of a voxel of the map, m.
    level : int
        Level of the map.

    """

    def __init__(self, surfels: Surfels, voxel_size_m: float, *, level: int = 0) -> None:
        self.surfels = surfels
        self.voxel_size_m = voxel_size_m
        self._bits = BITS + level
        self._keys = pack_keys(surfels.voxel_index)
        size = 1 << max(2 * len(surfels) - 1, 1).bit_length()
        self._table = np.empty(size, np.int32)
        build_table(self._keys, self._table)

    def at(self, points: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """
        Return the surfel of the voxel that each point lies in.

        Parameters
        ----------
        points : (N, 3) float, m
            In the frame of the map.

        Returns
        -------
        (N,) int64
            Rows of ``surfels``; -1 if the voxel has no surfel.

        """
        xyz = _as_xyz(points)
        rows = np.empty(len(xyz), np.int64)
        scale = (1 << self._bits) / self.voxel_size_m
        rows_at(xyz, scale, self._bits, self._keys, self._table, rows)
        return rows

    def nearest(
        self, points: npt.ArrayLike, max_distance_m: float
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """
        Return the surfel nearest to each point.

        Parameters
        ----------
        points : (N, 3) float, m
            In the frame of the map.
        max_distance_m : float
            Maximum distance of a surfel; the cost grows with its cube.

        Returns
        -------
        rows : (N,) int64
            Rows of ``surfels``; -1 if none is near.
        distance : (N,) float64, m
            Distance to the position of the surfel; inf if none is near.

        """
        xyz = _as_xyz(points)
        rows = self._best(xyz, max_distance_m, 1, np.empty(0))[:, 0]
        step = self._of(self.surfels.position, rows) - xyz
        distance = np.sqrt((step * step).sum(axis=1))
        return rows, np.where(rows >= 0, distance, math.inf)

    def best_planar(
        self, points: npt.ArrayLike, k: int, max_distance_m: float
    ) -> npt.NDArray[np.int64]:
        """
        Return the most planar surfels around each point.

        Parameters
        ----------
        points : (N, 3) float, m
            In the frame of the map.
        k : int
            Number of surfels for each point.
        max_distance_m : float
            Maximum distance from point to surfel position; the cost grows with its cube.

        Returns
        -------
        (N, k) int64
            Rows of ``surfels``, the most planar first, padded with -1. Surfels without a
            planarity are ignored.

        Raises
        ------
        ValueError
            If k is not positive.

        """
        if k < 1:
            raise ValueError(f'k: {k}, expected 1 or more')
        return self._best(_as_xyz(points), max_distance_m, k, -self.surfels.planarity)

    def in_box(self, low: npt.ArrayLike, high: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Return the rows of the surfels in a box, m, including its faces, ascending."""
        position = self.surfels.position
        lowest, highest = np.asarray(low, np.float64), np.asarray(high, np.float64)
        if lowest.shape != (3,) or highest.shape != (3,):
            raise ValueError('low, high: expected the corners of a box, x y z each')
        return np.flatnonzero(((position >= lowest) & (position <= highest)).all(axis=1))

    def in_radius(self, center: npt.ArrayLike, radius_m: float) -> npt.NDArray[np.int64]:
        """Return the rows of the surfels within a distance of a point, ascending."""
        if not radius_m >= 0.0:
            raise ValueError(f'radius_m: {radius_m}, expected zero or more')
        step = self.surfels.position - _as_xyz(np.reshape(np.asarray(center), (1, 3)))
        return np.flatnonzero((step * step).sum(axis=1) <= radius_m * radius_m)

    def plane_distance(
        self, points: npt.ArrayLike, max_distance_m: float = 0.0
    ) -> npt.NDArray[np.float64]:
        """
        Return the distance of each point from the plane of its surfel.

        Parameters
        ----------
        points : (N, 3) float, m
            In the frame of the map.
        max_distance_m : float
            0: use the surfel of the voxel that the point lies in; else the nearest surfel
            within this distance.

        Returns
        -------
        (N,) float64, m
            normal . (point - position), positive on the side of the sensor; nan if there is no
            surfel, or it has no normal.

        """
        xyz = _as_xyz(points)
        rows = self.nearest(xyz, max_distance_m)[0] if max_distance_m > 0 else self.at(xyz)
        step = xyz - self._of(self.surfels.position, rows)
        return np.asarray((step * self._of(self.surfels.normal, rows)).sum(axis=1))

    def _best(
        self, xyz: npt.NDArray[np.float64], radius_m: float, k: int, ranks: Any
    ) -> npt.NDArray[np.int64]:
        if not 0.0 <= radius_m < math.inf:
            raise ValueError(f'max_distance_m: {radius_m}, expected zero or more, finite')
        rows = np.empty((len(xyz), k), np.int64)
        best_around(
            xyz,
            radius_m,
            self.voxel_size_m,
            self.surfels.position,
            ranks,
            self._keys,
            self._table,
            rows,
        )
        return rows

    def _of(
        self, values: npt.NDArray[np.float64], rows: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64]:
        """Return values (M, 3) by row, nan for -1."""
        if not len(values):
            return np.full((len(rows), 3), math.nan)
        return np.where((rows >= 0)[:, None], values[rows], math.nan)


def _as_xyz(points: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return points as (N, 3) float64 in C order."""
    xyz = np.require(as_numbers('points', points), requirements=['C', 'A', 'W'])
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ValueError(f'points: shape {xyz.shape}, expected (N, 3)')
    return xyz
