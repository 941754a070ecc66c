# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Distance, gradient, state and label at points.

The field is given by an equation; T14: labels of voxels, against sums kept by hand.
"""

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.kernels.channels import fuse_labels
from surfel_mapper.tsdf.queries import (
    FREE,
    labels_at,
    labels_of,
    OCCUPIED,
    sample,
    states,
    UNKNOWN,
)
from test.tsdf.scenes import fused, image_of, integrator, SMALL, voxels

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
    points = [[0.07, 0.07, 0.07], [0.03, 0.03, 0.03], [0.17, 0.07, 0.07], [0.05, 0.05, 0.05]]
    assert np.isfinite(sample(blocks, points).distance).all()
    blocks.field[blocks.find([0, 0, 0]), 1, 0] = 0.0  # the voxel at (0.05, 0.05, 0.05)
    known = np.isfinite(sample(blocks, points).distance)
    assert known.tolist() == [False, False, True, False]
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


def test_points_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r'expected \(P, 3\)'):
        sample(linear_field(), [1.0, 2.0, 3.0])
    assert len(sample(linear_field(), np.empty((0, 3))).distance) == 0


def votes_after(measured):
    """Return the votes of voxels, (2, N), after rows of labels, -1 for unknown."""
    votes, signed = np.zeros((2, measured.shape[1]), np.float32), np.zeros(measured.shape[1])
    tau, most, rate = np.float32(1.0), np.float32(1e5), np.float32(0.0)
    for label in measured.astype(np.int32):
        weight = np.full(len(label), 0.01, np.float32)
        fuse_labels(tau, most, rate, label, signed.astype(np.float32), weight, votes)
    return votes


def test_a_single_label_follows_the_majority_vote():
    measured = np.array([[3, 3], [4, 4], [4, 5], [5, 5], [5, -1]])
    # 3: 1; 4: 0 (equal: takes it); 4: 1; 5: 0; 5: 1.
    # 3: 1; 4: 0; 5: 1; 5: 2; unknown: nothing.
    labels, lead = labels_of(votes_after(measured), 1)
    assert labels.tolist() == [5, 5]
    assert lead.tolist() == [1.0, 2.0]
    assert labels_of(votes_after(measured), 2)[0].tolist() == [-1, 5]
    majority = np.array([[1], [2], [1], [3], [1], [1], [2], [1]])  # 5 of 8
    assert labels_of(votes_after(majority), 1)[0].tolist() == [1]
    tie = np.array([[1], [2], [2], [1]])
    assert [values.tolist() for values in labels_of(votes_after(tie), 1)] == [[-1], [0.0]]


@pytest.mark.parametrize('confidence', [0.6, 0.7, 0.75, 0.8, 0.9, 0.99])
def test_a_voxel_has_the_label_of_nine_tenths_of_the_posterior(confidence):
    measured = np.random.default_rng(2).choice([2, 8], (15, 400), p=[0.35, 0.65])
    likelihood = [
        np.where(measured == label, confidence, 1.0 - confidence).prod(axis=0) for label in (2, 8)
    ]
    posterior = likelihood / np.sum(likelihood, axis=0)
    expected = np.where(posterior[0] > 0.9 - 1e-9, 2, np.where(posterior[1] > 0.9 - 1e-9, 8, -1))
    least_lead = TsdfConfig(label_confidence=confidence).label_lead
    labels, _ = labels_of(votes_after(measured), least_lead)
    np.testing.assert_array_equal(labels, expected)


def test_a_voxel_never_labelled_has_no_label():
    assert labels_of(np.zeros((2, 5), np.float32), 1)[0].tolist() == [-1] * 5


def test_labels_at_points_are_those_of_the_wall_that_was_seen():
    one = integrator(voxel_size_m=0.1, truncation_m=0.3, semantics='single')
    wall = image_of(SMALL, np.full((60, 80), 2.0))
    left = np.arange(80) * np.ones((60, 1)) < 40
    one.integrate(wall.with_images(label=np.where(left, 0, 3)), np.eye(4))
    points = [[-0.25, 0.02, 1.97], [0.25, 0.02, 1.97], [0.25, 0.02, 1.0], [0, 0, 50.0]]
    strange = [[np.nan, 0, 2], [0, np.inf, 2], [1e300, 0, 0], [2e5, 0, 0]]
    label, weight = labels_at(one.blocks, points + strange)
    assert label.tolist() == [0, 3, *[-1] * 6]
    assert (weight[:2] > 0.0).all()
    assert not weight[2:].any()


def test_labels_at_no_point_are_none_and_bad_requests_are_refused():
    blocks = BlockMap(TsdfConfig(semantics='single'))
    assert [len(found) for found in labels_at(blocks, np.empty((0, 3)))] == [0, 0]
    assert labels_at(blocks, [[1.0, 2.0, 3.0]])[0].tolist() == [-1]
    with pytest.raises(ValueError, match=r'expected \(P, 3\)'):
        labels_at(blocks, [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match='keeps labels'):
        labels_at(BlockMap(TsdfConfig()), [[1.0, 2.0, 3.0]])
