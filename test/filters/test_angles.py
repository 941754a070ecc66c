# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Filters by direction, against the angles themselves."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.errors import ConfigError
from test.filters.examples import filter_of, kept

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


@pytest.mark.parametrize(
    ('azimuth', 'elevation'),
    [
        ((-45.0, 45.0), (-90.0, 90.0)),
        ((100.0, 260.0), (-20.0, 30.0)),
        ((-180.0, 180.0), (-25.0, 3.0)),
        ((-10.0, 300.0), (-90.0, 0.0)),
        ((-270.0, -200.0), (0.0, 90.0)),
        ((0.0, 180.0), (10.0, 40.0)),
    ],
)
@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_field_of_view_keeps_what_a_sensor_would_see(azimuth, elevation, dtype):
    points = BALL.astype(dtype)
    x, y, z = points.T.astype(np.float64)
    turn = (np.degrees(np.arctan2(y, x)) - azimuth[0]) % 360.0
    height = np.degrees(np.arctan2(z, np.hypot(x, y)))
    seen = (turn <= azimuth[1] - azimuth[0]) & (elevation[0] <= height) & (height <= elevation[1])
    found = kept(
        'field_of_view',
        points,
        azimuth_min_deg=azimuth[0],
        azimuth_max_deg=azimuth[1],
        elevation_min_deg=elevation[0],
        elevation_max_deg=elevation[1],
    )
    assert found == np.flatnonzero(seen).tolist()


def test_the_edges_of_a_field_of_view_are_in_it():
    points = [[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]
    assert kept('field_of_view', points, azimuth_min_deg=-90, azimuth_max_deg=45) == [0, 1, 3]
    assert kept('field_of_view', points, elevation_min_deg=0, elevation_max_deg=0) == [0, 1, 2, 3]


def test_nothing_is_seen_at_the_sensor_or_where_no_place_is():
    points = [[0.0, 0.0, 0.0], [np.nan, 1.0, 0.0], [INF, 1.0, 0.0], [0.0, 0.0, 1.0]]
    assert kept('field_of_view', points) == [3]


def test_a_field_of_view_may_be_that_of_one_sensor():
    narrow = {'azimuth_min_deg': -1.0, 'azimuth_max_deg': 1.0}
    points = [[-1.0, 0.0, 0.0]]
    assert kept('field_of_view', points, **narrow, sensor='another') == [0]
    assert kept('field_of_view', points, **narrow, sensor='sensor') == []


@pytest.mark.parametrize(
    ('settings', 'expected'),
    [
        ({'azimuth_min_deg': 10, 'azimuth_max_deg': 10}, 'azimuth_max_deg: 10, expected more'),
        ({'azimuth_min_deg': -200}, 'by up to 360'),
        ({'elevation_min_deg': 5, 'elevation_max_deg': 4}, 'elevation_max_deg: 4, expected at l'),
    ],
)
def test_a_field_that_holds_nothing_or_comes_round_is_refused(settings, expected):
    with pytest.raises(ConfigError, match=expected):
        filter_of('field_of_view', **settings)
