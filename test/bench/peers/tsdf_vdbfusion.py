# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""VDBFusion: a volume of VDB leaves, traversed by the ray of every point."""

from __future__ import annotations

import numpy as np
from vdbfusion import VDBVolume


class Peer:
    """A volume fed with points."""

    def __init__(self, job):
        self._volume = VDBVolume(job['voxel_size_m'], job['truncation_m'], job['carve'])

    def prepared(self, data, pose):
        """Return finite points in the map frame, prepared outside the timed part."""
        points = data[np.isfinite(data).all(axis=1)].astype(np.float64)
        return points @ pose[:3, :3].T + pose[:3, 3]

    def integrate(self, data, pose):
        """Fuse a scan."""
        self._volume.integrate(data, pose)

    def mesh(self):
        """Return vertices and triangles, of voxels that were observed."""
        vertices, triangles = self._volume.extract_triangle_mesh(fill_holes=False, min_weight=0.5)
        return np.asarray(vertices), np.asarray(triangles)
