# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Distance, gradient and state at points, against a field given by an equation."""

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.queries import FREE, OCCUPIED, sample, states, UNKNOWN
from test.tsdf.scenes import fused, image_of, SMALL, voxels

SLOPE, AT = np.array([0.3, -0.5, 0.8]), 0.04


def linear_field():
    """Return blocks about the origin that hold a linear function of the place."""
    blocks = BlockMap(TsdfConfig(voxel_size_m=0.1, truncation_m=0.3, voxels_per_side=4))
    index = np.indices((4, 4, 4)).reshape(3, -1).T - 2
    rows = blocks.place(index)
    blocks.field[rows, 1] = 1.0
    local = np.indices((4, 4, 4)).reshape(3, -1)[::-1].T
    centres = (blocks.index(rows)[:, None] * 4 + local + 0.5) * 0.1
    blocks.field[rows, 0] = centres @ SLOPE + AT
    return blocks


def test_a_linear_field_is_read_exactly_across_blocks_and_zero():
    points = np.random.default_rng(1).uniform(-0.74, 0.74, (2000, 3))
    found = sample(linear_field(), points)
    np.testing.assert_allclose(found.distance, points @ SLOPE + AT, atol=1e-6)
    np.testing.assert_allclose(found.gradient, [SLOPE] * 2000, atol=1e-5)


def test_points_with_a_missing_voxel_among_eight_are_unknown():
    blocks = linear_field()
    row = blocks.find([0, 0, 0])
    blocks.field[row, 1, 0] = 0.5  # the voxel at (0.05, 0.05, 0.05)
    points = [[0.07, 0.07, 0.07], [0.03, 0.03, 0.03], [0.17, 0.07, 0.07], [0.05, 0.05, 0.05]]
    known = np.isfinite(sample(blocks, points, min_weight=1.0).distance)
    assert known.tolist() == [False, False, True, False]
    assert np.isfinite(sample(blocks, points).distance).all()
    outside = [[9.0, 0, 0], [0.79, 0, 0], [np.nan, 0, 0], [0, np.inf, 0], [1e300, 0, 0]]
    found = sample(blocks, outside)
    assert np.isnan(found.distance).all()
    assert np.isnan(found.gradient).all()
    assert (states(blocks, outside[2:]) == UNKNOWN).all()


def test_states_are_those_of_the_voxel_that_a_point_is_in():
    blocks = fused(image_of(SMALL, np.full((60, 80), 2.0)), voxel_size_m=0.1, truncation_m=0.3)
    centres, D, _ = voxels(blocks)
    aside = np.random.default_rng(2).uniform(-0.049, 0.049, centres.shape)
    found = states(blocks, centres + aside)
    np.testing.assert_array_equal(found, np.where(D <= 0.05, OCCUPIED, FREE))
    assert {FREE, OCCUPIED} == {*np.unique(found)}
    assert states(blocks, [[0, 0, 1.0], [0, 0, 2.0], [0, 0, 5.0]]).tolist() == [1, 2, 0]
    assert states(blocks, [[0, 0, 1.85]], occupied_up_to_m=0.25).tolist() == [OCCUPIED]


def test_the_gradient_points_to_the_sensor():
    blocks = fused(image_of(SMALL, 2.0 * SMALL.ray_length), voxel_size_m=0.05, truncation_m=0.15)
    found = sample(blocks, [[0.01, 0.02, 1.97], [0.3, 0.1, 2.03]])
    np.testing.assert_allclose(found.distance, [0.03, -0.03], atol=1e-3)
    assert (found.gradient[:, 2] < -0.99).all()


def test_points_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r'expected \(P, 3\)'):
        sample(linear_field(), [1.0, 2.0, 3.0])
    assert len(sample(linear_field(), np.empty((0, 3))).distance) == 0
