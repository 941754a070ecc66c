# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Large height fields: close to the direct solution, and constant away from changes."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.models.bspline import fit_pspline, initial_field
from surfel_mapper.models.bspline_incremental import DEGREE, fit_field, SMOOTHING

PITCH_M, STILL_M = 0.25, 2e-4
HOLE = (slice(30, 34), slice(20, 25))


def surface(x, y):
    return 0.4 * np.sin(0.5 * x) + 0.1 * y + 0.02 * x * y


def sums(num_x=60, num_y=44, bump=0.0, first=(0, 0)):
    """Return the sums of four points in the middle of every cell but those of a hole."""
    x = (first[0] + np.arange(num_x) + 0.5) * PITCH_M
    y = (first[1] + np.arange(num_y) + 0.5) * PITCH_M
    x, y = np.meshgrid(x, y, indexing='ij')
    z = surface(x, y) + bump * (np.hypot(x - 3.0, y - 3.0) < 1.0)
    found = np.stack([4.0 * x, 4.0 * y, 4.0 * z, np.full(x.shape, 4.0)], axis=-1)
    found[HOLE] = 0.0
    return found


def places(number=2000):
    """Return places in cells that hold points."""
    xy = np.random.default_rng(0).uniform((0.3, 0.3), (14.7, 10.7), (number, 2))
    cell = (xy / PITCH_M).astype(int)
    return xy[sums()[cell[:, 0], cell[:, 1], 3] > 0.0]


def test_large_field_equals_the_direct_solution():
    data = sums()
    large = fit_field(PITCH_M, np.zeros(2), data, None, STILL_M)
    filled = data[..., 3] > 0.0
    means = data[filled][:, :3] / 4.0
    start = initial_field(PITCH_M, np.zeros(2), data[..., 2] / 4.0, filled, DEGREE)
    at_once = fit_pspline(start, means[:, :2], means[:, 2], np.ones(len(means)), SMOOTHING)
    xy = places()
    np.testing.assert_allclose(
        large.field.heights(xy), at_once.heights(xy), atol=2e-3
    )  # they differ in where their knots are
    np.testing.assert_allclose(large.field.heights(xy), surface(*xy.T), atol=5e-3)


def test_field_far_from_a_change_is_bitwise_constant():
    before = fit_field(PITCH_M, np.zeros(2), sums(), None, STILL_M)
    after = fit_field(PITCH_M, np.zeros(2), sums(bump=0.1), before, STILL_M)
    xy = places()
    far = np.hypot(*(xy - 3.0).T) > 1.0 + 14 * PITCH_M
    assert far.sum() > 500
    np.testing.assert_array_equal(after.field.heights(xy[far]), before.field.heights(xy[far]))
    fresh = fit_field(PITCH_M, np.zeros(2), sums(bump=0.1), None, STILL_M)
    np.testing.assert_allclose(after.field.heights(xy), fresh.field.heights(xy), atol=2e-3)


def test_unchanged_input_keeps_the_field():
    before = fit_field(PITCH_M, np.zeros(2), sums(), None, STILL_M)
    after = fit_field(PITCH_M, np.zeros(2), sums(), before, STILL_M)
    np.testing.assert_array_equal(after.field.control, before.field.control)


@pytest.mark.parametrize('first', [(-3, 0), (-20, -20), (0, 0)])
def test_growing_grid_continues_the_previous_field(first):
    before = fit_field(PITCH_M, np.zeros(2), sums(), None, STILL_M)
    origin = PITCH_M * np.array(first, float)
    data = sums(60 - first[0] + 5, 44 - first[1], first=first)
    after = fit_field(PITCH_M, origin, data, before, STILL_M)
    fresh = fit_field(PITCH_M, origin, data, None, STILL_M)
    xy = np.random.default_rng(1).uniform(origin + 0.3, (14.7, 10.7), (2000, 2))
    cell = ((xy - origin) / PITCH_M).astype(int)
    xy = xy[data[cell[:, 0], cell[:, 1], 3] > 0.0]
    np.testing.assert_allclose(after.field.heights(xy), fresh.field.heights(xy), atol=3e-3)
    np.testing.assert_allclose(after.field.heights(xy), surface(*xy.T), atol=8e-3)
