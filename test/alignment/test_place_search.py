# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Search of a whole map for the pose of a scan, in rooms of known poses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surfel_mapper.alignment.place_search import HEADING_DEG, MAX_PLACES, PlaceSearch
from surfel_mapper.alignment.registration import Registration
from surfel_mapper.alignment.surfel_planes import means
from surfel_mapper.config import RegistrationConfig
from surfel_mapper.geometry import compose, inverse, pose_matrix, rotation_angle
from surfel_mapper.mapping.surfel_map import SurfelMap
from test.alignment.test_registration import NOISE_M, points_on, ROOM

SIZE_M = 0.5
FAR = np.array([60.0, 20.0, 0.0])
SETTINGS = RegistrationConfig(noise_m=NOISE_M)


def pose_of(x_m, y_m, z_m, heading_deg):
    half = math.radians(heading_deg) / 2.0
    return pose_matrix((x_m, y_m, z_m), (0.0, 0.0, math.sin(half), math.cos(half)))


def map_of_points(points):
    surfel_map = SurfelMap(SIZE_M)
    surfel_map.add(points)
    return surfel_map


def seen_from(pose, points):
    T = inverse(pose)
    return points @ T[:3, :3].T + T[:3, 3]


def searched(surfel_map, scan):
    search = PlaceSearch(means(surfel_map.moments()), SIZE_M)
    return search.poses(means(map_of_points(scan).moments()))


@pytest.mark.parametrize(
    'truth',
    [pose_of(1.0, 0.5, 1.1, heading) for heading in (0.0, 77.0, 181.0, 299.0)]
    + [compose(pose_of(*FAR, 0.0), pose_of(-2.0, 1.0, 0.8, 140.0))],
)
def test_the_best_place_is_that_of_the_scan(truth):
    here, there = points_on(ROOM, 100, seed=1), points_on(ROOM[:-1], 100, seed=2)
    narrower = there * [0.7, 1.0, 1.0] + FAR
    surfel_map = map_of_points(np.concatenate([here, narrower]))
    room = narrower if truth[0, 3] > 30.0 else here

    places = searched(surfel_map, seen_from(truth, room))

    assert 0 < len(places) <= MAX_PLACES
    off = compose(inverse(truth), places[0])
    assert np.hypot(off[0, 3], off[1, 3]) < 2.0 * SIZE_M
    assert abs(off[2, 3]) < SIZE_M
    assert math.degrees(rotation_angle(off)) <= 1.001 * HEADING_DEG


def test_relocation_refines_the_place_without_a_rival():
    here = points_on(ROOM, 100, seed=1)
    truth = pose_of(1.0, 0.5, 1.1, 200.0)
    surfel_map, scan = map_of_points(here), seen_from(truth, points_on(ROOM, 100, seed=3))
    registration = Registration(SETTINGS, SIZE_M)

    places = searched(surfel_map, scan)
    result = registration.relocate(registration.cells(scan), surfel_map, places)

    np.testing.assert_allclose(result.T_map_sensor, truth, atol=3e-3)
    assert result.is_found
    assert result.rival == 0.0


def test_equal_rooms_are_rivals():
    here = points_on(ROOM, 100, seed=1)
    surfel_map = map_of_points(np.concatenate([here, here + FAR]))
    scan = seen_from(pose_of(1.0, 0.5, 1.1, 200.0), points_on(ROOM, 100, seed=3))
    registration = Registration(SETTINGS, SIZE_M)

    places = searched(surfel_map, scan)
    result = registration.relocate(registration.cells(scan), surfel_map, places)

    assert result.rival >= 0.9 * result.support


def test_images_of_large_maps_have_larger_pixels():
    points = np.concatenate([points_on(ROOM, 100, seed=1), [[9e4, 9e4, 0.0]]])
    scan = seen_from(pose_of(1.0, 0.5, 1.1, 20.0), points_on(ROOM, 100, seed=3))

    places = searched(map_of_points(points), scan)

    assert len(places) <= MAX_PLACES
