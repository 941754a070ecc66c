# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Euclidean distances of a field, against scipy's transform of the whole field."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import ConfigError
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.euclidean import EuclideanField
from test.tsdf.test_mesh import blocks_of, centers, SIDE, VOXEL_M, write

FIRST = (-2, -3, -1)
SHAPE = (32, 28, 20)
MAX_M = 0.75


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def scenery(rng, share=0.004):
    """Return a field of a floor, a wall, and voxels scattered at random, (x, y, z) m."""
    distance = np.where(rng.random(SHAPE) < share, -0.05, 0.2)
    distance[:, :, 3] = distance[20] = 0.0
    return distance.astype(np.float32)


def expected(distance, weight=None):
    """Return the distances by scipy, m; nan for voxels that were not observed."""
    occupied = distance <= 0.5 * VOXEL_M
    if weight is not None:
        occupied &= weight > 0.0
    found = np.full(distance.shape, MAX_M)
    if occupied.any():
        found = np.minimum(distance_transform_edt(~occupied, sampling=VOXEL_M), MAX_M)
    # max_m is 7.5 voxels: squares up to 56 are kept
    return found if weight is None else np.where(weight > 0.0, found, np.nan)


def sampled(field):
    return field.sample(centers(SHAPE, FIRST).reshape(-1, 3)).reshape(SHAPE)


def test_distances_of_a_new_field_equal_the_transform(rng):
    distance = scenery(rng)
    weight = np.where(rng.random(SHAPE) < 0.9, 1.0, 0.0)
    field = EuclideanField(blocks_of(distance, FIRST, weight=weight), max_m=MAX_M)
    field.update()
    np.testing.assert_allclose(sampled(field), expected(distance, weight), atol=1e-6)


@pytest.mark.parametrize('share', [0.0005, 0.02, 0.5])
def test_distances_after_changes_equal_the_transform_of_the_whole(rng, share):
    distance = scenery(rng)
    blocks = blocks_of(distance, FIRST)
    field = EuclideanField(blocks, max_m=MAX_M)
    field.update()
    for _ in range(4):
        flips = rng.random(SHAPE) < share
        distance = np.where(flips, np.where(distance < 0.1, 0.2, -0.02), distance)
        distance = distance.astype(np.float32)
        write(blocks, distance, FIRST)
        field.update()
        np.testing.assert_allclose(sampled(field), expected(distance), atol=1e-6)


def test_blocks_that_leave_and_come_are_followed(rng):
    distance = scenery(rng, share=0.02)
    blocks = blocks_of(distance, FIRST)
    field = EuclideanField(blocks, max_m=MAX_M)
    field.update()
    gone = blocks.index(blocks.rows())[:, 0] >= 2
    blocks.remove(blocks.rows()[gone])
    write(blocks, np.full((8, 8, 8), 0.0, np.float32), (40, 40, 40))  # takes rows of the others
    field.update()
    left = np.where(np.arange(SHAPE[0])[:, None, None] < 16, distance, 1.0)
    known = np.where(np.arange(SHAPE[0])[:, None, None] < 16, expected(left), np.nan)
    np.testing.assert_allclose(sampled(field), np.broadcast_to(known, SHAPE), atol=1e-6)
    write(blocks, distance, FIRST)
    field.update()
    np.testing.assert_allclose(sampled(field), expected(distance), atol=1e-6)


def test_distances_within_the_radius_follow_the_place(rng):
    distance = scenery(rng, share=0.02)
    blocks = blocks_of(distance, FIRST)
    field = EuclideanField(blocks, max_m=MAX_M, radius_m=1.0)
    ends = [(-0.6, 0.0, 0.3), (2.2, 0.0, 0.3), (-0.6, 0.0, 0.3)]
    for number, center in enumerate(ends):
        field.update(center)
        found, true = sampled(field), expected(distance)
        inside = np.linalg.norm(centers(SHAPE, FIRST) - center, axis=-1) < 1.0 - 0.4
        assert np.isfinite(found[inside]).all()
        assert np.isnan(found).any()
        kept = np.isfinite(found)
        np.testing.assert_allclose(found[kept], true[kept], atol=1e-6)
        distance = scenery(np.random.default_rng(number), share=0.02)
        write(blocks, distance, FIRST)


def test_known_distances_are_those_of_the_observed_voxels(rng):
    distance = scenery(rng)
    weight = np.where(rng.random(SHAPE) < 0.7, 1.0, 0.0)
    field = EuclideanField(blocks_of(distance, FIRST, weight=weight), max_m=MAX_M)
    field.update()
    known = field.known()
    assert len(known.points) == (weight > 0.0).sum()
    np.testing.assert_array_equal(field.sample(known.points), known.distance)
    index = np.floor(known.points / VOXEL_M).astype(int) - np.multiply(FIRST, SIDE)
    assert (weight[tuple(index.T)] > 0.0).all()


def test_places_outside_of_the_map_are_unknown():
    field = EuclideanField(BlockMap(TsdfConfig()), max_m=1.0)
    field.update()
    assert np.isnan(field.sample([(0.0, 0.0, 0.0), (np.nan, 0.0, 0.0), (1e30, 0.0, 0.0)])).all()
    assert len(field.known().points) == 0
    with pytest.raises(ValueError, match=r'points: \(3,\), expected \(P, 3\)'):
        field.sample((0.0, 0.0, 0.0))


@pytest.mark.parametrize('max_m', [0.05, 13.0, float('nan')])
def test_reaches_below_a_voxel_or_beyond_127_are_refused(max_m):
    with pytest.raises(ConfigError, match=r'esdf.max_m: .*1 to 127 voxels'):
        EuclideanField(BlockMap(TsdfConfig()), max_m=max_m)


def test_a_block_far_below_the_one_before_it_is_looked_up_anew():
    blocks = blocks_of(np.zeros((SIDE, SIDE, SIDE), np.float32), (0, 0, 40))
    write(blocks, np.full((SIDE, SIDE, SIDE), 0.2, np.float32))
    field = EuclideanField(blocks, max_m=MAX_M)
    field.update()
    np.testing.assert_allclose(field.sample(centers((SIDE, SIDE, SIDE)).reshape(-1, 3)), MAX_M)
