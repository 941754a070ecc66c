# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""KISS-ICP with its defaults on one thread; scans have no times, so none is deskewed."""

from __future__ import annotations

from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP
import numpy as np


class Odometry:
    """Poses of scan after scan."""

    def __init__(self, voxel_size_m):
        config = KISSConfig()
        config.mapping.voxel_size = voxel_size_m
        config.data.deskew = False
        config.registration.max_num_threads = 1
        self._odometry = KissICP(config)

    def register(self, points):
        """Return the pose of a scan, (4, 4)."""
        self._odometry.register_frame(points, np.zeros(len(points)))
        return self._odometry.last_pose
