# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Planes that grow over sparse points in coarse voxels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from surfel_mapper.models.coarse_growth import (
    CoarseRules,
    gap_pieces,
    grow_coarse,
    in_scatter,
    join_coarse,
)
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


def test_planes_grow_over_single_points_far_apart():
    rng = np.random.default_rng(3)
    near = rng.uniform([0.0, 0.0, 0.0], [32.0, 12.0, 0.0], (20_000, 3))
    x, y = np.meshgrid(np.arange(33.0, 60.0, 3.0), [1.0, 5.0, 9.0])
    far = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    above = far + np.array([0.0, 0.0, 1.0])
    points = np.concatenate([near, far, above])
    points[:, 2] += NOISE_M * rng.standard_normal(len(points))
    owner = np.full(len(points), -1, np.int32)
    owner[: len(near)] = near[:, 0] > 16.0  # two pieces of one plane
    shape = np.tile([0.0, 0.0, 1.0], (2, 1)), np.zeros(2, np.bool_)
    rules = CoarseRules(COARSE_M, TOLERANCE_M, (NOISE_M, 0.0))
    normals, curved = grow_coarse(points, owner, shape, 4.0 * COARSE_M, rules)
    assert len(normals) == len(curved) == 2
    np.testing.assert_array_equal(owner[: len(near)], near[:, 0] > 16.0)
    assert (owner[len(near) : -len(above)] >= 0).mean() > 0.9
    assert (owner[-len(above) :] == -1).all()


def test_a_plane_is_in_scatter_if_points_of_any_patch_are_on_both_sides():
    rng = np.random.default_rng(6)
    parts = []
    for place, heights in enumerate([(0.0,), (0.0, 0.4), (0.0, 0.4, -0.4), (0.0, 0.1, -0.1)]):
        for height in heights:
            xy = rng.uniform([10.0 * place, 0.0], [10.0 * place + 3.0, 3.0], (600, 2))
            parts.append(np.column_stack([xy, height + 0.05 * rng.standard_normal(600)]))
    voxels = thin(np.concatenate(parts), 0.5).by_voxel()
    owner = np.repeat(np.arange(9, dtype=np.int32), 600)[voxels.rows]
    curved = np.zeros(9, np.bool_)
    # points of other patches count, those within three sigmas are on the plane
    assert np.flatnonzero(in_scatter(voxels, owner, curved, 0.5)).tolist() == [3]
    owner[owner > 3] = -1  # so do those of none
    assert np.flatnonzero(in_scatter(voxels, owner, curved, 0.5)).tolist() == [3]
    flat = voxels.points.copy()
    flat[owner == 3, 2] *= 0.2  # a thin plane is a surface
    thin_voxels = replace(voxels, points=flat)
    assert not in_scatter(thin_voxels, owner, curved, 0.5).any()
    curved[3] = True
    assert not in_scatter(voxels, owner, curved, 0.5).any()


def test_wide_patches_of_one_plane_are_joined_across_a_gap():
    rng = np.random.default_rng(4)
    wide = [(0.0, 6.0, 0.0), (8.0, 14.0, 0.0), (8.0, 14.0, 0.5)]  # first and last x, height
    small = [(30.0, 30.4, 0.0), (32.0, 32.4, 0.0)]
    parts = []
    for low, high, height in wide + small:
        number = 400 * int(np.ceil(high - low))
        x, y = rng.uniform(low, high, number), rng.uniform(0.0, min(high - low, 4.0), number)
        parts.append(np.column_stack([x, y, height + NOISE_M * rng.standard_normal(number)]))
    patch = np.repeat(np.arange(len(parts), dtype=np.int32), [len(part) for part in parts])
    voxels = thin(np.concatenate(parts), COARSE_M).by_voxel()
    patch = patch[voxels.rows]
    owner = np.where(np.arange(len(patch)) % 50, patch, -7).astype(np.int32)
    free = owner < 0
    shape = np.tile([0.0, 0.0, 1.0], (5, 1)), np.zeros(5, np.bool_)
    rules = CoarseRules(COARSE_M, TOLERANCE_M, (NOISE_M, 0.0), np.array([7.0, 2.0, 9.0]))
    pieces = gap_pieces(voxels, owner, 5, 4.0 * COARSE_M)
    normals, curved = join_coarse(pieces, owner, shape, rules)
    assert (owner[free] == -7).all()
    regions = [np.unique(owner[~free & (patch == k)]).tolist() for k in range(5)]
    assert regions[0] == regions[1]
    assert sorted(np.concatenate(regions[1:]).tolist()) == [0, 1, 2, 3]
    assert curved.tolist() == [False] * 4
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, 1.0], (4, 1)), atol=0.01)
