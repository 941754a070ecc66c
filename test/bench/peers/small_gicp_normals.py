# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Normals of points by small_gicp, from their nearest neighbours."""

from __future__ import annotations

import small_gicp


def normals(points, support):
    """Return the normals of points, (N, 3) each."""
    cloud = small_gicp.PointCloud(points)
    small_gicp.estimate_normals(cloud, num_neighbors=support, num_threads=1)
    return cloud.normals()[:, :3]
