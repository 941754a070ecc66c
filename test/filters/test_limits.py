# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Filters by position and direction, against the coordinates and angles themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surfel_mapper.errors import ConfigError, FilterError
from surfel_mapper.filters.limits import BodyBox
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


def test_the_scan_itself_is_returned_if_all_points_stay():
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


def test_a_negative_distance_counts_by_its_absolute_value():
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


INF = np.inf

RNG = np.random.default_rng(3)
BALL = RNG.normal(size=(2000, 3))
X, Y, Z = BALL.T
PHI = np.degrees(np.arctan2(Y, X))
THETA = np.degrees(np.arccos(Z / np.sqrt(X * X + Y * Y + Z * Z)))


@pytest.mark.parametrize(
    ('phi', 'theta'),
    [
        ((-30.0, 60.0), (20.0, 110.0)),
        ((90.0, 180.0), (0.0, 180.0)),
        ((-180.0, -90.0), (0.0, 45.0)),
        ((-170.0, 170.0), (100.0, 179.0)),
        ((-INF, INF), (80.0, INF)),
        ((-200.0, 10.0), (-5.0, 200.0)),
        ((50.0, 20.0), (0.0, 180.0)),
    ],
)
def test_angle_limit_keeps_what_is_beyond_or_within_the_angles(phi, theta):
    limits = dict(zip(('phiMin', 'phiMax', 'thetaMin', 'thetaMax'), (*phi, *theta), strict=True))
    inside = (phi[0] < PHI) & (phi[1] > PHI) & (theta[0] < THETA) & (theta[1] > THETA)
    outside = (phi[1] < PHI) | (phi[0] > PHI) | (theta[1] < THETA) | (theta[0] > THETA)
    name = 'AngleLimitDataPointsFilter'
    assert kept(name, BALL, **limits, removeInside=0) == np.flatnonzero(inside).tolist()
    assert kept(name, BALL, **limits, removeInside=1) == np.flatnonzero(outside).tolist()


def test_under_libpointmatchers_name_the_defaults_remove_nothing_and_under_ours_all():
    assert len(kept('AngleLimitDataPointsFilter', BALL)) == len(BALL)
    assert kept('angle_limit', BALL) == []


def test_on_an_axis_there_is_no_angle():
    points = [[0.0, 0.0, 5.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]
    assert kept('angle_limit', points, phi_min_deg=-90.0, remove_inside=False) == []
    assert kept('angle_limit', points, phi_min_deg=-90.0, phi_max_deg=90.0) == []


def kept_rows(name, scan, /, **parameters):
    scan = replace(scan, columns={**scan.columns, 'row': np.arange(len(scan))})
    return filter_of(name, **parameters).apply(scan).columns['row'].tolist()


def test_the_body_box_stands_in_the_frame_of_the_robot():
    # the sensor is 1 m ahead of the robot and 2 m up, and looks to the left
    T_base_sensor = np.array(
        [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 2.0], [0, 0, 0, 1.0]]
    )
    points = [[0.0, 1.0, -2.0], [0.0, 0.0, 0.0], [0.5, 0.5, -2.5], [np.nan, 0, 0], [0, 0, -2.0]]
    scan = replace(scan_of(points), T_base_sensor=T_base_sensor)
    in_base = [(0.0, 0.0, 0.0), (1.0, 0.0, 2.0), (0.5, 0.5, -0.5), None, (1.0, 0.0, 0.0)]
    inside = [i for i, p in enumerate(in_base) if p is not None and max(map(abs, p)) < 1.0]
    assert kept_rows('body_box', scan, remove_inside=False) == inside == [0, 2]
    assert kept_rows('body_box', scan) == [1, 4]  # a face is outside, a nan nowhere


@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_a_turned_body_box_keeps_what_numpy_says(dtype):
    rng = np.random.default_rng(2)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, [0.3, -0.2, 1.0]
    scan = replace(random_scan(3000, dtype=dtype), T_base_sensor=pose)
    in_base = scan.points.astype(np.float64) @ rotation.T + pose[:3, 3]
    outside = ~(np.abs(in_base) < 1.0).all(axis=1)
    assert 0 < np.count_nonzero(outside) < 3000
    np.testing.assert_array_equal(BodyBox().apply(scan).points, scan.points[outside])


def test_the_body_box_needs_the_mount_of_the_sensor():
    scan = replace(random_scan(3), T_base_sensor=None)
    with pytest.raises(FilterError, match=r"'sensor' on the robot is not known; set frames.base"):
        filter_of('body_box').apply(scan)


@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_range_limit_keeps_both_limits(dtype):
    points = np.array(
        [[0.0, 0, 0], [0, 3, 4], [0, 0, 5.001], [6, 0, 8], [0, 10.01, 0], [np.nan, 0, 0]], dtype
    )
    assert kept('range_limit', points, min_m=5.0, max_m=10.0) == [1, 2, 3]
    assert kept('range_limit', points, min_m=0.0, max_m='inf') == [0, 1, 2, 3, 4]


def test_range_limit_may_be_for_one_sensor():
    points = [[50.0, 0.0, 0.0]]
    assert kept('range_limit', points, max_m=10.0, sensor='sensor') == []
    assert kept('range_limit', points, max_m=10.0, sensor='another') == [0]
    with pytest.raises(ConfigError, match=r'max_m: 1, expected at least min_m \(2\)'):
        filter_of('range_limit', min_m=2.0, max_m=1.0)
