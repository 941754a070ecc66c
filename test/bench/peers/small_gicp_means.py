# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
small_gicp's map of Gaussian voxels, given bare points.

It averages the covariances of the points; without covariances only its means are valid.
"""

from __future__ import annotations

import numpy as np
import small_gicp


class Peer:
    """A map that drops voxels not touched within the length of the window."""

    def __init__(self, voxel_size_m, window):
        self._map = small_gicp.GaussianVoxelMap(voxel_size_m)
        self._map.set_lru(horizon=window, clear_cycle=1)

    def step(self, points, T_map_sensor):
        """Insert a scan."""
        finite = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        self._map.insert(self.prepared(small_gicp.PointCloud(finite)), T_map_sensor)

    def prepared(self, cloud):
        """Return the scan in the form of the map."""
        return cloud

    @property
    def num_voxels(self):
        """Voxels in the map."""
        return self._map.size()
