# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Copies of selected points, against numpy; the mask is tested in test/filters/kernels."""

import numpy as np
import pytest

from surfel_mapper.kernels.selection import compact, copy_ranges, number_ranges
from test.kernels.modes import both

RANGES = np.array([[2, 5], [0, 0], [7, 8], [5, 7], [0, 2]])


@both
def test_ranges_are_concatenated_in_their_order(call):
    points = np.random.default_rng(1).normal(size=(10, 3))
    out = np.full((8, 3), np.nan)
    call(copy_ranges, points, RANGES, out)
    expected = np.concatenate([points[first:last] for first, last in RANGES])
    np.testing.assert_array_equal(out, expected)


@both
def test_items_get_the_number_of_their_range_at_their_old_position(call):
    order = np.random.default_rng(2).permutation(10)
    numbers = np.array([10, 20, 30, 40, 50])
    out = np.full(10, -1, np.int32)
    call(number_ranges, RANGES, numbers, order, out)
    expected = np.full(10, -1)
    for (first, last), number in zip(RANGES, numbers, strict=True):
        expected[order[first:last]] = number
    np.testing.assert_array_equal(out, expected)


@both
@pytest.mark.parametrize('share', [0.0, 0.02, 0.5, 0.98, 1.0])
@pytest.mark.parametrize('run', [1, 50, 130])
@pytest.mark.parametrize('num', [1, 63, 64, 65, 500])
def test_a_mask_keeps_the_order_of_every_row_whether_points_go_alone_or_in_runs(
    call, num, run, share
):
    rng = np.random.default_rng(num * run)
    values, keep = rng.normal(size=(3, num)), np.repeat(rng.random(num) < share, run)[:num]
    memory = np.full((3, keep.sum() + 70), np.nan)
    call(compact, values, keep, memory[:, : keep.sum()])
    np.testing.assert_array_equal(memory[:, : keep.sum()], values[:, keep])
    assert np.isnan(memory[:, keep.sum() :]).all()  # nothing is written past the end
