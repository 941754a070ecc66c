# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
SurfelIndex: look up surfels by position.

A snapshot: it does not follow later changes of the map, and any thread may query it.
"""

from __future__ import annotations

from functools import cached_property
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_numbers
from surfel_mapper.kernels.layout import BITS
from surfel_mapper.mapping.moments import pack_keys, within_reach
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
        keys = pack_keys(surfels.voxel_index)
        self._order = np.argsort(keys)
        self._keys = keys[self._order]

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree  # which takes long to load

        return cKDTree(self.surfels.position)

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
        rows = np.full(len(xyz), -1)
        scale = (1 << self._bits) / self.voxel_size_m
        voxels = np.floor(np.floor(xyz * scale) / float(1 << self._bits))
        inside = np.flatnonzero(within_reach(voxels))
        keys = pack_keys(voxels[inside])
        ranks = np.searchsorted(self._keys, keys)
        ranks[ranks == len(self._keys)] = 0
        if len(self._keys):
            is_there = self._keys[ranks] == keys
            rows[inside[is_there]] = self._order[ranks[is_there]]
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
            Maximum distance of a surfel.

        Returns
        -------
        rows : (N,) int64
            Rows of ``surfels``; -1 if none is near.
        distance : (N,) float64, m
            Distance to the position of the surfel; inf if none is near.

        """
        xyz, radius_m = _as_xyz(points), _as_radius('max_distance_m', max_distance_m)
        rows, distance = np.full(len(xyz), -1), np.full(len(xyz), math.inf)
        is_finite = np.isfinite(xyz).all(axis=1)
        beyond_m = np.nextafter(radius_m, math.inf)
        distance[is_finite], number = self._tree.query(
            xyz[is_finite], distance_upper_bound=beyond_m
        )
        rows[is_finite] = np.where(number < len(self.surfels), number, -1)
        return rows, distance


def _as_xyz(points: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return points as (N, 3) float64 in C order."""
    xyz = np.require(as_numbers('points', points), requirements=['C', 'A', 'W'])
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ValueError(f'points: shape {xyz.shape}, expected (N, 3)')
    return xyz


def _as_radius(name: str, radius_m: float) -> float:
    """Return a radius; raise ValueError if it is negative or not finite."""
    if not 0.0 <= radius_m < math.inf:
        raise ValueError(f'{name}: {radius_m}, expected zero or more, finite')
    return radius_m
