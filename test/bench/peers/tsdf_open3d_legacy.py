# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Open3D's ScalableTSDFVolume; in 0.20 its extraction returns nothing."""

from __future__ import annotations

import numpy as np
import open3d


class Peer:
    """A volume of distance and weight, without colour."""

    def __init__(self, job):
        intrinsic = np.array(job['intrinsic'])
        self._far_m = job['max_range_m']
        self._intrinsic = open3d.camera.PinholeCameraIntrinsic(
            job['columns'], job['rows'], *intrinsic[[0, 1, 0, 1], [0, 1, 2, 2]]
        )
        self._volume = open3d.pipelines.integration.ScalableTSDFVolume(
            job['voxel_size_m'],
            job['truncation_m'],
            open3d.pipelines.integration.TSDFVolumeColorType.NoColor,
        )

    def prepared(self, data, pose):
        """Return image and extrinsic in the form of Open3D."""
        black = open3d.geometry.Image(np.zeros((*data.shape, 3), np.uint8))
        image = open3d.geometry.RGBDImage.create_from_color_and_depth(
            black, open3d.geometry.Image(data), 1.0, self._far_m, convert_rgb_to_intensity=False
        )
        return image, np.linalg.inv(pose)

    def integrate(self, data, pose):
        """Fuse an image."""
        image, extrinsic = data
        self._volume.integrate(image, self._intrinsic, extrinsic)

    def mesh(self):
        """Return vertices and triangles."""
        mesh = self._volume.extract_triangle_mesh()
        return np.asarray(mesh.vertices), np.asarray(mesh.triangles)
