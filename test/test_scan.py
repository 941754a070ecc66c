# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Scan: accepted content and refused input."""

import numpy as np
import pytest

from surfel_mapper import Scan

POINTS = np.arange(12.0).reshape(4, 3)


def scan(points=POINTS, **columns):
    return Scan(points=points, stamp_ns=1, frame_id='lidar', columns=columns)


@pytest.mark.parametrize(
    ('points', 'message'),
    [
        (POINTS.tolist(), 'points: list, expected an array'),
        (POINTS[:, :2], r'points: shape \(4, 2\), expected \(N, 3\)'),
        (POINTS[0], r'points: shape \(3,\), expected \(N, 3\)'),
        (POINTS.astype(int), 'points: dtype int64, expected float32 or float64'),
    ],
)
def test_points_of_another_shape_or_type_are_refused(points, message):
    with pytest.raises(ValueError, match=message):
        scan(points)


def test_columns_have_a_row_for_each_point():
    assert len(scan(ring=np.zeros(4))) == 4
    with pytest.raises(ValueError, match='column ring: 3 rows, expected one for each of 4 points'):
        scan(ring=np.zeros(3))


def test_columns_go_with_the_points_that_are_selected():
    chosen = scan(ring=np.arange(4)).select(np.array([2, 0]))
    np.testing.assert_array_equal(chosen.points, POINTS[[2, 0]])
    np.testing.assert_array_equal(chosen.columns['ring'], [2, 0])
    masked = scan(ring=np.arange(4)).select(np.array([False, True, False, True]))
    np.testing.assert_array_equal(masked.columns['ring'], [1, 3])
