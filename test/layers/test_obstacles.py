# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Slices of small fields, against brute force over their voxels."""

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.layers.distance_field.obstacles import clearance_slice, slice_at
from surfel_mapper.tsdf.blocks import BlockMap
from test.tsdf.test_mesh import blocks_of, centers, VOXEL_M

FIRST = (-1, 2, 0)
SHAPE = (12, 8, 8)


@pytest.fixture
def scene():
    """Return blocks with a wall and a post, part of which was never observed."""
    places = centers(SHAPE, FIRST)
    wall = places[..., 0] - (-0.25)
    post = np.linalg.norm(places[..., :2] - [0.45, 1.15], axis=-1) - 0.08
    distance = np.minimum(wall, post).astype(np.float32)
    weight = np.where(places[..., 1] > 1.45, 0.0, 1.0)
    return blocks_of(distance, FIRST, weight=weight), distance, weight, places


def states_of(distance, weight):
    """Return -1 unknown, 0 free, 100 occupied."""
    return np.where(weight == 0.0, -1, np.where(distance <= 0.5 * VOXEL_M, 100, 0))


def test_a_slice_shows_what_is_free_occupied_and_unknown(scene):
    blocks, distance, weight, _ = scene
    found = slice_at(blocks, 0.37)
    assert np.array_equal(found.cost.T, states_of(distance, weight)[:, :, 3])
    assert found.resolution_m == VOXEL_M
    assert found.origin == pytest.approx([-0.4, 0.8])
    assert set(np.unique(found.cost)) == {-1, 0, 100}


def test_a_slice_where_nothing_was_seen_is_empty(scene):
    blocks, *_ = scene
    assert slice_at(blocks, 5.0).cost.shape == (0, 0)
    assert slice_at(BlockMap(TsdfConfig()), 0.0).cost.shape == (0, 0)


def test_costs_of_the_slice_fall_with_the_distance_to_obstacles_between_its_heights(scene):
    blocks, distance, weight, places = scene
    found = clearance_slice(blocks, (0.2, 0.45), 0.3)
    layers = slice(2, 5)
    states = states_of(distance, weight)[:, :, layers]
    occupied, seen = (states == 100).any(axis=2), (states >= 0).any(axis=2)
    flat = places[:, :, 0, :2]
    near = np.linalg.norm(flat[:, :, None] - flat[occupied], axis=-1).min(axis=2)
    expected = np.minimum(np.rint(100.0 * (1.0 - np.minimum(near, 0.3) / 0.3)), 99)
    expected = np.where(occupied, 100, np.where(seen, expected, -1))
    assert np.array_equal(found.cost.T, expected)
    assert {-1, 0, 67, 100} <= set(np.unique(found.cost))
    assert found.origin == pytest.approx([-0.4, 0.8])


def test_the_slice_of_costs_is_limited_to_the_radius(scene):
    blocks, *_ = scene
    found = clearance_slice(blocks, (0.2, 0.45), 0.5, center=(0.2, 1.0), radius_m=0.3)
    assert found.cost.shape == (4, 4)  # the block about (0.2, 1.0)
    assert clearance_slice(blocks, (5.0, 6.0), 0.5).cost.shape == (0, 0)
