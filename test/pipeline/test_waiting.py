# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Mapper: scans wait for poses in the time of the data, and time may be set back."""

from dataclasses import replace
import logging

import numpy as np
import pytest

from surfel_mapper.geometry import pose_matrix
from surfel_mapper.mapping.surfel_map import SurfelMap
from test.pipeline.made_scans import (
    add_pose,
    assert_counts_add_up,
    digest_of,
    dropped,
    insert,
    LEVEL,
    mapper_with,
    S,
    scan_at,
)

pytestmark = pytest.mark.filterwarnings('error')


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


def test_a_scan_newer_than_all_poses_waits_longer():
    mapper = mapper_with(pose__max_wait_s=0.5, pose__max_delay_s=4.0)
    add_pose(mapper, 1.0)
    assert insert(mapper, *[scan_at(1.5 + tenths / 10) for tenths in range(41)]) == []
    assert_counts_add_up(mapper, waiting=41)
    assert insert(mapper, scan_at(5.6)) == []  # 4.1 s ahead of the first
    assert dropped(mapper) == {'no_pose': 1}
    add_pose(mapper, 1.8)
    assert [update.stamp_ns * 10 // S for update in mapper.insert_ready()] == [16, 17, 18]
    assert_counts_add_up(mapper, waiting=38)
    assert dropped(mapper) == {'no_pose': 1}


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


def test_at_the_end_of_the_input_scans_behind_a_gap_of_the_poses_are_mapped():
    mapper = mapper_with(pose__max_wait_s=100.0, pose__max_gap_s=0.5)
    for stamp_s in (0.9, 1.1, 2.9, 3.1):
        add_pose(mapper, stamp_s)
    updates = insert(mapper, scan_at(1.0), scan_at(2.0), scan_at(3.0))
    assert [update.stamp_ns for update in updates] == [S]
    mapper.end_scans()
    assert [update.stamp_ns for update in mapper.insert_ready()] == [3 * S]
    assert dropped(mapper) == {'no_pose': 1}
    mapper.finish()
    assert_counts_add_up(mapper)


# Time


def test_stamps_that_go_back_a_little_are_mapped_and_those_that_repeat_dropped():
    mapper = mapper_with(pose__source='identity', input__reset_after_s=1.0)
    stamps_s = [5.0, 5.0, 4.9, 4.0, 5.1, 4.9, 5.05]
    updates = insert(mapper, *map(scan_at, stamps_s))
    assert [update.stamp_ns / S for update in updates] == [5.0, 4.9, 4.0, 5.1, 5.05]
    assert dropped(mapper) == {'stamp_repeated': 2}
    assert mapper.counters.resets == 0
    assert_counts_add_up(mapper)


def test_stamps_of_several_sensors_are_in_order_each_for_itself():
    mapper = mapper_with(pose__source='identity')
    scans = [(5.0, 'a'), (4.8, 'b'), (4.9, 'b'), (5.0, 'b'), (5.1, 'a'), (4.95, 'b')]
    updates = insert(mapper, *[scan_at(*scan) for scan in scans])
    assert len(updates) == 6
    assert dropped(mapper) == {}


def test_scans_that_wait_are_sorted_by_their_stamps():
    mapper, expected = mapper_with(window__max_scans=3), mapper_with(window__max_scans=3)
    insert(mapper, *(scan_at(stamp_s) for stamp_s in (5.0, 5.2, 5.3, 5.1, 5.4)))
    for each in (mapper, expected):
        add_pose(each, 4.9, x=1.0)
        add_pose(each, 5.45, x=2.0)
    updates = list(mapper.insert_ready())
    assert [update.stamp_ns / S for update in updates] == [5.0, 5.1, 5.2, 5.3, 5.4]
    insert(expected, *(scan_at(stamp_s) for stamp_s in (5.0, 5.1, 5.2, 5.3, 5.4)))
    assert mapper.map.digest() == expected.map.digest()


def test_topics_with_one_frame_and_equal_stamps_are_both_mapped():
    mapper = mapper_with(pose__source='identity')
    for stamp_s in (5.0, 5.1):
        for topic in ('/points', '/points2', '/points2'):
            mapper.add_scan(scan_at(stamp_s), topic)
    assert len(list(mapper.insert_ready())) == 4
    assert dropped(mapper) == {'stamp_repeated': 2}


def test_offsets_of_topics_are_added_to_the_stamps_of_their_scans():
    mapper = mapper_with(
        input__topics=['points', '/rear/points'],
        input__time_offset_s=1.0,
        input__time_offsets_s=[-38.0, 3.0],
    )
    add_pose(mapper, 4.0, x=0.0)
    add_pose(mapper, 4.4, x=4.0)

    for stamp_s, topic in ((41.1, '/front/points'), (0.2, '/rear/points')):
        mapper.add_scan(scan_at(stamp_s), topic)
    stamps_ns = [update.stamp_ns for update in mapper.insert_ready()]

    assert stamps_ns == [4_100_000_000, 4_200_000_000]


def test_a_stamp_that_goes_back_far_clears_the_map_and_says_so(caplog):
    mapper = mapper_with(
        pose__source='identity', frames__base_to_sensor=(), input__reset_after_s=1.0
    )
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
    insert(mapper, *map(scan_at, (50.0, 51.0, 1.0, 2.0, 3.0)))
    assert dropped(mapper) == {'cleared': 2}
    assert_counts_add_up(mapper, waiting=3)


def test_scans_with_their_poses_are_mapped_before_time_is_set_back():
    mapper = mapper_with(pose__source='identity', map__min_points=1)
    stamps_s = [100.0, 100.1, 100.2, 100.3, 1.0, 2.0, 3.0]
    updates = []
    for stamp_s in stamps_s:
        mapper.add_scan(scan_at(stamp_s))
        updates += mapper.insert_ready()
    assert [update.stamp_ns / 1e9 for update in updates] == stamps_s
    assert mapper.counters.resets == 1
    assert len(mapper.window) == 3
    later = mapper_with(pose__source='identity')
    insert(later, *(scan_at(stamp_s) for stamp_s in stamps_s[4:]))
    assert mapper.map.digest() == later.map.digest()
    assert_counts_add_up(mapper)


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

    assert update.T_map_sensor[0, 3] == 100.0
    assert mapper.map.digest() == digest_of((scan, pose_matrix((100.0, 0, 0), LEVEL)))


def test_the_mount_of_the_sensor_survives_a_reset():
    mapper = mapper_with(pose__source='tf', frames__base_to_sensor=())
    mapper.add_pose('base_link', 'lidar', 0, (0.0, 0.0, 2.0), LEVEL, static=True)
    add_pose(mapper, 50.0)
    insert(mapper, scan_at(50.0), scan_at(3.0))
    add_pose(mapper, 3.0, x=4.0)
    (update,) = mapper.insert_ready()
    assert update.T_map_sensor[:3, 3].tolist() == [4.0, 0.0, 2.0]


def test_a_scan_in_a_long_gap_of_poses_waits_and_is_dropped(caplog):
    mapper = mapper_with(pose__max_gap_s=0.5)
    add_pose(mapper, 1.0)
    add_pose(mapper, 1.4, x=4.0)
    mapper.add_scan(scan_at(1.2))
    assert [update.T_map_sensor[0, 3] for update in mapper.insert_ready()] == [pytest.approx(2.0)]
    add_pose(mapper, 10.0, x=90.0)
    mapper.add_scan(scan_at(9.9))
    assert list(mapper.insert_ready()) == []  # a pose in between may come
    add_pose(mapper, 10.39, x=94.0)
    assert list(mapper.insert_ready()) == []
    add_pose(mapper, 10.5, x=95.0)
    mapper.add_scan(scan_at(10.2))
    assert [update.T_map_sensor[0, 3] for update in mapper.insert_ready()] == [
        pytest.approx(90.0 + 4.0 * 0.2 / 0.39)
    ]
    assert mapper.counters.dropped == {'no_pose': 1}
    assert 'in a gap of 8.600 s' in caplog.text


def test_transforms_that_are_stamped_ahead_do_not_shorten_the_wait():
    mapper = mapper_with(pose__source='tf', pose__max_gap_s=0.3, frames__fixed='map')
    add_pose(mapper, 0.0, parent='map', child='odom')
    add_pose(mapper, 0.2, parent='map', child='odom')
    for stamp_s in (0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0):  # as of a localisation
        add_pose(mapper, stamp_s, parent='map', child='odom')
    add_pose(mapper, 0.9)
    add_pose(mapper, 1.4, x=5.0)
    mapper.add_scan(scan_at(1.2))
    assert list(mapper.insert_ready()) == []
    add_pose(mapper, 1.15, x=2.5)
    (update,) = mapper.insert_ready()
    assert update.T_map_sensor[0, 3] == pytest.approx(3.0)
    assert dropped(mapper) == {}


def test_a_frame_is_found_at_the_newest_time_at_which_its_pose_is_known():
    mapper = mapper_with(pose__source='tf')
    add_pose(mapper, 1.0, x=1.0)
    add_pose(mapper, 2.0, x=2.0)
    add_pose(mapper, 5.0, x=0.1, parent='base_link', child='wheel')
    assert mapper.T_map_of('base_link', 0)[0, 3] == 2.0


def sweep_at(stamp_s):
    """Return a scan of 40 points that were measured within 0.1 s."""
    scan = scan_at(stamp_s)
    return replace(scan, columns={'t': np.linspace(0, 10**8, len(scan)).astype(np.uint32)})


def test_a_sweep_with_a_gap_of_poses_in_its_middle_waits_for_them(caplog):
    mapper = mapper_with(pose__max_gap_s=0.03, deskew__enabled=True)
    early = [0.90 + 0.01 * step for step in range(13)]  # to 1.02
    late = [1.08 + 0.01 * step for step in range(13)]  # to 1.20
    for stamp_s in (*early, *late):
        angle = 0.5 * (stamp_s - 0.9)
        add_pose(mapper, stamp_s, q_xyzw=(0.0, 0.0, np.sin(angle), np.cos(angle)))
    for stamp_s in (0.91, 1.0, 1.09):  # the second has the gap within, and ends at 1.1
        mapper.add_scan(sweep_at(stamp_s))
    assert [update.stamp_ns for update in mapper.insert_ready()] == [round(0.91 * S)]
    assert_counts_add_up(mapper, waiting=2)

    add_pose(mapper, 3.0)
    mapper.add_scan(sweep_at(2.9))
    assert [update.stamp_ns for update in mapper.insert_ready()] == [round(1.09 * S)]
    assert dropped(mapper) == {'no_pose': 1}
    assert 'in a gap of 0.060 s' in caplog.text
