# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Distance, gradient, state and label at points.

The field is given by an equation; T14: labels of voxels, against counts and sums kept by hand.
"""

from collections import Counter

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.kernels.channels import BINARY, FIRST_K, fuse_labels, MAJORITY, SINGLE
from surfel_mapper.tsdf.queries import (
    FREE,
    labels_at,
    labels_of,
    log_odds,
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


def test_points_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r'expected \(P, 3\)'):
        sample(linear_field(), [1.0, 2.0, 3.0])
    assert len(sample(linear_field(), np.empty((0, 3))).distance) == 0


RNG = np.random.default_rng(2)
SEEN = RNG.integers(-1, 6, (40, 50))
WEIGHTS = RNG.uniform(0.5, 2.0, (40, 50)).astype(np.float32)


def votes_after(semantics, width, seen=SEEN, weights=WEIGHTS):
    """Return the votes of voxels, (V, N), and labels lost, after rows of labels and weights."""
    votes, lost = np.zeros((width, seen.shape[1]), np.float32), 0
    signed, caps = np.zeros(seen.shape[1], np.float32), (np.float32(1e5), np.float32(0.0))
    for label, weight in zip(seen.astype(np.int32), weights.astype(np.float32), strict=True):
        content = label, signed, weight, votes
        lost += fuse_labels(semantics, np.float32(1.0), False, caps, *content)
    return votes, lost


def test_the_majority_is_that_of_the_counts_and_of_log_likelihoods():
    votes, _ = votes_after(MAJORITY, 6)
    labels, counts = labels_of('majority', votes)
    likelihood = np.full((6, SEEN.shape[1]), np.log(1 / 6))
    for label in SEEN:
        for voxel, one in enumerate(label):
            if one >= 0:
                likelihood[:, voxel] += np.where(np.arange(6) == one, np.log(0.9), np.log(0.1))
    for voxel in range(SEEN.shape[1]):
        counter = Counter(one for one in SEEN[:, voxel] if one >= 0)
        most = max(counter.values())
        assert labels[voxel] == min(one for one in counter if counter[one] == most)
        assert counts[voxel] == most
    np.testing.assert_array_equal(labels, likelihood.round(6).argmax(axis=0))
    odds = log_odds(votes, 0.9)
    np.testing.assert_allclose(odds - odds[:1], likelihood - likelihood[:1], atol=1e-4)


def test_the_first_k_labels_are_kept_with_their_weights_and_others_counted():
    votes, lost = votes_after(FIRST_K, 2 * 3)
    labels, weights = labels_of('first_k', votes)
    expected_lost = 0
    for voxel in range(SEEN.shape[1]):
        slots = {}
        for label, weight in zip(SEEN[:, voxel], WEIGHTS[:, voxel], strict=True):
            if label < 0:
                continue
            if label in slots or len(slots) < 3:
                slots[label] = slots.get(label, 0.0) + weight
            else:
                expected_lost += 1
        assert labels[voxel] == max(slots, key=slots.get)
        assert weights[voxel] == pytest.approx(max(slots.values()), rel=1e-5)
    assert lost == expected_lost > 0
    assert (labels_of('first_k', votes, min_weight=1e6)[0] == -1).all()


def test_a_single_label_follows_the_weighted_majority_vote():
    seen = np.array([[3, 3], [4, 4], [4, 5], [5, 5], [5, -1]])
    weights = np.array([[2, 1], [1, 1], [3, 1], [1, 1], [1, 9]], np.float32)
    # 3: 2; 3: 1; 4: 2 (takes it with 3 - 1); 4: 1; 5: 0 (equal: takes it).
    # 3: 1; 4: 0; 5: 1; 5: 2; unknown: nothing.
    votes, _ = votes_after(SINGLE, 2, seen, weights)
    labels, lead = labels_of('single', votes)
    assert labels.tolist() == [5, 5]
    assert lead.tolist() == [0.0, 2.0]
    majority = np.array([[1], [2], [1], [3], [1], [1], [2], [1]])  # 5 of 8
    votes, _ = votes_after(SINGLE, 2, majority, np.ones((8, 1), np.float32))
    assert labels_of('single', votes)[0].tolist() == [1]


def test_binary_counts_label_zero_against_all_others_and_not_unknown():
    votes, _ = votes_after(BINARY, 2)
    np.testing.assert_array_equal(votes[0], (SEEN == 0).sum(axis=0))
    np.testing.assert_array_equal(votes[1], (SEEN > 0).sum(axis=0))
    labels, _ = labels_of('binary', votes)
    np.testing.assert_array_equal(labels, (SEEN > 0).sum(axis=0) > (SEEN == 0).sum(axis=0))


@pytest.mark.parametrize('semantics', ['majority', 'first_k', 'single', 'binary'])
def test_a_voxel_never_labelled_has_no_label(semantics):
    assert labels_of(semantics, np.zeros((4, 5), np.float32))[0].tolist() == [-1] * 5


@pytest.mark.parametrize('semantics', ['majority', 'first_k', 'single', 'binary'])
def test_labels_at_points_are_those_of_the_wall_that_was_seen(semantics):
    one = integrator(voxel_size_m=0.1, truncation_m=0.3, semantics=semantics, num_labels=6)
    wall = image_of(SMALL, np.full((60, 80), 2.0))
    left = np.arange(80) * np.ones((60, 1)) < 40
    one.integrate(wall.with_images(label=np.where(left, 0, 3)), np.eye(4))
    points = [[-0.25, 0.02, 1.97], [0.25, 0.02, 1.97], [0.25, 0.02, 1.0], [0, 0, 50.0]]
    strange = [[np.nan, 0, 2], [0, np.inf, 2], [1e300, 0, 0], [2e5, 0, 0]]
    label, weight = labels_at(one.blocks, points + strange)
    other = 1 if semantics == 'binary' else 3
    assert label.tolist() == [0, other, *[-1] * 6]
    assert (weight[:2] > 0.0).all()
    assert not weight[2:].any()


def test_a_label_that_weighs_too_little_is_none():
    settings = {'semantics': 'first_k', 'min_label_weight': 1e6}
    one = integrator(voxel_size_m=0.1, truncation_m=0.3, **settings)
    wall = image_of(SMALL, np.full((60, 80), 2.0))
    one.integrate(wall.with_images(label=np.full((60, 80), 4)), np.eye(4))
    assert labels_at(one.blocks, [[0.0, 0.02, 1.97]])[0].tolist() == [-1]


def test_labels_at_no_point_are_none_and_bad_requests_are_refused():
    blocks = BlockMap(TsdfConfig(semantics='single'))
    assert [len(found) for found in labels_at(blocks, np.empty((0, 3)))] == [0, 0]
    assert labels_at(blocks, [[1.0, 2.0, 3.0]])[0].tolist() == [-1]
    with pytest.raises(ValueError, match=r'expected \(P, 3\)'):
        labels_at(blocks, [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match='keeps labels'):
        labels_at(BlockMap(TsdfConfig()), [[1.0, 2.0, 3.0]])
