# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Aligning the scans of a window: drift is removed, surfels get thin, bad input is refused."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.alignment import align_scans, Samples
from surfel_mapper.alignment.window import key_scans
from surfel_mapper.config import AlignConfig
from surfel_mapper.errors import AlignmentError
from surfel_mapper.geometry import se3_exp
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.simulation import Lidar
from test.alignment.street import drifted, relative_errors, street_scans

WALLS = ((2, -1.9), (2, 3.0), (1, 4.0), (1, -5.0))
"""Axis across each wall of a tunnel, and its distance from the sensor."""

NOTHING = Samples(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0))


def samples(points, voxel_size_m=1.0):
    surfel_map = SurfelMap(voxel_size_m)
    surfel_map.add(points, origin=np.zeros(3))
    return Samples.of_surfels(surfel_map.surfels(6))


def thickness(scans, poses):
    surfel_map = SurfelMap(0.5)
    for scan, pose in zip(scans, poses, strict=True):
        surfel_map.insert(surfel_map.reduce(scan.points, pose, origin=pose[:3, 3]))
    surfels = surfel_map.surfels(50)
    return surfels.eigenvalues[surfels.planarity > 0.5, 0].mean()


@pytest.fixture(scope='module')
def drive():
    scans, true = street_scans(30)
    before = drifted(true)
    alignment = align_scans([samples(scan.points) for scan in scans], before)
    return scans, true, before, alignment


@pytest.mark.parametrize('apart', [1, 10, 29])
def test_errors_of_relative_poses_fall_five_times(drive, apart):
    _, true, before, alignment = drive

    found = relative_errors(alignment.T_map_sensor, true, apart)

    drift = relative_errors(before, true, apart)
    assert found[0] < drift[0] / 5.0
    assert found[1] < drift[1] / 5.0


def test_surfels_get_as_thin_as_at_the_true_poses(drive):
    scans, true, before, alignment = drive

    found = thickness(scans, alignment.T_map_sensor)

    assert found < 0.5 * thickness(scans, before)
    assert found < 1.05 * thickness(scans, true)


def test_poses_settle_and_the_first_stays(drive):
    _, _, before, alignment = drive

    assert alignment.settled
    assert alignment.rounds < AlignConfig().max_rounds
    assert not alignment.unconnected
    np.testing.assert_array_equal(alignment.T_map_sensor[0], before[0])


@pytest.mark.parametrize('step_m', [0.7, 0.9, 1.3])
def test_odometry_determines_the_translation_along_a_tunnel(step_m):
    # a tunnel looks the same from every place: without odometry all scans would coincide
    rng = np.random.default_rng(3)
    true = np.tile(np.eye(4), (10, 1, 1))
    true[:, 0, 3] = step_m * np.arange(10)
    before = drifted(true)

    alignment = align_scans([samples(tunnel(rng)) for _ in true], before)

    found = relative_errors(alignment.T_map_sensor, true, 9)
    drift = relative_errors(before, true, 9)
    assert found[0] < 1.2 * drift[0]
    assert found[1] < 0.1 * drift[1]


def tunnel(rng):
    """Return a noisy lidar scan of a floor, a ceiling and two walls along x."""
    ahead = Lidar(columns=512).directions().reshape(-1, 3)
    with np.errstate(divide='ignore'):
        ways = [distance / ahead[:, axis] for axis, distance in WALLS]
    range_m = np.min([np.where(way > 0.0, way, np.inf) for way in ways], axis=0)
    range_m += rng.normal(0.0, 0.02, len(range_m))
    return ahead[range_m < 80.0] * range_m[range_m < 80.0, None]


def test_a_loop_closes_where_only_its_ends_meet():
    scans, true = street_scans(30)
    there_and_back = [*range(0, 30, 2), *range(29, 0, -2)]
    chosen = [scans[number] for number in there_and_back]
    before = drifted(true[there_and_back], share=0.02, deg_m=0.2)

    alignment = align_scans(
        [samples(scan.points) for scan in chosen],
        before,
        AlignConfig(loop_distance_m=4.0),
    )

    ends = [0, len(chosen) - 1]
    found = relative_errors(alignment.T_map_sensor[ends], true[there_and_back][ends], 1)
    drift = relative_errors(before[ends], true[there_and_back][ends], 1)
    assert (ends[1], ends[0]) in alignment.residuals
    assert found[0] < drift[0] / 20.0


def test_keys_are_first_last_and_those_far_enough_or_turned():
    poses = np.array([np.eye(4)] * 6)
    poses[:, 0, 3] = [0.0, 0.4, 1.1, 1.2, 1.3, 1.4]
    poses[4:, :3, :3] = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.3]))[:3, :3]

    assert key_scans(poses, list(range(6)), 1.0, [''] * 6) == [0, 2, 4, 5]
    assert key_scans(poses, [1, 3, 4], 10.0, [''] * 6) == [1, 4]


def test_sensors_that_look_apart_have_keys_of_their_own():
    # two sensors back to back, 2 m apart, on a drive of 4 m
    poses = np.tile(np.eye(4), (34, 1, 1))
    poses[:, 0, 3] = 0.25 * np.repeat(np.arange(17), 2)
    poses[1::2, 0, 3] -= 2.0
    poses[1::2, :3, :3] = np.diag([-1.0, -1.0, 1.0])

    keys = key_scans(poses, list(range(34)), 1.0, ['front', 'rear'] * 17)

    assert keys == [0, 1, 8, 9, 16, 17, 24, 25, 32, 33]


def test_scans_without_surfels_go_with_their_neighbours():
    scans, true = street_scans(30)
    before = drifted(true[:6])
    seen = [samples(scan.points) for scan in scans[:6]]
    seen[2] = seen[5] = NOTHING

    alignment = align_scans(seen, before, AlignConfig(key_distance_m=0.0))

    found = relative_errors(alignment.T_map_sensor, true[:6], 1)
    assert found[0] < 0.005
    np.testing.assert_allclose(
        np.linalg.inv(alignment.T_map_sensor[4]) @ alignment.T_map_sensor[5],
        np.linalg.inv(before[4]) @ before[5],
        rtol=0,
        atol=1e-12,
    )


def test_scans_that_share_nothing_go_by_odometry_and_are_reported():
    scans, true = street_scans(30)
    before = drifted(true[:3])
    before[2, :3, 3] += 1000.0
    seen = [samples(scan.points) for scan in scans[:3]]

    alignment = align_scans(seen, before, AlignConfig(key_distance_m=0.0))

    assert alignment.unconnected == (2,)
    assert set(alignment.dropped) == {(2, 1)}  # too far for any other
    np.testing.assert_allclose(
        np.linalg.inv(alignment.T_map_sensor[1]) @ alignment.T_map_sensor[2],
        np.linalg.inv(before[1]) @ before[2],
        rtol=0,
        atol=1e-6,
    )


@pytest.mark.parametrize(
    ('num_scans', 'poses', 'message'),
    [
        (1, np.eye(4)[None], '1 scan and'),
        (2, np.eye(4)[None], 'poses of shape'),
        (2, np.full((2, 4, 4), np.nan), 'finite'),
    ],
)
def test_invalid_scans_and_poses_are_refused(num_scans, poses, message):
    scan = Samples(np.eye(3), np.eye(3), np.ones(3), np.ones(3))

    with pytest.raises(AlignmentError, match=message):
        align_scans([scan] * num_scans, poses)


def test_scans_with_nothing_to_match_are_refused():
    scan = NOTHING

    with pytest.raises(AlignmentError, match=r'0 of 3 scans have enough surfels of 1 m'):
        align_scans([scan] * 3, np.array([np.eye(4)] * 3))


def test_frames_that_are_not_one_for_each_scan_are_refused():
    with pytest.raises(AlignmentError, match='1 frames, expected one for each of 2 scans'):
        align_scans([NOTHING] * 2, np.array([np.eye(4)] * 2), frame_ids=['front'])
