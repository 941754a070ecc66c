# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Open3D's VoxelBlockGrid: hashed blocks of 16 voxels a side, those in the depth image."""

from __future__ import annotations

import numpy as np
import open3d
from open3d import core

MAX_BLOCKS = 50_000


class Peer:
    """A grid of distance and weight, without colour."""

    def __init__(self, job):
        self._far_m = job['max_range_m']
        self._tau_voxels = job['truncation_m'] / job['voxel_size_m']
        self._intrinsic = core.Tensor(np.array(job['intrinsic']), core.float64)
        self._grid = open3d.t.geometry.VoxelBlockGrid(
            ('tsdf', 'weight'),
            (core.float32, core.float32),
            ((1,), (1,)),
            job['voxel_size_m'],
            16,
            MAX_BLOCKS,
            core.Device('CPU:0'),
        )

    def prepared(self, data, pose):
        """Return image and extrinsic in the form of Open3D."""
        image = open3d.t.geometry.Image(core.Tensor(data))
        return image, core.Tensor(np.linalg.inv(pose), core.float64)

    def integrate(self, data, pose):
        """Fuse an image."""
        image, extrinsic = data
        sizes = 1.0, self._far_m, self._tau_voxels
        blocks = self._grid.compute_unique_block_coordinates(
            image, self._intrinsic, extrinsic, *sizes
        )
        self._grid.integrate(blocks, image, self._intrinsic, extrinsic, *sizes)

    def mesh(self):
        """Return vertices and triangles."""
        mesh = self._grid.extract_triangle_mesh(weight_threshold=0.5)
        return mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()
