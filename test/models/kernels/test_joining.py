# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Patches of known surfaces are joined to these surfaces, whatever the noise and their order."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.models.growth import owner_table, pieces_of
from surfel_mapper.models.joining import Comparison, join_patches
from surfel_mapper.models.thinning import thin

SIZE_M = 0.05
VIEW = np.array([4.0, 0.2, 6.0])
CYLINDER, FLOOR, WALL = range(3)
SURFACES = np.repeat([CYLINDER, FLOOR, WALL], [6, 3, 2])


def scene(sigma_m):
    """Return points of six strips of a cylinder, three tiles of a floor, two of a wall."""
    rng = np.random.default_rng(4)
    parts = []
    for k in range(6):
        angle = np.radians(rng.uniform(12.0 * k - 36.0, 12.0 * k - 24.0, 900))
        along = rng.uniform(3.0, 4.0, 900)
        parts.append(np.column_stack([np.sin(angle), along, np.cos(angle)]))
    for k in range(3):
        x, y = rng.uniform(k, k + 1, 1500), rng.uniform(0.0, 1.0, 1500)
        parts.append(np.column_stack([x, y, np.zeros(1500)]))
    for k in range(2):
        y, z = rng.uniform(0.5 * k, 0.5 * k + 0.5, 900), rng.uniform(0.0, 1.0, 900)
        parts.append(np.column_stack([np.zeros(900), y, z]))
    owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts]).astype(np.int32)
    points = np.concatenate(parts)
    return points + sigma_m * rng.standard_normal(points.shape), owner


def pieces(points, owner):
    voxels = thin(points, SIZE_M).by_voxel()
    return pieces_of(voxels, owner_table(voxels, owner[voxels.rows]), int(owner.max()) + 1)


@pytest.mark.parametrize('sigma_m', [0.01, 0.015])
@pytest.mark.parametrize('seed', [0, 1])
def test_patches_of_one_surface_are_joined_and_no_others(sigma_m, seed):
    points, owner = scene(sigma_m)
    renumbered = np.random.default_rng(seed).permutation(len(SURFACES)).astype(np.int32)
    given = pieces(points, renumbered[owner])
    index, normals, curved = join_patches(given, VIEW, (sigma_m, 0.0), SIZE_M)
    of_patch = index[renumbered]
    assert len(normals) == 3
    for surface in (CYLINDER, FLOOR, WALL):
        (region,) = set(of_patch[surface == SURFACES].tolist())
        assert curved[region] == (surface == CYLINDER)
    np.testing.assert_allclose(normals[of_patch[6]], [0.0, 0.0, 1.0], atol=0.02)
    np.testing.assert_allclose(normals[of_patch[-1]], [1.0, 0.0, 0.0], atol=0.02)


def test_joins_that_are_much_worse_planes_than_their_patches_are_undone():
    rng = np.random.default_rng(6)
    x, y = rng.uniform(0.0, 8.0, 20_000), rng.uniform(0.0, 1.0, 20_000)
    owner = np.floor(x).astype(np.int32)
    steps = np.where((owner < 6) & (owner % 2 == 0), 0.1, 0.0)  # six stairs up and down, a floor
    z = steps + 0.005 * rng.standard_normal(len(x))
    given = pieces(np.column_stack([x, y, z]), owner)
    comparison = Comparison.of(given, VIEW, (0.005, 0.0), SIZE_M)
    root = np.array([0, 0, 0, 0, 0, 0, 6, 6])
    index, _, curved, is_worse = comparison.described(root, SIZE_M)
    assert index.tolist() == [0, 0, 0, 0, 0, 0, 1, 1]
    assert (curved.tolist(), is_worse.tolist()) == ([False, False], [True, False])
    index, _, curved = join_patches(given, VIEW, (0.005, 0.0), SIZE_M)
    assert not curved.any()
    assert index[6] == index[7]
    assert np.bincount(index).max() <= 3


def test_a_long_bend_is_a_few_planes_instead_of_all_its_patches():
    """Every tile continues the last one by 1 deg: a bend of 12 m, radius 57 m, sagitta 0.31 m."""
    rng = np.random.default_rng(9)
    radius_m, sigma_m = np.degrees(1.0), 0.015
    x, y = rng.uniform(-6.0, 6.0, 40_000), rng.uniform(0.0, 1.0, 40_000)
    z = radius_m - np.sqrt(radius_m**2 - x**2) + sigma_m * rng.standard_normal(len(x))
    tile, points = np.floor(x + 6.0).astype(np.int32), np.column_stack([x, y, z])
    index, _, curved = join_patches(pieces(points, tile), VIEW, (sigma_m, 0.0), SIZE_M)
    assert not curved.any()
    assert 3 <= len(curved) <= 6
    for region in range(len(curved)):
        own = points[index[tile] == region]
        assert np.linalg.eigvalsh(np.cov(own.T))[0] < (1.25 * 1.02 * sigma_m) ** 2


def test_a_rough_patch_that_bends_more_than_the_noise_is_curved():
    """Leaves of 5 cm on a dome were a plane: roughness of patches was taken for noise."""
    rng = np.random.default_rng(7)
    xy = rng.uniform(-0.5, 0.5, (20_000, 2))
    dome = -0.15 * (xy**2).sum(axis=1) + 0.05 * rng.standard_normal(len(xy))
    given = pieces(np.column_stack([xy, dome]), np.zeros(len(xy), np.int32))
    for noise_m, is_curved in ((0.01, True), (0.2, False)):
        assert join_patches(given, VIEW, (noise_m, 0.0), SIZE_M)[2].tolist() == [is_curved]


@pytest.mark.parametrize('radius_m', [0.15, 0.2, 0.25])
def test_strips_of_the_visible_side_of_a_small_cylinder_are_joined(radius_m):
    rng = np.random.default_rng(8)
    strip = np.repeat(np.arange(5, dtype=np.int32), 400)
    angle = np.radians(32.0 * (strip + rng.uniform(0.0, 1.0, 2000)) - 80.0)
    radius = radius_m + 0.003 * rng.standard_normal(2000)
    along = rng.uniform(0.0, 3.0 * SIZE_M, 2000)
    points = np.column_stack([radius * np.sin(angle), along, radius * np.cos(angle)])
    above = np.array([0.0, 0.0, 6.0])
    index, _, curved = join_patches(pieces(points, strip), above, (0.003, 0.0), SIZE_M)
    assert index.tolist() == [0, 0, 0, 0, 0]
    assert curved.tolist() == [True]
