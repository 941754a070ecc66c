# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Mapper: poses from every source, waiting in the time of the data, what is dropped and why.

Every map is compared by digest with one made from the points and the poses alone. Whatever comes
in, scans received = mapped + gated + dropped + waiting.
"""

import logging
from pathlib import Path
import subprocess
import sys

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from surfel_mapper.config import Config
from surfel_mapper.counters import MOST_FRAMES, OTHERS
from surfel_mapper.errors import ConfigError
from surfel_mapper.geometry import compose, interpolate, pose_matrix
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.regions import Ball
from surfel_mapper.pipeline.scan_queue import MAX_FRAMES
from surfel_mapper.scan import Scan
from test import reference

pytestmark = pytest.mark.filterwarnings('error')

S = 10**9
LEVEL = (0.0, 0.0, 0.0, 1.0)
TURNED = (0.0, 0.0, 0.6, 0.8)
MOUNTED = (0.3, -0.2, 1.5, 0.0, 0.1, 0.0, 0.99**0.5)


def mapper_with(**changes):
    """Return a mapper with some settings changed; odometry and a sensor at its base otherwise."""
    changes = {name.replace('__', '.', 1): value for name, value in changes.items()}
    defaults = {
        'pose.source': 'odometry',
        'frames.base_to_sensor': (0.0, 0.0, 0.0, *LEVEL),
        'window.max_scans': 0,
        'map.min_points': 1,
    }
    return Mapper(Config.from_mapping({**defaults, **changes}))


def scan_at(stamp_s, frame_id='lidar', points=None):
    """Return a scan; its points depend on the stamp alone."""
    if points is None:
        rng = np.random.default_rng(round(stamp_s * 1000))
        points = rng.uniform([-3, -3, 1], [3, 3, 1.2], (40, 3)).astype(np.float32)
    return Scan(points=np.asarray(points), stamp_ns=round(stamp_s * S), frame_id=frame_id)


def add_pose(mapper, stamp_s, x=0.0, q_xyzw=LEVEL, parent='odom', child='base_link'):
    mapper.add_pose(parent, child, round(stamp_s * S), (x, 0.0, 0.0), q_xyzw)


def insert(mapper, *scans):
    """Add scans and return the updates that they lead to."""
    updates = []
    for scan in scans:
        mapper.add_scan(scan)
        updates += mapper.insert_ready()
    return updates


def digest_of(*posed_scans):
    """Return the digest of a map of scans at their poses, less what is within 0.1 m."""
    surfel_map = SurfelMap(0.5)
    for scan, pose in posed_scans:
        moments = surfel_map.reduce(scan.points, pose, origin=pose[:3, 3], min_range_m=0.1)
        surfel_map.insert(moments)
    return surfel_map.digest()


def assert_counts_add_up(mapper, waiting=0):
    counters = mapper.counters
    dropped = sum(counters.dropped.values())
    assert counters.received == counters.mapped + counters.gated + dropped + waiting


def dropped(mapper):
    return dict(mapper.counters.dropped)


# Poses


def test_clouds_in_the_fixed_frame_need_no_pose():
    mapper = mapper_with(pose__source='identity', frames__base_to_sensor=())
    scans = [scan_at(1.0, 'odom'), scan_at(2.0, 'map')]
    updates = insert(mapper, *scans)
    assert [update.stamp_ns for update in updates] == [S, 2 * S]
    assert (updates[0].T_fixed_sensor == np.eye(4)).all()
    expected = SurfelMap(0.5)
    for scan in scans:
        expected.add(scan.points)  # from where they were seen is not known
    assert mapper.map.digest() == expected.digest()


def test_odometry_moves_the_base_and_the_sensor_on_it():
    mapper = mapper_with(frames__base_to_sensor=MOUNTED)
    add_pose(mapper, 1.0, 2.0)
    add_pose(mapper, 2.0, 5.0, TURNED)
    scans = [scan_at(1.0), scan_at(1.25), scan_at(2.0)]
    updates = insert(mapper, *scans)

    T_base_sensor = pose_matrix(MOUNTED[:3], MOUNTED[3:])
    first, last = pose_matrix((2.0, 0, 0), LEVEL), pose_matrix((5.0, 0, 0), TURNED)
    at_scans = [first, interpolate(first, last, 0.25), last]
    poses = [compose(T_odom_base, T_base_sensor) for T_odom_base in at_scans]
    for update, pose in zip(updates, poses, strict=True):
        assert (update.T_fixed_sensor == pose).all()
        assert update.frame_id == 'odom'
        assert update.num_points == 40
    assert mapper.map.digest() == digest_of(*zip(scans, poses, strict=True))


def test_poses_of_another_base_in_another_frame_are_used_as_configured():
    mapper = mapper_with(pose__source='pose', frames__fixed='map', frames__base='robot')
    scan = scan_at(3.0)
    add_pose(mapper, 3.0, 7.0, parent='map', child='robot')
    (update,) = insert(mapper, scan)
    assert update.frame_id == 'map'
    assert mapper.map.digest() == digest_of((scan, pose_matrix((7.0, 0, 0), LEVEL)))


def test_a_tree_of_transforms_is_followed_from_the_sensor_to_the_fixed_frame():
    mapper = mapper_with(pose__source='tf', frames__base_to_sensor=())
    scan = scan_at(1.5)
    assert insert(mapper, scan) == []
    add_pose(mapper, 1.0, 1.0, parent='odom', child='foot')
    add_pose(mapper, 2.0, 3.0, parent='odom', child='foot')
    add_pose(mapper, 1.5, 10.0, TURNED, parent='foot', child='base_link')
    assert list(mapper.insert_ready()) == []  # how the sensor is mounted is not known yet
    mapper.add_pose('base_link', 'lidar', 0, MOUNTED[:3], MOUNTED[3:], static=True)
    (update,) = mapper.insert_ready()

    base = compose(pose_matrix((2.0, 0, 0), LEVEL), pose_matrix((10.0, 0, 0), TURNED))
    pose = compose(base, pose_matrix(MOUNTED[:3], MOUNTED[3:]))
    assert np.abs(update.T_fixed_sensor - pose).max() <= 1e-15 * 16
    assert mapper.map.digest() == digest_of((scan, update.T_fixed_sensor))


def test_a_sensor_whose_frame_is_the_base_needs_no_mounting():
    mapper = mapper_with(frames__base_to_sensor=MOUNTED)
    add_pose(mapper, 1.0, 2.0)
    scan = scan_at(1.0, 'base_link')
    insert(mapper, scan)
    assert mapper.map.digest() == digest_of((scan, pose_matrix((2.0, 0, 0), LEVEL)))
    assert dict(mapper.counters.messages_ignored) == {}


@pytest.mark.parametrize(
    ('xyz', 'q_xyzw', 'parent', 'child'),
    [
        ((np.nan, 0, 0), LEVEL, 'odom', 'base_link'),
        ((0, 0, np.inf), LEVEL, 'odom', 'base_link'),
        ((0, 0, 0), (0, 0, 0, 0), 'odom', 'base_link'),
        ((0, 0, 0), (0, 0, 0, 2.0), 'odom', 'base_link'),
        ((0, 0, 0), LEVEL, 'odom', 'odom'),
        ((0, 0, 0), LEVEL, '', 'base_link'),
        ((0, 0, 0), LEVEL, 'somewhere', 'base_link'),
    ],
)
def test_a_bad_pose_is_counted_and_changes_nothing(xyz, q_xyzw, parent, child):
    mapper = mapper_with()
    add_pose(mapper, 1.0, 1.0)
    mapper.add_pose(parent, child, 2 * S, xyz, q_xyzw)
    add_pose(mapper, 3.0, 3.0)
    scan = scan_at(2.0)
    insert(mapper, scan)
    assert dict(mapper.counters.messages_ignored) == {'bad_pose': 1}
    assert mapper.map.digest() == digest_of((scan, pose_matrix((2.0, 0, 0), LEVEL)))


# Waiting


def test_scans_wait_for_their_poses_and_keep_their_order():
    mapper = mapper_with(pose__max_wait_s=5.0)
    scans = [scan_at(1.0), scan_at(1.5), scan_at(2.0)]
    assert insert(mapper, *scans) == []
    assert_counts_add_up(mapper, waiting=3)
    add_pose(mapper, 0.5, 0.5)
    add_pose(mapper, 1.6, 1.6)
    assert [update.stamp_ns for update in mapper.insert_ready()] == [S, 3 * S // 2]
    assert_counts_add_up(mapper, waiting=1)
    add_pose(mapper, 2.0, 2.0)
    assert [update.stamp_ns for update in mapper.insert_ready()] == [2 * S]
    assert dropped(mapper) == {}
    assert_counts_add_up(mapper)


def test_no_pose_is_extrapolated():
    mapper = mapper_with()
    add_pose(mapper, 1.0)
    add_pose(mapper, 2.0)
    assert insert(mapper, scan_at(0.999999999)) == []
    assert dropped(mapper) == {'no_pose': 1}  # older than all: none will come
    assert insert(mapper, scan_at(2.000000001)) == []
    assert dropped(mapper) == {'no_pose': 1}  # newer than all: one may come
    assert_counts_add_up(mapper, waiting=1)


@pytest.mark.parametrize('newer', ['scan', 'pose of another frame'])
def test_a_scan_is_dropped_once_newer_data_is_too_far_ahead(newer):
    mapper = mapper_with(pose__max_wait_s=0.5)

    def advance(stamp_s):
        if newer == 'scan':
            return insert(mapper, scan_at(stamp_s, 'camera'))
        add_pose(mapper, stamp_s, parent='gripper', child='finger')
        return list(mapper.insert_ready())

    insert(mapper, scan_at(10.0))
    assert advance(10.4) == advance(10.5) == []
    assert dropped(mapper) == {}  # exactly as long as allowed
    advance(10.500000001)
    assert dropped(mapper) == {'no_pose': 1}
    add_pose(mapper, 10.0)
    add_pose(mapper, 11.0)
    assert all(update.stamp_ns > 10 * S for update in mapper.insert_ready())


def test_the_oldest_scan_is_dropped_when_too_many_wait():
    mapper = mapper_with(pose__max_waiting_scans=3, pose__max_wait_s=100.0)
    insert(mapper, *[scan_at(stamp_s) for stamp_s in range(1, 8)])
    assert dropped(mapper) == {'queue_full': 4}
    add_pose(mapper, 0.0)
    add_pose(mapper, 9.0)
    assert [update.stamp_ns // S for update in mapper.insert_ready()] == [5, 6, 7]
    assert_counts_add_up(mapper)


def test_at_the_end_of_the_input_waiting_scans_are_dropped():
    mapper = mapper_with(pose__max_wait_s=100.0)
    insert(mapper, scan_at(1.0), scan_at(2.0))
    mapper.finish()
    assert dropped(mapper) == {'no_pose': 2}
    assert_counts_add_up(mapper)
    mapper.finish()
    assert dropped(mapper) == {'no_pose': 2}


# Time


def test_stamps_that_repeat_or_go_back_a_little_are_dropped():
    mapper = mapper_with(pose__source='identity', input__reset_after_s=1.0)
    scans = [scan_at(stamp_s) for stamp_s in (5.0, 5.0, 4.9, 4.0, 5.1, 5.05)]
    updates = insert(mapper, *scans)
    assert [update.stamp_ns for update in updates] == [5 * S, 51 * S // 10]
    assert dropped(mapper) == {'stamp_repeated': 1, 'stamp_back': 3}
    assert mapper.counters.resets == 0
    assert_counts_add_up(mapper)


def test_stamps_of_several_sensors_are_in_order_each_for_itself():
    mapper = mapper_with(pose__source='identity')
    scans = [(5.0, 'a'), (4.8, 'b'), (4.9, 'b'), (5.0, 'b'), (5.1, 'a'), (4.95, 'b')]
    updates = insert(mapper, *[scan_at(*scan) for scan in scans])
    assert len(updates) == 5
    assert dropped(mapper) == {'stamp_back': 1}


def test_a_stamp_that_goes_back_far_clears_the_map_and_says_so(caplog):
    mapper = mapper_with(pose__source='identity', input__reset_after_s=1.0)
    insert(mapper, scan_at(5.0), scan_at(6.0))
    later = [scan_at(4.999999999), scan_at(5.5)]
    with caplog.at_level(logging.WARNING):
        assert len(insert(mapper, *later)) == 2
    assert 'time went back by 1.000 s' in caplog.text
    assert 'lidar' in caplog.text
    assert mapper.counters.resets == 1
    assert len(mapper.window) == 2
    expected = SurfelMap(0.5)
    for scan in later:
        expected.add(scan.points)
    assert mapper.map.digest() == expected.digest()
    assert_counts_add_up(mapper)


def test_scans_that_wait_when_time_is_set_back_are_counted_as_cleared():
    mapper = mapper_with(pose__max_wait_s=100.0)
    insert(mapper, scan_at(50.0), scan_at(51.0), scan_at(1.0))
    assert dropped(mapper) == {'cleared': 2}
    assert_counts_add_up(mapper, waiting=1)


def test_after_time_is_set_back_a_scan_never_gets_a_pose_of_before():
    mapper = mapper_with(pose__max_wait_s=1.0)
    for stamp_s in range(10):
        add_pose(mapper, stamp_s, x=stamp_s)
        insert(mapper, scan_at(stamp_s))

    scan = scan_at(2.0)  # a simulation is reset, and the robot stands elsewhere
    assert insert(mapper, scan) == []
    add_pose(mapper, 1.9, x=100.0)
    add_pose(mapper, 2.1, x=100.0)
    (update,) = mapper.insert_ready()

    assert update.T_fixed_sensor[0, 3] == 100.0
    assert mapper.map.digest() == digest_of((scan, pose_matrix((100.0, 0, 0), LEVEL)))


def test_poses_that_were_set_back_before_the_scans_are_kept():
    mapper = mapper_with()
    for stamp_s in range(10):
        add_pose(mapper, stamp_s, x=stamp_s)
        insert(mapper, scan_at(stamp_s))
    add_pose(mapper, 1.5, x=100.0)
    add_pose(mapper, 2.5, x=100.0)
    (update,) = insert(mapper, scan_at(2.0))
    assert update.T_fixed_sensor[0, 3] == 100.0


def test_how_the_sensor_is_mounted_outlives_a_reset():
    mapper = mapper_with(pose__source='tf', frames__base_to_sensor=())
    mapper.add_pose('base_link', 'lidar', 0, (0.0, 0.0, 2.0), LEVEL, static=True)
    add_pose(mapper, 50.0)
    insert(mapper, scan_at(50.0), scan_at(3.0))
    add_pose(mapper, 3.0, x=4.0)
    (update,) = mapper.insert_ready()
    assert update.T_fixed_sensor[:3, 3].tolist() == [4.0, 0.0, 2.0]


# Bad scans


def test_scans_without_a_frame_or_points_are_dropped():
    mapper = mapper_with(pose__source='identity')
    nothing = np.empty((0, 3), np.float32)
    all_nan = np.full((9, 3), np.nan, np.float32)
    far = np.full((9, 3), 1e30, np.float32)
    updates = insert(
        mapper,
        scan_at(1.0, ''),
        scan_at(2.0, points=nothing),
        scan_at(3.0, points=all_nan),
        scan_at(4.0, points=far),
        scan_at(5.0),
    )
    assert len(updates) == 1
    assert dropped(mapper) == {'empty_frame_id': 1, 'no_points': 1, 'no_valid_points': 2}
    assert dict(mapper.counters.points_left_out) == {'not_finite': 9, 'beyond_map': 9}
    assert_counts_add_up(mapper)


def test_points_that_cannot_be_mapped_are_left_out_and_counted_and_the_others_mapped():
    points = scan_at(1.0).points.copy()
    points[[3, 9], 1] = np.nan
    points[5] = np.inf
    points[7] = [0.0, 3e38, 0.0]
    points[8] = [6e5, 0.0, 0.0]
    points[20] = [0.05, 0.0, 0.0]
    points[21] = [0.0, 0.0, 60.0]
    mapper = mapper_with(input__max_range_m=1e6)
    add_pose(mapper, 1.0)
    (update,) = insert(mapper, scan_at(1.0, points=points))
    assert dict(mapper.counters.points_left_out) == {
        'not_finite': 3, 'too_near': 1, 'too_far': 1, 'beyond_map': 1,
    }  # fmt: skip
    assert update.num_points == mapper.counters.points == mapper.map.num_points == 34
    good = np.delete(points, [3, 9, 5, 7, 8, 20], axis=0)
    assert mapper.map.digest() == digest_of((scan_at(1.0, points=good), np.eye(4)))


def test_the_range_is_measured_from_the_sensor():
    mapper = mapper_with(input__min_range_m=1.0, input__max_range_m=4.0)
    add_pose(mapper, 1.0, x=1000.0)
    points = np.array([[0.9, 0, 0], [1.0, 0, 0], [0, 4.0, 0], [0, 4.1, 0]])
    (update,) = insert(mapper, scan_at(1.0, points=points))
    assert update.num_points == 2
    assert dict(mapper.counters.points_left_out) == {'too_near': 1, 'too_far': 1}


def test_a_scan_that_the_map_refuses_is_dropped_and_the_next_one_mapped():
    mapper = mapper_with(pose__source='identity')
    crowd = np.ones((2**23 + 1, 3), np.float32, order='F')
    assert insert(mapper, scan_at(1.0, points=crowd)) == []
    assert dropped(mapper) == {'map_limit': 1}
    assert mapper.map.num_points == 0
    assert len(insert(mapper, scan_at(2.0))) == 1
    assert_counts_add_up(mapper)


def test_a_warning_names_the_cause_once_a_second_but_every_drop_is_counted(caplog):
    mapper = mapper_with()
    with caplog.at_level(logging.WARNING):
        insert(mapper, *[scan_at(stamp_s, '') for stamp_s in range(20)])
        insert(mapper, scan_at(1.0, points=np.empty((0, 3))))
    texts = [record.getMessage() for record in caplog.records]
    assert 1 <= sum('no frame_id' in text for text in texts) < 20
    assert any("in frame 'lidar' dropped: it has no points" in text for text in texts)
    assert dropped(mapper)['empty_frame_id'] == 20


# What an update says


def surfels_by_voxel(surfels):
    names = ('position', 'normal', 'planarity', 'curvature', 'eigenvalues', 'num_points')
    rows = zip(*(getattr(surfels, name).tolist() for name in names), strict=True)
    voxels = map(tuple, surfels.voxel_index.tolist())
    return {voxel: repr(row) for voxel, row in zip(voxels, rows, strict=True)}


@pytest.mark.parametrize('min_points', [1, 3])
def test_updates_keep_a_copy_of_the_map_up_to_date(min_points):
    mapper = mapper_with(map__min_points=min_points, window__max_scans=5)
    copy, moments = {}, {}
    for stamp_s in range(20):
        add_pose(mapper, stamp_s, x=0.4 * stamp_s)
        scan = scan_at(stamp_s)
        (update,) = insert(mapper, scan)
        changed = surfels_by_voxel(update.changed)

        pose = update.T_fixed_sensor
        twins = [reference.scan_moments(scan.points, 0.5, pose[:3, 3], pose)]
        reference.add_moments(moments, twins[0])
        for eviction in update.evictions:
            twins.append(reference.as_twin(eviction.scan.moments))
            reference.add_moments(moments, twins[-1], -1)
        touched = set().union(*twins)
        assert set(changed) == {v for v in touched if moments.get(v, [0])[0] >= min_points}

        for voxel in map(tuple, update.removed_voxel_index.tolist()):
            assert moments.get(voxel, [0])[0] < min_points
            copy.pop(voxel, None)
        copy.update(changed)
        assert copy == surfels_by_voxel(mapper.map.surfels(min_points))
    assert mapper.map.digest() == reference.digest(moments, 0.5)
    assert dict(mapper.counters.evicted) == {'max_scans': 15}


def test_normals_of_an_update_are_those_of_the_exact_twin():
    mapper = mapper_with(map__min_points=8)
    rng = np.random.default_rng(1)
    compared = 0
    for stamp_s in range(4):
        add_pose(mapper, stamp_s, x=0.1 * stamp_s, q_xyzw=TURNED)
        points = rng.uniform([-3, -3, -1], [3, 3, -0.9], (900, 3))
        (update,) = insert(mapper, scan_at(stamp_s, points=points))
    twins = reference.as_twin(mapper.map.moments())
    for voxel, normal in zip(
        map(tuple, update.changed.voxel_index.tolist()), update.changed.normal, strict=True
    ):
        twin = reference.surfel(voxel, twins[voxel], 0.5)
        e0, e1, e2 = twin['eigenvalues']
        if e1 - e0 > 1e-4 * e2 and twin['towards'] > 1e-6:
            compared += 1
            assert np.linalg.norm(normal - twin['normal']) <= 1e-6
    assert compared > 100


def test_every_stage_is_timed():
    mapper = mapper_with(pose__source='identity')
    (update,) = insert(mapper, scan_at(1.0))
    assert list(update.milliseconds) == ['reduce', 'insert', 'normals', 'total']
    parts = [update.milliseconds[name] for name in ('reduce', 'insert', 'normals')]
    assert min(parts) >= 0.0
    assert sum(parts) == pytest.approx(update.milliseconds['total'])
    assert set(mapper.summary()['milliseconds']) == set(update.milliseconds)


# Window and gate


@pytest.mark.parametrize(
    ('limits', 'left'),
    [
        ({'window__max_scans': 4}, 4),
        ({'window__max_age_s': 2.5}, 3),
        ({'window__max_distance_m': 1.3}, 3),
        ({'window__max_bytes': 1}, 1),
        ({'map__max_voxels': 1}, 1),
        ({'window__max_scans': 4, 'window__max_age_s': 1.5}, 2),
    ],
)
def test_the_limits_of_the_configuration_hold(limits, left):
    mapper = mapper_with(**limits)
    for stamp_s in range(9):
        add_pose(mapper, stamp_s, x=0.5 * stamp_s)
        insert(mapper, scan_at(stamp_s))
    assert len(mapper.window) == left
    scans = [scan_at(stamp_s) for stamp_s in range(9 - left, 9)]
    poses = [pose_matrix((0.5 * s, 0, 0), LEVEL) for s in range(9 - left, 9)]
    assert mapper.map.digest() == digest_of(*zip(scans, poses, strict=True))
    assert sum(mapper.counters.evicted.values()) == 9 - left
    assert set(mapper.counters.evicted) <= {name.split('__')[1] for name in limits}


def test_points_are_kept_where_asked():
    for keep in (False, True):
        mapper = mapper_with(pose__source='identity', window__keep_points=keep)
        scan = scan_at(1.0)
        insert(mapper, scan)
        (windowed,) = mapper.window
        assert (windowed.points is not None) == keep
        if keep:
            assert (windowed.points == scan.points).all()


def drive_gated(**gate):
    """Return which of 13 scans are mapped: x rises by 0.25 m to 1.5 m, then a turn by 10 deg."""
    mapper = mapper_with(**gate)
    mapped = []
    for number in range(13):
        angle = np.radians(10.0 * max(number - 6, 0)) / 2.0
        q = (0.0, 0.0, np.sin(angle), np.cos(angle))
        add_pose(mapper, number, x=0.25 * min(number, 6), q_xyzw=q)
        mapped += [update.stamp_ns // S for update in insert(mapper, scan_at(number))]
    assert mapper.counters.gated == 13 - len(mapped)
    assert_counts_add_up(mapper)
    return mapped


def test_the_motion_gate_leaves_out_scans_taken_while_standing_still():
    assert drive_gated() == list(range(13))
    assert drive_gated(window__gate_distance_m=0.5) == [0, 2, 4, 6]
    assert drive_gated(window__gate_angle_deg=25.0) == [0, 9, 12]
    both = drive_gated(window__gate_distance_m=0.7, window__gate_angle_deg=15.0)
    assert both == [0, 3, 6, 8, 10, 12]
    assert drive_gated(window__gate_distance_m=100.0) == [0]


def test_the_motion_gate_looks_back_to_the_last_scan_mapped():
    mapper = mapper_with(window__gate_distance_m=1.0)
    for number in range(20):  # 0.3 m a scan: each alone would be too little
        add_pose(mapper, number, x=0.3 * number)
        insert(mapper, scan_at(number))
    assert mapper.counters.mapped == 5
    mapper.clear()
    add_pose(mapper, 30.0, x=6.0)
    assert len(insert(mapper, scan_at(30.0))) == 1  # nothing to look back to


# While it runs


def test_live_settings_hold_from_the_next_scan_on():
    mapper = mapper_with(pose__source='identity', window__max_scans=5)
    insert(mapper, *[scan_at(stamp_s) for stamp_s in range(1, 8)])
    assert len(mapper.window) == 5
    new = mapper.config.replace({'window.max_scans': 2, 'map.min_points': 3})
    mapper.reconfigure(new)
    assert len(mapper.window) == 5
    (update,) = insert(mapper, scan_at(9.0))
    assert len(mapper.window) == 2
    assert update.changed.num_points.min() >= 3
    mapper.reconfigure(new.replace({'map.max_voxels': 1}))
    insert(mapper, scan_at(10.0))
    assert len(mapper.window) == 1


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('map.voxel_size_m', 0.25),
        ('pose.source', 'identity'),
        ('frames.fixed', 'map'),
        ('input.min_range_m', 1.0),
        ('window.keep_points', True),
    ],
)
def test_settings_of_the_start_are_refused_and_nothing_changes(name, value):
    mapper = mapper_with()
    before = mapper.config
    changed = before.replace({name: value, 'window.max_scans': 3})
    with pytest.raises(ConfigError, match=f'^{name}: cannot change while running'):
        mapper.reconfigure(changed)
    assert mapper.config is before
    assert mapper.window.config is before.window


def test_clear_forgets_scans_but_neither_poses_nor_counts():
    mapper = mapper_with(pose__max_wait_s=100.0)
    add_pose(mapper, 1.0)
    add_pose(mapper, 3.0)
    insert(mapper, scan_at(1.0), scan_at(2.0), scan_at(5.0))
    mapper.clear()
    assert mapper.map.digest() == SurfelMap(0.5).digest()
    assert len(mapper.window) == 0
    assert mapper.counters.mapped == 2
    assert dropped(mapper) == {'cleared': 1}
    assert_counts_add_up(mapper)
    add_pose(mapper, 6.0)
    assert len(insert(mapper, scan_at(5.5))) == 1


def test_the_summary_states_what_was_done_and_what_the_map_is():
    mapper = mapper_with(pose__source='identity', map__min_points=2, window__max_scans=2)
    insert(mapper, scan_at(1.0), scan_at(2.0), scan_at(2.0), scan_at(3.0), scan_at(4.0, ''))
    summary = mapper.summary()
    assert summary['scans'] == {
        'received': 5,
        'mapped': 3,
        'gated': 0,
        'evicted': {'max_scans': 1},
        'dropped': {'stamp_repeated': 1, 'empty_frame_id': 1},
        'dropped_by_frame': {'lidar': {'stamp_repeated': 1}, '': {'empty_frame_id': 1}},
    }
    assert summary['points'] == 120
    assert summary['window_scans'] == 2
    assert summary['voxels'] == mapper.map.num_voxels
    assert summary['surfels'] == len(mapper.map.surfels(2)) < summary['voxels']
    assert summary['digest'] == mapper.map.digest()
    assert summary['voxel_size_m'] == 0.5


def test_a_region_that_is_cleared_stays_empty_until_it_is_seen_again():
    mapper = mapper_with(window__max_scans=2, map__min_points=2)
    for stamp_s in (1.0, 2.0):
        add_pose(mapper, stamp_s)
        insert(mapper, scan_at(stamp_s))
    before = mapper.map.surfels(2)
    gone = mapper.clear_region(Ball((0.0, 0.0, 1.0), 2.0))
    centers = (before.voxel_index + 0.5) * 0.5
    inside = np.linalg.norm(centers - [0.0, 0.0, 1.0], axis=1) <= 2.0
    assert 0 < inside.sum() < len(before)
    assert sorted(gone.tolist()) == sorted(before.voxel_index[inside].tolist())
    add_pose(mapper, 3.0, x=100.0)
    (update,) = insert(mapper, scan_at(3.0))  # evicts the first, without what was cleared
    removed = update.removed_voxel_index.tolist()
    assert not set(map(tuple, gone.tolist())) & set(map(tuple, removed))
    assert_counts_add_up(mapper)


def test_frame_names_without_end_are_refused_and_do_not_pile_up():
    mapper = mapper_with(pose__source='identity')
    for number in range(MAX_FRAMES + MOST_FRAMES + 50):
        insert(mapper, scan_at(1.0 + number, frame_id=f'lidar_{number}'))
    assert mapper.counters.mapped == MAX_FRAMES
    assert dropped(mapper) == {'too_many_frames': MOST_FRAMES + 50}
    by_frame = mapper.counters.dropped_by_frame
    assert len(by_frame) == MOST_FRAMES + 1
    assert by_frame[OTHERS]['too_many_frames'] == 50
    insert(mapper, scan_at(1e4, frame_id='lidar_0'))  # those known go on
    assert mapper.counters.mapped == MAX_FRAMES + 1
    assert_counts_add_up(mapper)


COMPILED_BEFORE_THE_FIRST_SCAN = """
import importlib, pkgutil
import numpy as np
from surfel_mapper import kernels
from surfel_mapper.config import Config
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan

def compiled():
    found = {}
    for module in pkgutil.iter_modules(kernels.__path__):
        module = importlib.import_module('surfel_mapper.kernels.' + module.name)
        for name, kernel in vars(module).items():
            if hasattr(kernel, 'signatures'):
                found[name] = list(map(str, kernel.signatures))
    return found

config = Config.from_mapping({'pose.source': 'identity', 'window.max_scans': 2})
Mapper(config).warm_up()
before = compiled()
mapper = Mapper(config)
rng = np.random.default_rng(1)
for number in range(8):
    points = rng.uniform(-9.0, 9.0, (70_000 if number == 5 else 500, 3))
    points[: 66_000 if number == 5 else 0] = 1.0
    points = points.astype([np.float32, np.float64][number % 2])
    if number > 3:
        points = np.asfortranarray(points)
    points.setflags(write=number < 3)
    mapper.add_scan(Scan(points=points, stamp_ns=number * 10**9, frame_id='lidar'))
    assert len(list(mapper.insert_ready())) == 1
mapper.map.surfels_changed(since=-1)
mapper.summary()
after = compiled()
print({name: kinds for name, kinds in after.items() if kinds != before[name]})
"""


def test_after_the_warm_up_nothing_is_compiled_any_more():
    done = subprocess.run(
        [sys.executable, '-c', COMPILED_BEFORE_THE_FIRST_SCAN],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == '{}\n'


# Anything in any order

BAD = {
    'no frame': ('',),
    'no points': ('lidar', np.empty((0, 3))),
    'nan': ('lidar', np.full((3, 3), np.nan)),
    'far': ('lidar', np.full((3, 3), 1e20)),
}
EVENT = st.one_of(
    st.tuples(st.just('scan'), st.sampled_from([0.1, 0.2, 0.0, -0.3, -2.0, 0.7, 3.0])),
    st.tuples(st.just('pose'), st.sampled_from([0.0, 0.1, -0.1, 0.5, -5.0])),
    st.tuples(st.just('bad scan'), st.sampled_from(list(BAD))),
    st.tuples(st.sampled_from(['insert', 'insert', 'insert', 'clear']), st.none()),
)


@settings(max_examples=150)
@given(st.lists(EVENT, max_size=40), st.integers(0, 3), st.sampled_from([0.0, 0.3]))
def test_whatever_comes_in_the_counts_add_up_and_the_map_is_its_window(events, limit, gate_m):
    mapper = mapper_with(
        window__max_scans=limit + 1, window__gate_distance_m=gate_m, pose__max_waiting_scans=4
    )
    now_s, updates = 10.0, 0
    for kind, value in events:
        if kind == 'scan':
            now_s += value
            mapper.add_scan(scan_at(now_s))
        elif kind == 'pose':
            add_pose(mapper, now_s + value, x=0.2 * now_s)
        elif kind == 'bad scan':
            now_s += 0.05
            mapper.add_scan(scan_at(now_s, *BAD[value]))
        elif kind == 'clear':
            mapper.clear()
        else:
            updates += len(list(mapper.insert_ready()))
    counters = mapper.counters
    waiting = counters.received - counters.mapped - counters.gated - sum(dropped(mapper).values())
    assert 0 <= waiting <= 4
    assert updates == counters.mapped
    alone = SurfelMap(0.5)
    for scan in mapper.window:
        alone.insert(scan.moments)
    assert mapper.map.digest() == alone.digest()
    before = sum(dropped(mapper).values())
    mapper.finish()
    assert sum(dropped(mapper).values()) == before + waiting
    assert_counts_add_up(mapper)
