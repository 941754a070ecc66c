# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Scan: accepted content and refused input."""

from dataclasses import replace
import pickle

import numpy as np
import pytest

from surfel_mapper import Scan
from surfel_mapper.scan import LazyPoints, PointTimes

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


class Decoding:
    """Returns the points and counts how often it was asked for them."""

    number = 0

    def __call__(self):
        self.number += 1
        return POINTS


def test_points_are_decoded_once_when_they_are_first_read():
    decode = Decoding()
    lazy = scan(LazyPoints(4, decode), ring=np.arange(4))
    assert len(lazy) == 4
    assert decode.number == 0

    assert lazy.points is POINTS
    assert lazy.points is POINTS
    assert len(lazy) == 4
    assert decode.number == 1


def test_scans_made_of_a_lazy_one_have_its_points():
    chosen = scan(LazyPoints(4, Decoding())).select(np.array([3]))
    np.testing.assert_array_equal(chosen.points, POINTS[3:])
    moved = replace(scan(LazyPoints(4, Decoding())), T_map_sensor=np.eye(4))
    assert moved.points is POINTS
    copied = pickle.loads(pickle.dumps(scan(LazyPoints(4, Decoding()))))
    np.testing.assert_array_equal(copied.points, POINTS)


def test_coordinates_are_read_where_the_message_has_them():
    decode = Decoding()
    xyz = tuple(POINTS.T)
    assert scan(LazyPoints(4, decode, xyz)).xyz is xyz
    assert decode.number == 0
    for points in (LazyPoints(4, decode), POINTS):
        np.testing.assert_array_equal(scan(points).xyz, xyz)


def test_columns_of_lazy_points_have_a_row_for_each():
    with pytest.raises(ValueError, match='column ring: 3 rows, expected one for each of 4 points'):
        scan(LazyPoints(4, Decoding()), ring=np.zeros(3))


@pytest.mark.parametrize('made', [scan(), scan(LazyPoints(4, Decoding()))])
def test_a_scan_has_no_other_attributes(made):
    with pytest.raises(AttributeError, match="'Scan' object has no attribute 'point'"):
        made.point  # noqa: B018


@pytest.mark.parametrize(
    ('offsets', 'found'),
    [
        (np.zeros(3, np.int64), r'int64 \(3,\)'),
        (np.zeros(4), r'float64 \(4,\)'),
        ([0, 0, 0, 0], 'list'),
    ],
)
def test_times_of_another_length_or_type_are_refused(offsets, found):
    times = PointTimes(offsets, 0, 1)
    for add in (scan().with_times, lambda t: scan(LazyPoints(4, Decoding())).with_times(t)):
        with pytest.raises(ValueError, match=f'offsets of times: {found}, expected int64'):
            add(times)
