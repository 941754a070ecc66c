# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
small_gicp's VGICP from scan to map, as in its odometry benchmark.

Scans are downsampled to 0.25 m and given covariances of 10 neighbours, aligned to a map of
Gaussian voxels from a prediction of constant velocity, and inserted; voxels that are not touched
for long leave the map. All on one thread.
"""

from __future__ import annotations

import numpy as np
import small_gicp

CELL_M = 0.25


class Odometry:
    """Poses of scan after scan."""

    def __init__(self, voxel_size_m):
        self._map = small_gicp.GaussianVoxelMap(voxel_size_m)
        self._map.set_lru(horizon=100, clear_cycle=10)
        self._pose, self._step = np.eye(4), np.eye(4)

    def register(self, points):
        """Return the pose of a scan, (4, 4)."""
        cloud, _ = small_gicp.preprocess_points(points, CELL_M, num_threads=1)
        if self._map.size() > 0:
            guess = self._pose @ self._step
            found = small_gicp.align(self._map, cloud, init_T_target_source=guess)
            self._step = np.linalg.inv(self._pose) @ found.T_target_source
            self._pose = found.T_target_source
        self._map.insert(cloud, self._pose)
        return self._pose
