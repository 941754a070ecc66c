# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""KISS-SLAM with its own defaults but for one thread: odometry in local maps, and loops."""

from __future__ import annotations

from kiss_slam.config import load_config
from kiss_slam.slam import KissSLAM
import numpy as np


class Odometry:
    """Poses of scan after scan, corrected at the end."""

    def __init__(self, voxel_size_m):
        config = load_config(None)
        config.odometry.mapping.voxel_size = voxel_size_m
        config.odometry.preprocessing.deskew = False
        config.odometry.registration.max_num_threads = 1
        self._slam = KissSLAM(config)

    def register(self, points):
        """Take a scan; return its pose so far, (4, 4)."""
        self._slam.process_scan(points, np.zeros(len(points)))
        graph = self._slam.local_map_graph
        return graph.last_keypose @ self._slam.odometry.last_pose

    def finish(self):
        """Return the corrected poses of all scans, as its own pipeline does, (S, 4, 4)."""
        self._slam.generate_new_node()
        self._slam.local_map_graph.erase_last_local_map()
        return np.array(self._slam.fine_grained_optimization()[0])
