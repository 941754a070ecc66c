# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Tracking through a room: predictions, deviations and refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surfel_mapper.alignment.companions import LEAST_SHARE
from surfel_mapper.alignment.registration import Registration
from surfel_mapper.alignment.tracking import Tracker
from surfel_mapper.config import RegistrationConfig
from surfel_mapper.errors import AlignmentError
from surfel_mapper.geometry import compose, inverse, se3_exp
from surfel_mapper.mapping.surfel_map import SurfelMap
from test.alignment.test_registration import map_of, NOISE_M, points_on, ROOM, TRUE, VOXEL_M

SECOND = 10**9
TWIST = np.array([0.8, 0.1, 0.0, 0.0, 0.02, 0.3])


def tracker_at(start, **settings):
    config = RegistrationConfig(noise_m=NOISE_M, **settings)
    return Tracker(Registration(config, VOXEL_M), start)


def cells_at(tracker, pose, seed=7):
    points = points_on(ROOM, 60, seed=seed)
    T_sensor_map = inverse(pose)
    return tracker._registration.cells(points @ T_sensor_map[:3, :3].T + T_sensor_map[:3, 3])


def pose_at(seconds):
    return compose(TRUE, se3_exp(TWIST * seconds))


def test_before_the_first_motion_the_sensor_is_at_rest():
    tracker = tracker_at(TRUE)

    assert tracker.is_new
    np.testing.assert_array_equal(tracker.predict(5 * SECOND), TRUE)
    assert tracker.deviation_m == RegistrationConfig().max_deviation_m


def test_the_prediction_assumes_constant_velocity():
    tracker = tracker_at(TRUE)
    tracker.advance(TRUE, 0)
    tracker.advance(pose_at(0.5), SECOND // 2)

    np.testing.assert_allclose(tracker.twist, TWIST, atol=1e-12)
    np.testing.assert_allclose(tracker.predict(2 * SECOND), pose_at(2.0), atol=1e-12)
    np.testing.assert_allclose(tracker.predict(SECOND // 2), pose_at(0.5), atol=1e-12)


def test_a_scan_that_fits_and_has_not_settled_is_refused_for_that():
    tracker = tracker_at(pose_at(0.2), max_iterations=1, coarse_levels=0)

    with pytest.raises(AlignmentError, match=r'fit it, but its pose has not settled'):
        tracker.track(cells_at(tracker, pose_at(0.3)), SECOND, map_of(ROOM), np.eye(4))


def test_after_a_restart_the_motion_is_unknown():
    tracker = tracker_at(TRUE)
    tracker.advance(TRUE, 0)
    tracker.advance(pose_at(0.2), SECOND // 5)

    tracker.restart(pose_at(3.0))

    assert tracker.is_new
    np.testing.assert_array_equal(tracker.predict(9 * SECOND), pose_at(3.0))


def square_room(num, seed):
    """Return points on the floor and four equal walls, which four headings fit."""
    rng = np.random.default_rng(seed)
    parts = [np.column_stack([rng.uniform(-4.2, 4.2, (num, 2)), rng.normal(0.1, 0.003, num)])]
    for quarter in range(4):
        wall = np.column_stack(
            [
                rng.normal(4.2, 0.003, num),
                rng.uniform(-4.2, 4.2, num),
                rng.uniform(0.1, 2.8, num),
            ]
        )
        parts.append(wall @ heading(90.0 * quarter).T)
    return np.concatenate(parts)


def heading(degrees):
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(('turn_deg', 'is_ambiguous'), [(5.0, False), (25.0, False), (45.0, True)])
def test_a_scan_that_two_places_fit_equally_well_is_refused(turn_deg, is_ambiguous):
    start = np.eye(4)
    start[2, 3] = 1.5
    surfel_map = SurfelMap(VOXEL_M)
    surfel_map.add(square_room(20_000, seed=1), origin=start[:3, 3])
    tracker = tracker_at(start)

    def track(turn_deg, number):
        points = (square_room(3000, seed=2 + number) - start[:3, 3]) @ heading(turn_deg)
        cells = tracker._registration.cells(points)
        return tracker.track(cells, number * SECOND // 10, surfel_map, np.eye(4))

    track(0.0, 0)
    track(0.0, 1)
    if is_ambiguous:
        with pytest.raises(AlignmentError, match='its pose is ambiguous'):
            track(turn_deg, 2)
        np.testing.assert_allclose(tracker.pose, start, atol=2e-3)  # the last good one
    else:
        found = track(turn_deg, 2)
        assert found.rival == 0.0
        np.testing.assert_allclose(found.T_map_sensor[:3, :3], heading(turn_deg), atol=2e-3)
    assert tracker.num_ambiguous == is_ambiguous


def test_a_turn_that_stops_does_not_make_the_surroundings_companions():
    tracker, surfel_map = tracker_at(TRUE), map_of(ROOM)
    shares = []
    for number in range(6):
        turn = np.array([0.0, 0.0, 0.0, 0.0, 0.0, math.radians(2.0 * (number // 2))])
        cells = cells_at(tracker, compose(TRUE, se3_exp(turn)), seed=number)
        found = tracker.track(cells, number * SECOND // 10, surfel_map, np.eye(4))
        shares.append(found.companions)

    assert max(shares) < LEAST_SHARE
