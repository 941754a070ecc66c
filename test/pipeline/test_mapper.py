# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Mapper: poses from every source, settings and summaries.

Every map is compared by digest with one made from the points and the poses alone. Whatever comes
in, scans received = mapped + gated + dropped + waiting.
"""

import numpy as np
import pytest

from surfel_mapper.errors import ConfigError
from surfel_mapper.geometry import compose, interpolate, pose_matrix
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.pipeline.regions import Ball
from test.pipeline.made_scans import (
    add_pose,
    assert_counts_add_up,
    digest_of,
    dropped,
    insert,
    LEVEL,
    mapper_with,
    MOUNTED,
    S,
    scan_at,
    TURNED,
)

pytestmark = pytest.mark.filterwarnings('error')


# Poses


def test_clouds_in_the_fixed_frame_need_no_pose():
    mapper = mapper_with(pose__source='identity', frames__base_to_sensor=())
    scans = [scan_at(1.0, 'odom'), scan_at(2.0, 'map')]
    updates = insert(mapper, *scans)
    assert [update.stamp_ns for update in updates] == [S, 2 * S]
    assert (updates[0].T_map_sensor == np.eye(4)).all()
    expected = SurfelMap(0.5)
    for scan in scans:
        expected.add(scan.points)  # their viewpoint is unknown
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
        assert (update.T_map_sensor == pose).all()
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
    assert np.abs(update.T_map_sensor - pose).max() <= 1e-15 * 16
    assert mapper.map.digest() == digest_of((scan, update.T_map_sensor))


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


def test_a_quaternion_of_two_digits_is_normalised_with_one_warning(caplog):
    mapper = mapper_with(frames__base_to_sensor=())
    add_pose(mapper, 1.0, 1.0)
    for _ in range(2):
        mapper.add_pose('base_link', 'lidar', 0, (0, 0, 1), (0, 0, 0.71, 0.71), static=True)
    scan = scan_at(1.0)
    insert(mapper, scan)
    quarter_turn = pose_matrix((1.0, 0, 1.0), (0, 0, 0.5**0.5, 0.5**0.5))
    assert mapper.map.digest() == digest_of((scan, quarter_turn))
    assert [record.message for record in caplog.records] == [
        "pose of 'lidar' in 'base_link': quaternion [0, 0, 0.71, 0.71] is normalised"
    ]


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
    mapper.reconfigure(new.replace({'window.max_bytes': 1}))
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
    (update,) = insert(mapper, scan_at(3.0))  # evicts the first, without the cleared voxels
    removed = update.removed_voxel_index.tolist()
    assert not set(map(tuple, gone.tolist())) & set(map(tuple, removed))
    assert_counts_add_up(mapper)


@pytest.mark.parametrize(
    ('mount', 'up'),
    [((), 1.0), ((0.0, 0.0, 2.0, *LEVEL), 1.0), ((0.0, 0.0, -2.0, *LEVEL), -1.0)],
)
def test_normals_turn_to_a_standing_sensor_only_if_its_place_is_given(mount, up):
    mapper = mapper_with(pose__source='identity', frames__base_to_sensor=mount)
    grid = np.stack(np.meshgrid(np.arange(0.05, 2.0, 0.1), np.arange(0.05, 2.0, 0.1), [0.1]), -1)

    (update,) = insert(mapper, scan_at(1.0, points=grid.reshape(-1, 3).astype(np.float32)))

    assert np.allclose(update.changed.normal, [0.0, 0.0, up], atol=1e-6)
