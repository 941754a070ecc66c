# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Normals of points by Open3D, from their nearest neighbours."""

from __future__ import annotations

import numpy as np
import open3d


def normals(points, support):
    """Return the normals of points, (N, 3) each."""
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(support))
    return np.asarray(cloud.normals)
