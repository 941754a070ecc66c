# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses that the mapper finds itself: in a room, on a street, and on a map that is frozen."""

from __future__ import annotations

from dataclasses import replace
import itertools

import numpy as np
import pytest

from surfel_mapper.config import Config
from surfel_mapper.errors import ConfigError
from surfel_mapper.geometry import compose, inverse, pose_matrix, q_xyzw, se3_exp
from surfel_mapper.offline.summary import tracking_doubt, tracking_text
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.regions import Ball
from surfel_mapper.pipeline.registered_poses import StateTimes
from surfel_mapper.scan import Scan
from surfel_mapper.simulation import Lidar, Simulation, World
from surfel_mapper.simulation.primitives import Primitive
from test.alignment.test_registration import CORRIDOR, map_of, NOISE_M, points_on, ROOM, TRUE
from test.fields import config_of

STEP_NS = 10**8
TWIST = np.array([0.8, 0.1, 0.0, 0.0, 0.02, 0.3])
MOUNT = (0.3, -0.1, 0.5, 0.0, 0.0, 0.6, 0.8)


def mapper_with(**changes):
    settings = {'pose.source': 'registration', 'registration.noise_m': NOISE_M}
    changes = {name.replace('__', '.'): value for name, value in changes.items()}
    return Mapper(config_of({**settings, **changes}))


def frozen(**changes):
    """Return a mapper on the frozen map of the room."""
    mapper = mapper_with(map__mode='frozen', map__load='room.npz', **changes)
    mapper.restore(map_of(ROOM), [])
    return mapper


def pose_at(number):
    return compose(TRUE, se3_exp(TWIST * 0.1 * number))


def scan_at(number, pose=None, faces=ROOM, frame_id='lidar', reach_m=np.inf):
    """Return a scan of the room from a pose, by default that of a steady drive."""
    points = points_on(faces, 100, seed=number, reach_m=reach_m)
    T_sensor_map = inverse(pose_at(number) if pose is None else pose)
    return Scan(
        points=points @ T_sensor_map[:3, :3].T + T_sensor_map[:3, 3],
        stamp_ns=number * STEP_NS,
        frame_id=frame_id,
    )


def feed(mapper, scans):
    updates = []
    for scan in scans:
        mapper.add_scan(scan)
        updates += mapper.insert_ready()
    return updates


def start_of(pose):
    return (*pose[:3, 3].tolist(), *q_xyzw(pose).tolist())


def test_a_sensor_without_any_odometry_is_followed_from_where_it_starts():
    mapper = mapper_with()

    updates = feed(mapper, [scan_at(number) for number in range(8)])

    for number, update in enumerate(updates):
        expected = compose(inverse(TRUE), pose_at(number))
        np.testing.assert_allclose(update.T_map_sensor, expected, atol=5e-3)
    assert updates[0].registration is None
    assert all(update.registration.fit > 0.5 for update in updates[1:])
    assert mapper.counters.mapped == 8
    assert mapper.summary()['registration']['aligned'] == 7
    assert mapper.summary()['registration']['body'] == 'lidar'


def test_the_map_is_that_of_the_scans_at_the_poses_found():
    mapper = mapper_with()
    scans = [scan_at(number) for number in range(4)]

    updates = feed(mapper, scans)

    expected = Mapper(Config.from_mapping({'pose.source': 'identity'})).map
    for scan, update in zip(scans, updates, strict=True):
        pose = update.T_map_sensor
        expected.insert(expected.reduce(scan.points, pose, origin=pose[:3, 3], min_range_m=0.1))
    assert mapper.map.digest() == expected.digest()


def test_the_base_is_followed_where_the_sensor_is_mounted_on_it():
    mount = pose_matrix(MOUNT[:3], MOUNT[3:])
    start = compose(TRUE, inverse(mount))
    mapper = mapper_with(frames__base_to_sensor=MOUNT, registration__start=start_of(start))

    updates = feed(mapper, [scan_at(number) for number in range(4)])

    for number, update in enumerate(updates):
        np.testing.assert_allclose(update.T_map_sensor, pose_at(number), atol=5e-3)
    assert mapper.registered.body == 'base_link'


def test_two_sensors_serve_one_track():
    mount = pose_matrix(MOUNT[:3], MOUNT[3:])
    mapper = mapper_with(registration__start=start_of(TRUE))
    mapper.add_pose('base_link', 'front', 0, (0, 0, 0), (0, 0, 0, 1), static=True)
    mapper.add_pose('base_link', 'back', 0, MOUNT[:3], MOUNT[3:], static=True)
    scans = []
    for number in range(6):
        pose = pose_at(number) if number % 2 == 0 else compose(pose_at(number), mount)
        scans.append(scan_at(number, pose, frame_id=('front', 'back')[number % 2]))

    updates = feed(mapper, scans)

    np.testing.assert_allclose(updates[4].T_map_sensor, pose_at(4), atol=5e-3)
    np.testing.assert_allclose(updates[5].T_map_sensor, compose(pose_at(5), mount), atol=5e-3)


def test_a_second_sensor_without_a_mount_is_dropped():
    mapper = mapper_with()

    feed(mapper, [scan_at(0), scan_at(1, frame_id='other'), scan_at(20)])
    mapper.finish()

    assert mapper.counters.mapped == 2
    assert mapper.counters.dropped == {'no_pose': 1}


def test_a_scan_that_does_not_fit_is_dropped_and_the_next_one_mapped():
    mapper = mapper_with()
    feed(mapper, [scan_at(number) for number in range(4)])
    digest = mapper.map.digest()
    rng = np.random.default_rng(0)
    noise = replace(scan_at(4), points=rng.uniform(-9.0, 9.0, (3000, 3)))

    assert feed(mapper, [noise]) == []
    assert mapper.map.digest() == digest

    (update,) = feed(mapper, [scan_at(5)])
    assert mapper.counters.dropped == {'not_aligned': 1}
    np.testing.assert_allclose(update.T_map_sensor, compose(inverse(TRUE), pose_at(5)), atol=5e-3)


def in_hall(number, pose):
    """Return a scan of another place: eight large surfaces that lean in all directions."""
    layout, rng = np.random.default_rng(5), np.random.default_rng(100 + number)
    parts = []
    for _ in range(8):
        normal = layout.normal(size=3)
        normal /= np.linalg.norm(normal)
        aside = np.linalg.svd(normal[None])[2][1:]
        spread = rng.uniform(-4.0, 4.0, (4000, 2)) @ aside
        distance = layout.uniform(5.0, 9.0) + rng.normal(0.0, NOISE_M, (4000, 1))
        parts.append(spread + distance * normal)
    T_sensor_hall = inverse(pose)
    points = np.concatenate(parts) @ T_sensor_hall[:3, :3].T + T_sensor_hall[:3, 3]
    return Scan(points=points, stamp_ns=number * STEP_NS, frame_id='lidar')


def test_a_scan_after_a_part_and_a_lone_scan_has_to_be_confirmed():
    mapper = mapper_with()
    feed(mapper, [scan_at(number) for number in range(4)])
    steps = [se3_exp(np.array([0.1 * n, 0.02 * n, 0.0, 0.0, 0.0, 0.01 * n])) for n in range(3)]
    part = [in_hall(4 + n, step) for n, step in enumerate(steps)]
    lone = scan_at(7, np.eye(4), faces=CORRIDOR, reach_m=20.0)

    assert feed(mapper, [*part, lone, scan_at(8)]) == []
    updates = feed(mapper, [scan_at(number) for number in range(9, 14)])

    assert [update.stamp_ns // STEP_NS for update in updates] == [*range(8, 14)]
    for update in updates:
        expected = compose(inverse(TRUE), pose_at(update.stamp_ns // STEP_NS))
        np.testing.assert_allclose(update.T_map_sensor, expected, atol=5e-3)


def test_scans_of_another_place_stay_apart_and_are_named():
    mapper = mapper_with()
    feed(mapper, [scan_at(number) for number in range(4)])
    digest = mapper.map.digest()
    steps = [se3_exp(np.array([0.1 * n, 0.02 * n, 0.0, 0.0, 0.0, 0.01 * n])) for n in range(6)]

    assert feed(mapper, [in_hall(4 + n, step) for n, step in enumerate(steps)]) == []
    mapper.finish()

    assert mapper.map.digest() == digest
    assert mapper.counters.dropped == {'apart': 6}
    (part,) = mapper.registered.apart
    for n, pose in enumerate(part.poses):
        np.testing.assert_allclose(pose, compose(inverse(steps[0]), steps[n]), atol=0.01)
    found = mapper.summary()['registration']
    assert found['parts_apart'] == 1
    assert (found['apart'][0]['scans'], found['apart'][0]['first_s']) == (6, 0.4)
    states = found['tracking']
    assert states['lost']['scans'] + states['unconfirmed']['scans'] == 6
    assert states['lost']['seconds'] + states['unconfirmed']['seconds'] == pytest.approx(0.6)


def test_when_the_map_is_emptied_a_part_ends_and_the_motion_goes_on():
    mapper = mapper_with()
    feed(mapper, [scan_at(number) for number in range(4)])
    assert feed(mapper, [in_hall(4 + n, np.eye(4)) for n in range(2)]) == []
    mapper.clear_region(Ball(center=(0.0, 0.0, 0.0), radius_m=1000.0))
    assert mapper.map.num_voxels == 0

    (update,) = feed(mapper, [scan_at(6)])
    expected = compose(inverse(TRUE), pose_at(6))  # by constant velocity, 0.3 s on
    np.testing.assert_allclose(update.T_map_sensor, expected, atol=0.15)  # the part is 0.5 m off
    assert mapper.counters.dropped == {'not_aligned': 2}
    mapper.finish()
    assert mapper.summary()['registration']['parts_apart'] == 0


def test_after_a_loss_scans_are_joined_once_the_next_ones_agree():
    mapper = mapper_with()
    feed(mapper, [scan_at(number) for number in range(4)])
    lost = [in_hall(4 + n, np.eye(4)) for n in range(2)]  # two scans that fit each other
    assert feed(mapper, lost) == []
    digest = mapper.map.digest()

    held = [feed(mapper, [scan_at(number)]) for number in (6, 7)]
    assert held == [[], []]
    assert mapper.map.digest() == digest
    assert mapper.summary()['registration']['tracking']['unconfirmed']['scans'] >= 1
    updates = feed(mapper, [scan_at(8), scan_at(9), scan_at(10)])

    assert [update.stamp_ns // STEP_NS for update in updates] == [6, 7, 8, 9, 10]
    for update in updates:
        truth = compose(inverse(TRUE), pose_at(update.stamp_ns // STEP_NS))
        np.testing.assert_allclose(update.T_map_sensor, truth, atol=5e-3)
    assert mapper.counters.dropped == {'not_aligned': 2}
    assert mapper.counters.mapped == 4 + 5


def test_degenerate_registrations_are_warned_about(caplog):
    mapper = mapper_with()

    updates = feed(mapper, [scan_at(n, TRUE, faces=CORRIDOR, reach_m=20.0) for n in range(3)])

    assert len(updates[2].registration.degenerate) == 1
    assert mapper.summary()['registration']['degenerate'] == 2
    assert '1 of 6 directions of motion are not determined' in caplog.text


@pytest.mark.parametrize(('slip_m', 'num_jumped'), [(0.1, 0), (0.35, 1)])
def test_a_large_correction_after_undetermined_motion_is_uncertain(slip_m, num_jumped):
    mapper = mapper_with()
    floor_and_long_walls = ROOM[:3]

    for number, x_m in enumerate([0.0, 0.1, 0.2, 0.3, 0.4 + slip_m]):
        pose = compose(se3_exp(np.array([x_m, 0.0, 0.0, 0.0, 0.0, 0.0])), TRUE)
        feed(mapper, [scan_at(number, pose, floor_and_long_walls if number == 3 else ROOM)])

    tracking = mapper.summary()['registration']['tracking']
    assert (tracking['degenerate']['scans'], tracking['jumped']['scans']) == (1, num_jumped)


def furnished_room(seed):
    rng = np.random.default_rng(seed)
    boxes = [((20.0, 10.0, 0.2), (0.0, 0.0, z)) for z in (-0.1, 4.1)]
    boxes += [((20.0, 0.2, 4.0), (0.0, y, 2.0)) for y in (-5.0, 5.0)]
    boxes += [((0.2, 10.0, 4.0), (x, 0.0, 2.0)) for x in (-10.0, 10.0)]
    for _ in range(8):
        size = rng.uniform((0.3, 0.3, 0.5), (2.0, 2.0, 3.5))
        xy = rng.uniform(-9.0, 9.0), rng.choice([-1, 1]) * rng.uniform(2.0, 4.5)
        boxes.append((size, (*xy, size[2] / 2.0)))
    return World([Primitive(kind='box', size_m=size, xyz=xyz) for size, xyz in boxes])


def walk_in_furnished_room(mapper, seed):
    world, lidar = furnished_room(seed), Lidar(beams=16, columns=360, range_noise_m=0.01)
    poses, updates = [], []
    for number in range(10):
        way_m = 0.6 * number
        yaw = 0.5 * np.sin(way_m / 3.0 + seed)
        xyz, q = (way_m - 8.5, 0.5 * np.sin(way_m / 2.0), 1.0), (0.0, 0.0, np.sin(yaw / 2.0))
        poses.append(pose_matrix(xyz, (*q, np.cos(yaw / 2.0))))
        points = lidar.scan(world, poses[-1], stamp_ns=number, number=number).points
        ahead = np.abs(np.arctan2(points[:, 1], points[:, 0])) < np.pi / 3.0
        stamp_ns, points = number * STEP_NS, np.asfortranarray(points[ahead])
        updates += feed(mapper, [Scan(points=points, stamp_ns=stamp_ns, frame_id='lidar')])
    errors_m = {}
    for update in updates:
        number = update.stamp_ns // STEP_NS
        error = compose(inverse(compose(inverse(poses[0]), poses[number])), update.T_map_sensor)
        errors_m[number] = np.linalg.norm(error[:3, 3])
    return errors_m, mapper.summary()['registration']['tracking']


@pytest.mark.parametrize('seed', [2, 14, 28])
def test_a_far_place_that_fits_hardly_better_is_searched_anew(seed):
    mapper = Mapper(Config.from_mapping({'pose.source': 'registration'}))

    errors_m, tracking = walk_in_furnished_room(mapper, seed)

    assert tracking['lost']['scans'] >= 1
    assert list(errors_m) == list(range(10))
    assert max(errors_m.values()) < 0.08


def test_a_far_place_that_fits_hardly_better_is_uncertain_if_no_place_was_expected():
    mapper = Mapper(Config.from_mapping({'pose.source': 'registration'}))

    errors_m, tracking = walk_in_furnished_room(mapper, seed=39)

    assert max(errors_m.values()) > 2.0
    assert tracking['jumped']['scans'] == 1
    assert tracking['degenerate']['scans'] == 0


def test_the_motion_gate_looks_at_the_pose_found():
    mapper = mapper_with(window__gate_distance_m=0.2)

    updates = feed(mapper, [scan_at(number) for number in range(10)])

    assert mapper.counters.gated == 10 - len(updates) == 6  # 0.08 m a scan
    np.testing.assert_allclose(
        updates[-1].T_map_sensor, compose(inverse(TRUE), pose_at(9)), atol=5e-3
    )


def test_time_that_goes_back_starts_anew():
    mapper = mapper_with()
    feed(mapper, [scan_at(number) for number in range(20, 24)])

    update, *_ = feed(mapper, [scan_at(number) for number in range(3, 16)])

    assert mapper.counters.resets == 1
    np.testing.assert_array_equal(update.T_map_sensor, np.eye(4))


def rolling(num_scans):
    world = World.street(seed=2, length_m=40.0)
    lidar = Lidar(beams=32, columns=512, range_noise_m=0.01)
    return Simulation(world, lidar, rolling=True, num_scans=num_scans)


def test_a_sweep_is_deskewed_by_the_motion_that_was_found():
    simulation = rolling(12)
    mapper, skewed = (
        mapper_with(deskew__enabled=enabled, registration__noise_m=0.01)
        for enabled in (True, False)
    )

    updates = feed(mapper, simulation.scans())
    feed(skewed, simulation.scans())

    drive = simulation.drive
    start = inverse(drive.T_odom_sensor(simulation.stamp_ns(0)))
    assert len(updates) == 12
    for update in updates:
        truth = compose(start, drive.T_odom_sensor(update.stamp_ns))
        np.testing.assert_allclose(update.T_map_sensor[:3, 3], truth[:3, 3], atol=0.04)
    fits = [m.summary()['registration']['fit']['median'] for m in (mapper, skewed)]
    assert fits[0] > fits[1]


def test_the_first_sweep_waits_for_the_next_to_be_deskewed():
    first, second = list(rolling(2).scans())
    mapper = mapper_with(deskew__enabled=True)

    assert feed(mapper, [first]) == []
    assert len(feed(mapper, [second])) == 2


def test_a_frozen_map_stays_as_it_is():
    mapper = frozen(registration__start=start_of(TRUE))
    digest = mapper.map.digest()

    updates = feed(mapper, [scan_at(number) for number in range(5)])
    mapper.clear()

    for number, update in enumerate(updates):
        np.testing.assert_allclose(update.T_map_sensor, pose_at(number), atol=3e-3)
        assert (update.num_points, len(update.changed), update.evictions) == (0, 0, ())
    assert mapper.map.digest() == digest
    assert (mapper.counters.localised, mapper.counters.mapped) == (5, 0)
    assert mapper.summary()['scans']['localised'] == 5


def test_an_initial_pose_is_used_on_a_frozen_map():
    far_off = (40.0, -30.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    mapper = frozen(registration__start=far_off)
    assert feed(mapper, [scan_at(0)]) == []
    near = compose(TRUE, se3_exp(np.array([0.5, -0.4, 0.0, 0.0, 0.0, 0.15])))

    mapper.start_from('odom', near[:3, 3], q_xyzw(near))

    (update,) = feed(mapper, [scan_at(1)])
    np.testing.assert_allclose(update.T_map_sensor, pose_at(1), atol=3e-3)


def test_the_initial_pose_on_a_frozen_map_is_searched_for():
    mapper = frozen()
    away = compose(se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2.5])), TRUE)
    poses = [compose(compose(away, inverse(TRUE)), pose_at(number)) for number in range(6)]
    scans = [scan_at(number, poses[number]) for number in range(6)]

    updates = [feed(mapper, [scan]) for scan in scans]

    assert [len(mapped) for mapped in updates] == [0, 0, 0, 4, 1, 1]
    for update, pose in zip(itertools.chain(*updates), poses, strict=True):
        np.testing.assert_allclose(update.T_map_sensor, pose, atol=3e-3)
    assert mapper.counters.localised == 6


def test_scans_of_another_room_are_not_placed_on_a_frozen_map():
    mapper = frozen()
    corridor = [scan_at(number, faces=CORRIDOR, reach_m=20.0) for number in range(6)]

    assert feed(mapper, corridor) == []
    mapper.finish()

    assert mapper.counters.dropped == {'apart': 6}
    (apart,) = mapper.registered.apart
    assert 'its initial pose is unknown, and searched for in the map; ' in apart.reason


@pytest.mark.parametrize(
    ('frame_id', 'q', 'reason'),
    [
        ('map', (0, 0, 0, 1), "it is in frame 'map', expected 'odom'"),
        ('odom', (0, 0, 0, 0), 'norm 0'),
    ],
)
def test_an_initial_pose_that_cannot_be_used_changes_nothing(frame_id, q, reason, caplog):
    mapper = frozen(registration__start=start_of(TRUE))

    mapper.start_from(frame_id, (9.0, 9.0, 9.0), q)

    assert mapper.counters.messages_ignored == {'initial_pose': 1}
    assert reason in caplog.text
    assert len(feed(mapper, [scan_at(0)])) == 1


@pytest.mark.parametrize(
    ('settings', 'message'),
    [
        ({'map.mode': 'frozen'}, r'map\.load: empty, expected a map to freeze'),
        ({'registration.start': [1.0, 2.0]}, r'registration\.start: \[1\.0, 2\.0\], expected x'),
        ({'registration.start': [0.0] * 7}, r'registration\.start: .* a unit quaternion'),
    ],
)
def test_contradictory_settings_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        Config.from_mapping(settings)


def test_the_text_names_scans_by_their_state_of_tracking():
    states = StateTimes()
    for number in range(6):
        states.add(number * STEP_NS, ['degenerate'] if number in (2, 4) else [])

    summary = {'registration': {'tracking': states.summary()}, 'scans': {'received': 6}}

    assert tracking_text(summary) == (
        'registration: 2 of 6 scans did not determine all directions of motion '
        '(0.200 to 0.400 s)\n'
    )


@pytest.mark.parametrize(
    ('state', 'least', 'statement'),
    [
        ('ambiguous', 5, 'two places fit about equally well'),
        ('degenerate', 3, 'surfaces do not determine every direction of motion'),
        ('jumped', 1, 'a place far from the expected one was taken without being certain'),
    ],
)
def test_a_map_of_many_doubtful_scans_is_in_doubt(state, least, statement):
    doubts = []
    for num_scans in (least - 1, least):
        states = StateTimes()
        for number in range(20):
            states.add(number * STEP_NS, [state] if number < num_scans else [])
        tracking = {'tracking': states.summary()}
        doubts.append(tracking_doubt({'registration': tracking, 'scans': {'received': 20}}))

    last_s = (least - 1) * STEP_NS / 1e9
    assert doubts == [
        '',
        f'in {least} of 20 scans (0.000 to {last_s:.3f} s) {statement}: their poses may be wrong',
    ]
