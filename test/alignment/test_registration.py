# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Registration in rooms of known surfaces and poses."""

from __future__ import annotations

from functools import cache
import math

import numpy as np
import pytest

from surfel_mapper.alignment.registration import moved, Registration
from surfel_mapper.alignment.surfel_planes import SurfelPlanes
from surfel_mapper.config import RegistrationConfig
from surfel_mapper.geometry import (
    compose,
    inverse,
    rotation_angle,
    se3_exp,
)
from surfel_mapper.mapping.surfel_map import SurfelMap

VOXEL_M = 0.5
NOISE_M = 0.005
TRUE = se3_exp(np.array([0.4, -0.7, 1.2, 0.03, -0.02, 0.6]))

# Faces as corner and two edges, m: of a room that no turn but a full one brings onto itself.
FLOOR = ((-6.0, -4.0, 0.0), (14.0, 0.0, 0.0), (0.0, 9.0, 0.0))
WALLS = (
    ((-6.0, -4.0, 0.0), (14.0, 0.0, 0.0), (0.0, 0.0, 3.0)),
    ((-6.0, 5.0, 0.0), (14.0, 0.0, 0.0), (0.0, 0.0, 3.0)),
    ((-6.0, -4.0, 0.0), (0.0, 9.0, 0.0), (0.0, 0.0, 3.0)),
    ((8.0, -4.0, 0.0), (0.0, 9.0, 0.0), (0.0, 0.0, 3.0)),
)
CUPBOARD = (
    ((3.0, 2.0, 0.0), (2.0, 0.7, 0.0), (0.0, 0.0, 2.0)),
    ((3.0, 2.0, 0.0), (-0.5, 1.5, 0.0), (0.0, 0.0, 2.0)),
    ((5.0, 2.7, 0.0), (-0.5, 1.5, 0.0), (0.0, 0.0, 2.0)),
)
ROOM = (FLOOR, *WALLS, *CUPBOARD)
CORRIDOR = (
    ((-60.0, -1.5, 0.0), (120.0, 0.0, 0.0), (0.0, 3.0, 0.0)),
    ((-60.0, -1.5, 0.0), (120.0, 0.0, 0.0), (0.0, 0.0, 2.5)),
    ((-60.0, 1.5, 0.0), (120.0, 0.0, 0.0), (0.0, 0.0, 2.5)),
)


def points_on(faces, density, seed, reach_m=math.inf):
    """Return points on faces with noise, density a square metre, near TRUE."""
    rng = np.random.default_rng(seed)
    parts = []
    for corner, first, second in np.array(faces):
        num = int(density * np.linalg.norm(np.cross(first, second)))
        u, v = rng.random((2, num, 1))
        parts.append(corner + u * first + v * second)
    points = np.concatenate(parts)
    points += rng.normal(scale=NOISE_M, size=points.shape)
    return points[np.linalg.norm(points - TRUE[:3, 3], axis=1) < reach_m]


@cache
def map_of(faces):
    surfel_map = SurfelMap(VOXEL_M)
    surfel_map.add(points_on(faces, 200, seed=1, reach_m=40.0), origin=TRUE[:3, 3])
    return surfel_map


def scan_of(faces, reach_m=math.inf):
    """Return other points, in the frame of a sensor at TRUE."""
    points = points_on(faces, 150, seed=2, reach_m=reach_m)
    T_sensor_map = inverse(TRUE)
    return points @ T_sensor_map[:3, :3].T + T_sensor_map[:3, 3]


def registration(**settings):
    return Registration(RegistrationConfig(noise_m=NOISE_M, **settings), VOXEL_M)


def align(faces, start, deviation_m, points=None, **settings):
    aligner = registration(**settings)
    cells = aligner.cells(scan_of(faces) if points is None else points)
    return aligner.align(cells, map_of(faces), [start], deviation_m)


def off(T_map_sensor):
    """Return the difference of a pose from TRUE: m, deg."""
    error = compose(inverse(TRUE), T_map_sensor)
    return np.linalg.norm(error[:3, 3]), math.degrees(rotation_angle(error))


def started(x=0.0, y=0.0, z=0.0, turn_deg=(0.0, 0.0, 0.0)):
    return moved(TRUE, np.array([x, y, z, *np.radians(turn_deg)]))


def test_a_scan_is_found_where_it_was_taken():
    found = align(ROOM, started(0.15, -0.1, 0.05, (0.5, -0.5, 2.0)), 0.3)

    distance_m, angle_deg = off(found.T_map_sensor)
    assert distance_m < 1e-3  # noise of 5 mm in thousands of cells
    assert angle_deg < 0.02
    assert found.converged
    assert found.fit > 0.9
    assert found.overlap > 0.9
    assert found.support == found.overlap * found.fit
    assert len(found.degenerate) == 0


@pytest.mark.parametrize('levels', [0, 1, 2, 3])
def test_a_scan_is_found_from_several_voxels_off(levels):
    start = started(1.8, 1.5, 0.3, (2.0, -2.0, 15.0))

    found = align(ROOM, start, 1.0, search_deg=0.0, coarse_levels=levels)

    assert off(found.T_map_sensor)[0] < 1e-3


def test_a_heading_that_is_far_off_is_searched_for():
    start = started(0.3, 0.2, 0.0, (0.0, 0.0, 50.0))
    aligner = registration()
    cells, surfel_map = aligner.cells(scan_of(ROOM)), map_of(ROOM)

    found = aligner.align(cells, surfel_map, [start], 0.3, expected_support=0.6)

    assert off(found.T_map_sensor)[0] < 1e-3
    assert off(found.T_map_sensor)[1] < 0.02


def test_a_further_start_is_tried_if_the_first_does_not_fit():
    wrong, right = started(0.0, 0.0, 0.0, (0.0, 0.0, 90.0)), started(0.1)
    aligner = registration(search_deg=0.0)
    cells, surfel_map = aligner.cells(scan_of(ROOM)), map_of(ROOM)

    found = aligner.align(cells, surfel_map, [wrong, right], 0.3, expected_support=0.6)

    assert off(found.T_map_sensor)[0] < 1e-3


def test_moving_objects_hardly_disturb():
    points = scan_of(ROOM)
    rng = np.random.default_rng(5)
    clutter = rng.uniform([-5.0, -3.0, -1.0], [2.0, 0.0, 1.0], (len(points) // 4, 3))

    found = align(ROOM, started(0.1, 0.1, 0.0), 0.2, points=np.concatenate([points, clutter]))

    assert off(found.T_map_sensor)[0] < 0.01


def test_the_prediction_is_kept_along_a_corridor():
    start = started(0.2, 0.1, 0.1, (0.0, 0.0, 1.0))
    points = scan_of(CORRIDOR, reach_m=20.0)

    found = align(CORRIDOR, start, 0.3, points=points)

    error = found.T_map_sensor[:3, 3] - TRUE[:3, 3]
    assert error[0] == pytest.approx(0.2, abs=0.02)  # x is undetermined
    assert abs(error[1:]).max() < 2e-3
    assert len(found.degenerate) == 1
    assert abs(found.degenerate[0, 0]) > 0.99


@pytest.mark.parametrize('ahead_m', [-2.5, -1.5, 1.5])
def test_the_end_of_a_corridor_determines_the_motion_if_the_start_misses_it(ahead_m):
    end = (((20.0, -1.5, 0.0), (0.0, 3.0, 0.0), (0.0, 0.0, 2.5)),)
    corridor = (
        *[((-60.0, *corner[1:]), (80.0, *along[1:]), up) for corner, along, up in CORRIDOR],
        *end,
    )
    start = started(ahead_m, 0.1, 0.1, (0.0, 0.0, 1.0))
    points = scan_of(corridor, reach_m=25.0)

    found = align(corridor, start, 0.3, points=points)
    aligner = registration()
    found = aligner.determined(found, aligner.cells(points), map_of(corridor), [start])

    assert len(found.degenerate) == 0
    assert off(found.T_map_sensor)[0] < 3e-3


def test_on_a_plain_height_and_tilt_alone_are_known():
    plain = (((-40.0, -40.0, 0.0), (80.0, 0.0, 0.0), (0.0, 80.0, 0.0)),)
    start = started(0.2, -0.2, 0.1, (0.5, -0.5, 1.0))

    found = align(plain, start, 0.3, points=scan_of(plain, reach_m=15.0))

    assert len(found.degenerate) == 3
    assert found.T_map_sensor[2, 3] == pytest.approx(TRUE[2, 3], abs=2e-3)
    np.testing.assert_allclose(found.T_map_sensor[2, :3], TRUE[2, :3], atol=2e-4)
    assert np.abs(found.T_map_sensor[:2, 3] - start[:2, 3]).max() < 0.02


def test_an_empty_map_determines_no_motion():
    aligner = registration()
    start = started(1.0)

    found = aligner.align(aligner.cells(scan_of(ROOM)), SurfelMap(VOXEL_M), [start], 0.3)

    assert found.overlap == 0.0
    assert len(found.degenerate) == 6
    np.testing.assert_allclose(found.T_map_sensor, start, atol=1e-12)


def test_a_scan_without_points_fits_nothing():
    found = align(ROOM, TRUE, 0.3, points=np.full((5, 3), np.nan))

    assert (found.num_cells, found.support) == (0, 0.0)


def test_equal_scans_get_bit_identical_poses_and_do_not_change_the_map():
    aligner, surfel_map = registration(), map_of(ROOM)
    digest = surfel_map.digest()
    start = started(0.9, -0.8, 0.3)

    poses = [
        aligner.align(aligner.cells(scan_of(ROOM)), surfel_map, [start], 1.0).T_map_sensor
        for _ in range(2)
    ]

    np.testing.assert_array_equal(poses[0], poses[1])
    assert surfel_map.digest() == digest


def test_too_many_cells_are_subsampled_evenly():
    points = np.column_stack([np.arange(1000.0), np.zeros(1000), np.zeros(1000)]) + 0.1

    cells = registration(max_cells=300).cells(points)

    assert len(cells) == 250
    assert np.diff(np.sort(cells[:, 0])).max() == pytest.approx(4.0, abs=1e-4)


def fits_of(points, place):
    """Return whether one cell meets a map of some points, and the information about it."""
    surfel_map = SurfelMap(1.0)
    surfel_map.add(points)
    planes = SurfelPlanes(surfel_map, min_points=5, noise_m=0.01)
    hessian, _, overlap, _ = planes.equations(np.array([place]), np.eye(4), 1.0)
    return overlap, np.trace(hessian[:3, :3])


def test_a_surfel_of_one_ring_is_ignored_as_its_normal_is_noise():
    # along the ring 0.9 m, along the beam the noise of a range, across both nothing
    rng = np.random.default_rng(4)
    spread, noise = rng.uniform(0.05, 0.95, 200), rng.normal(scale=0.01, size=200)
    ring = np.column_stack([spread, 0.5 + noise, np.full(200, 0.5)])

    assert fits_of(ring, [0.5, 0.5, 0.5]) == (0.0, 0.0)


def test_the_weight_of_a_surfel_falls_away_from_its_mean():
    rng = np.random.default_rng(4)
    area = np.column_stack([rng.uniform(0.05, 0.95, (20, 2)), np.full(20, 0.5)])
    area += rng.normal(scale=0.01, size=(20, 3))

    near, far = (fits_of(area, [x, x, 0.5]) for x in (0.5, 0.99))

    assert near[0] == far[0] == 1.0
    assert far[1] < 0.8 * near[1]


def test_a_map_too_sparse_for_its_voxels_is_met_in_larger_ones():
    # 3 points in a voxel of 0.5 m, less than make a surfel, and 12 in one of 1 m
    sparse = SurfelMap(VOXEL_M)
    sparse.add(points_on(ROOM, 6, seed=1), origin=TRUE[:3, 3])
    aligner = registration(min_points=8)
    cells = aligner.cells(scan_of(ROOM))

    found = aligner.align(cells, sparse, [started(0.2, -0.2, 0.1)], 1.0)

    assert aligner.fits(found)
    assert off(found.T_map_sensor)[0] < 0.05


TABLE = (2.0, 1.0, -1.5), (3.0, 2.5, -0.7)
PILLAR = (-3.4, -2.4, -1.5), (-3.0, -2.0, 1.5)


def rays_in_a_hall(pose, num_points, seed):
    """Return the ends of rays in the frame of a sensor in a hall of 12 x 8 x 3 m."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(num_points, 3)) * (1.0, 1.0, 0.6)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    turned = directions @ pose[:3, :3].T
    depth = ((np.sign(turned) * (6.0, 4.0, 1.5) - pose[:3, 3]) / turned).min(axis=1)
    for corners in (TABLE, PILLAR):
        crossings = (np.array(corners)[:, None] - pose[:3, 3]) / turned
        first, last = crossings.min(axis=0).max(axis=1), crossings.max(axis=0).min(axis=1)
        depth = np.where((first < last) & (first > 0.0), np.minimum(depth, first), depth)
    return directions * (depth + rng.normal(scale=NOISE_M, size=num_points))[:, None]


@pytest.mark.parametrize('seed', range(0, 300, 100))
def test_places_in_voxels_of_two_sizes_are_compared_at_one_size(seed):
    # Its walls lie on faces of voxels, where sparse points make few surfels: the true place in
    # voxels of 0.5 m was less supported than the hall turned by 180 deg in voxels of 1 m.
    steps = np.array([[0.3, 0.15, 0.0, 0.0, 0.0, 0.06]]) * np.arange(5)[:, None]
    poses = [moved(np.eye(4), step) for step in steps]
    places = [moved(pose, np.array([-2.0, -1.0, 0.0, 0.0, 0.0, 0.0])) for pose in poses]
    surfel_map, aligner = SurfelMap(VOXEL_M), registration()
    for k, place in enumerate(places[:-1]):
        points = rays_in_a_hall(place, 1500, seed + k)
        surfel_map.add(points @ poses[k][:3, :3].T + poses[k][:3, 3])
    cells = aligner.cells(rays_in_a_hall(places[-1], 1500, seed + 4))
    start = moved(poses[-1], np.array([0.04, 0.03, 0.0, 0.0, 0.0, 0.0]))

    result = aligner.align(cells, surfel_map, [start], 0.1, 0.64)

    assert np.linalg.norm(result.T_map_sensor[:3, 3] - poses[-1][:3, 3]) < 0.1


def test_a_thousand_steps_keep_a_rotation_orthonormal():
    rng = np.random.default_rng(4)
    pose = np.eye(4)
    for _ in range(1000):
        pose = moved(pose, rng.normal(size=6))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-15)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0, abs=1e-14)
