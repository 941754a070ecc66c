# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""KISS-ICP's local map: some points of every voxel near the sensor."""

from __future__ import annotations

from kiss_icp.mapping import VoxelHashMap
import numpy as np

MAX_RANGE_M = 100.0
POINTS_A_VOXEL = 20
"""Defaults of KISS-ICP."""


class Peer:
    """A map that drops voxels by distance."""

    def __init__(self, voxel_size_m, window):
        self._size_m = voxel_size_m
        self._map = VoxelHashMap(voxel_size_m, MAX_RANGE_M, POINTS_A_VOXEL)

    def step(self, points, T_map_sensor):
        """Add a scan and drop points far from it."""
        finite = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        self._map.update(finite, T_map_sensor)

    @property
    def num_voxels(self):
        """Voxels that hold a point."""
        index = np.floor(self._map.point_cloud() / self._size_m).astype(np.int64)
        return len(np.unique(index, axis=0))
