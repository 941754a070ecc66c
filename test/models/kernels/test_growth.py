# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Voxel neighbours, noise and region growing against brute force and known scenes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surfel_mapper.models.cloud_noise import (
    block_noise,
    estimate_noise,
    neighbourhoods,
)
from surfel_mapper.models.growth import free_surfels
from surfel_mapper.models.kernels.growth import (
    find_facets,
)
from surfel_mapper.models.thinning import thin
from test.kernels.modes import both

SIZE = 0.1


def corner(step=0.02, sigma=0.0):
    """Return points on three faces of a cube seen from inside, and the face of each."""
    u, v = np.meshgrid(np.arange(0.01, 0.6, step), np.arange(0.01, 0.6, step))
    zero, rng = np.zeros(u.size), np.random.default_rng(1)
    flat = u.ravel(), v.ravel(), zero
    faces = [np.stack(np.roll(flat, k, axis=0), axis=1) for k in range(3)]
    points = np.add(np.concatenate(faces), [0.03, 0.04, 0.05])
    points += sigma * rng.standard_normal(points.shape)
    return points, np.repeat([2, 0, 1], u.size)


def by_voxel(points, size=SIZE):
    thinned = thin(points, size)
    return thinned, thinned.by_voxel()


@pytest.mark.parametrize(
    'extent',
    [
        (1.0, 0.3, 0.6),
        (1.0, 0.1, 1.0),
        (0.1, 1.0, 1.0),
        (1.0, 0.2, 1.0),
        (0.2, 1.0, 1.0),
        (0.1, 0.1, 9.0),
        (0.2, 0.1, 5.0),
    ],
)  # walls and poles one or two voxels thick
def test_neighbours_equal_brute_force(extent):
    points = np.random.default_rng(2).uniform(0.0, 1.0, (150, 3)) * extent
    thinned, voxels = by_voxel(points)
    index = np.floor(thinned.means / SIZE).astype(int)
    first, rows = voxels.adjacent
    for i in range(len(index)):
        near = np.abs(index - index[i]).max(axis=1) == 1
        assert sorted(rows[first[i] : first[i + 1]].tolist()) == np.flatnonzero(near).tolist()


@pytest.mark.parametrize(('radius', 'outliers'), [(0.6, 0), (1e3, 0), (1e3, 900)])
def test_noise_of_blocks_is_that_of_the_points_without_outliers(radius, outliers):
    rng = np.random.default_rng(6)
    xy = rng.uniform(-0.2, 0.2, (9000, 2))
    z = np.sqrt(radius**2 - (xy**2).sum(axis=1)) - radius
    points = np.column_stack([xy, z + 0.004 * rng.standard_normal(len(xy))])
    points[:outliers, 2] = rng.uniform(-0.1, 0.1, outliers)
    _, voxels = by_voxel(points, 0.05)
    full = np.flatnonzero(np.diff(voxels.starts) > 30)[:40]
    blocks, above = neighbourhoods(voxels, full), np.array([0.0, 0.0, 9.0])
    sigma = block_noise(voxels, blocks, above, 120)
    assert np.median(sigma) == pytest.approx(0.004, rel=0.15)
    aside = np.array([9.0, 0.0, 9.0 * math.sqrt(1.0 / 3.0)])  # 60 degrees from the normal
    across, sigma = sigma, block_noise(voxels, blocks, aside, 120)
    if radius > 1.0:  # noise is along the ray
        assert np.median(sigma) == pytest.approx(2.0 * np.median(across), rel=0.02)


def test_noise_grows_with_the_square_of_the_range():
    rng, parts = np.random.default_rng(7), []
    for far in (1.0, 2.0, 3.0, 4.0):
        xy = rng.uniform(-0.6, 0.6, (40_000, 2))
        z = far + 1.5e-3 * far**2 * rng.standard_normal(len(xy))
        parts.append(np.column_stack([xy, z]))
    points = np.concatenate(parts)
    thinned, voxels = by_voxel(points, 0.06)
    core = np.ones(len(thinned.means), bool)
    n0, n2 = estimate_noise(voxels, thinned.means, core, 0.06, np.zeros(3))
    for far in (2.0, 3.0, 4.0):
        assert n0 + n2 * far**2 == pytest.approx(1.5e-3 * far**2, rel=0.4)


@both
def test_facets_of_a_corner_are_its_faces(call):
    points, face = corner(step=0.03, sigma=1e-3)
    _, voxels = by_voxel(points)
    face = face[voxels.rows]
    owner = np.full(len(face), -1, np.int32)
    free = free_surfels(voxels, owner, SIZE, 0.02)
    np.testing.assert_array_equal(free[0], np.diff(voxels.starts))
    order = np.flatnonzero(free[1])
    assert len(order)
    planes, state = np.empty((10, 4)), (voxels.points, voxels.starts, voxels.adjacent)
    rules = 0.005, 3, 30, math.cos(math.radians(25)), 0.1
    num = call(find_facets, *state, free, order, rules, owner, planes, 0)
    assert num == 3
    for k in range(3):
        own = face[owner == k]
        side = np.bincount(own).argmax()
        assert (own == side).mean() > 0.95
        assert abs(planes[k, side]) > 0.999
    assert (owner >= 0).mean() > 0.97
