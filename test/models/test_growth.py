# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Planes that grow over sparse points in coarse voxels."""

from __future__ import annotations

import numpy as np

from surfel_mapper.models.growth import extend_planes
from surfel_mapper.models.thinning import thin

NOISE_M, COARSE_M, TOLERANCE_M = 0.01, 0.8, 0.02


def test_planes_take_the_sparse_points_on_them_and_no_others():
    rng = np.random.default_rng(2)
    near = rng.uniform([0.0, 0.0, 0.0], [4.0, 4.0, 0.0], (4000, 3))
    far = rng.uniform([4.0, 0.0, 0.0], [12.0, 4.0, 0.0], (150, 3))
    above = rng.uniform([4.0, 0.0, 0.15], [12.0, 4.0, 0.6], (150, 3))
    apart = rng.uniform([16.0, 0.0, 0.0], [18.0, 4.0, 0.0], (50, 3))
    parts = [near, far, above, apart]
    points = np.concatenate(parts)
    points[:, 2] += NOISE_M * rng.standard_normal(len(points))
    kind = np.repeat(np.arange(4), [len(part) for part in parts])
    coarse = thin(points, COARSE_M).by_voxel()
    kind = kind[coarse.rows]

    owner = np.where(kind == 0, 0, -1).astype(np.int32)
    extend_planes(coarse, owner, np.array([False]), (COARSE_M, TOLERANCE_M))
    assert (owner[kind == 0] == 0).all()
    assert (owner[kind == 1] == 0).mean() > 0.95
    assert (owner[kind >= 2] == -1).all()

    owner = np.where(kind == 0, 0, -1).astype(np.int32)
    extend_planes(coarse, owner, np.array([True]), (COARSE_M, TOLERANCE_M))
    assert (owner[kind > 0] == -1).all()
