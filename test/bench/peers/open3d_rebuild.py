# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Rebuild the window for every scan: Open3D's downsampling, then normals from neighbours.

Every scan is downsampled once on arrival, and the rebuild uses the downsampled scans, which is
much faster than from all points of the window.
"""

from __future__ import annotations

from collections import deque

import numpy as np
import open3d


class Peer:
    """The downsampled scans of the window, and the cloud made of them."""

    def __init__(self, voxel_size_m, window):
        self._size_m = voxel_size_m
        self._scans = deque(maxlen=window)
        self._cloud = open3d.geometry.PointCloud()

    def fill(self, points, T_map_sensor):
        """Take a scan into the window."""
        finite = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        scan = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(finite))
        scan = scan.transform(T_map_sensor).voxel_down_sample(self._size_m)
        self._scans.append(np.asarray(scan.points))

    def step(self, points, T_map_sensor):
        """Rebuild the cloud and its normals with a new scan."""
        self.fill(points, T_map_sensor)
        together = open3d.utility.Vector3dVector(np.concatenate(self._scans))
        self._cloud = open3d.geometry.PointCloud(together).voxel_down_sample(self._size_m)
        near = open3d.geometry.KDTreeSearchParamHybrid(radius=2.0 * self._size_m, max_nn=30)
        self._cloud.estimate_normals(near)
        self._cloud.orient_normals_towards_camera_location(T_map_sensor[:3, 3])

    @property
    def num_voxels(self):
        """Points of the cloud, one a voxel."""
        return len(self._cloud.points)
