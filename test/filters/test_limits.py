# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Filters by place: what is in, what is out, what lies on the limit, what nan does."""

from __future__ import annotations

import numpy as np
import pytest

from test.filters.examples import filter_of, kept, random_scan, scan_of

NAN, INF = np.nan, np.inf

DTYPES = pytest.mark.parametrize('dtype', [np.float32, np.float64])


def test_identity_returns_the_scan_itself():
    scan = random_scan(10)
    assert filter_of('IdentityDataPointsFilter').apply(scan) is scan


@DTYPES
def test_remove_nan_drops_points_with_a_nan_in_any_coordinate_and_keeps_infinite_ones(dtype):
    points = np.zeros((6, 3), dtype)
    points[[1, 2, 3], [0, 1, 2]] = NAN
    points[4] = INF, -INF, 0.0
    assert kept('RemoveNaNDataPointsFilter', points) == [0, 4, 5]


def test_where_nothing_is_removed_the_scan_itself_comes_back():
    scan = random_scan(10)
    assert filter_of('remove_nan').apply(scan) is scan


@DTYPES
def test_bounding_box_takes_its_faces_for_outside(dtype):
    points = np.array(
        [[0, 0, 0], [1, 0, 0], [0.999, 0.999, -0.999], [0, -1, 0], [0, 0, 2], [NAN, 0, 0]], dtype
    )
    assert kept('BoundingBoxDataPointsFilter', points) == [1, 3, 4]
    assert kept('BoundingBoxDataPointsFilter', points, removeInside=0) == [0, 2]


@DTYPES
def test_a_point_that_float32_puts_on_a_bound_is_on_it(dtype):
    points = np.array([[0.1, 0.0, 0.0], [np.nextafter(dtype(0.1), dtype(0)), 0.0, 0.0]], dtype)
    assert kept('bounding_box', points, x_max_m=0.1) == [0]
    assert kept('bounding_box', points, x_max_m=0.1, remove_inside=False) == [1]


def test_a_bounding_box_may_be_half_a_space():
    points = [[-5.0, 9.0, 9.0], [5.0, -9.0, 9.0], [1e30, 0.0, 0.0], [INF, 0.0, 0.0]]
    box = {'xMin': 0, 'xMax': 'inf', 'yMin': '-inf', 'yMax': 'inf', 'zMin': '-inf', 'zMax': 'inf'}
    assert kept('BoundingBoxDataPointsFilter', points, **box) == [0, 3]
    assert kept('BoundingBoxDataPointsFilter', points, **box, removeInside=0) == [1, 2]


LINE = [[0.0, 0.0, 0.0], [0.0, 3.0, 4.0], [3.0, 0.0, -4.0], [0.0, 6.0, 8.0], [NAN, 0.0, 0.0]]
"""Distances 0, 5, 5, 10, unknown."""


@DTYPES
def test_distances_are_limited_strictly_on_both_sides(dtype):
    points = np.array(LINE, dtype)
    assert kept('MaxDistDataPointsFilter', points, maxDist=5) == [0]
    assert kept('MaxDistDataPointsFilter', points, maxDist=5.01) == [0, 1, 2]
    assert kept('MinDistDataPointsFilter', points, minDist=5) == [3]
    assert kept('DistanceLimitDataPointsFilter', points, dist=5) == [3]
    assert kept('DistanceLimitDataPointsFilter', points, dist=5, removeInside=0) == [0]


def test_of_a_negative_distance_the_size_counts():
    assert kept('MaxDistDataPointsFilter', LINE, maxDist=-5.01) == [0, 1, 2]
    assert kept('DistanceLimitDataPointsFilter', LINE, dist=-5) == [3]


def test_along_an_axis_the_sign_counts():
    assert kept('MaxDistDataPointsFilter', LINE, dim=2, maxDist=0) == [2]
    assert kept('MinDistDataPointsFilter', LINE, dim=1, minDist=3) == [3]
    assert kept('DistanceLimitDataPointsFilter', LINE, dim=0, dist=2.5) == [2]
    assert kept('DistanceLimitDataPointsFilter', LINE, dim=0, dist=-1) == [0, 1, 2, 3]


def test_infinite_distances_keep_all_or_nothing():
    assert kept('MaxDistDataPointsFilter', LINE, maxDist='inf') == [0, 1, 2, 3]
    assert kept('MinDistDataPointsFilter', LINE, minDist='inf') == []


def test_columns_stay_with_their_points():
    scan = random_scan(200)
    found = filter_of('bounding_box', remove_inside=False).apply(scan)
    rows = np.flatnonzero((np.abs(scan.points) < 1.0).all(axis=1))
    assert 0 < len(rows) < 200
    for name, column in scan.columns.items():
        np.testing.assert_array_equal(found.columns[name], column[rows])


def test_all_can_be_removed():
    scan = scan_of([[0.0, 0.0, 0.0]], intensity=[1.0])
    found = filter_of('bounding_box').apply(scan)
    assert (found.points.shape, found.columns['intensity'].shape) == ((0, 3), (0,))
