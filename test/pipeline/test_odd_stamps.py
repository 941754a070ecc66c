# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamps far from all others change nothing, unless scans and poses agree or one is alone."""

from __future__ import annotations

import pytest

from surfel_mapper.pipeline.stamp_guard import MAX_AHEAD_S, MAX_FRAMES, Order, StampGuard
from surfel_mapper.poses import TransformBuffer
from test.pipeline.made_scans import add_pose, assert_counts_add_up, insert, mapper_with, scan_at

YEAR_2033_S = 2e9


def drive(mapper, *stamps_s):
    updates = []
    for stamp_s in stamps_s:
        add_pose(mapper, stamp_s)
        updates += insert(mapper, scan_at(stamp_s))
    return [update.stamp_ns / 1e9 for update in updates]


@pytest.mark.parametrize('odd_s', [YEAR_2033_S, 40.0])
def test_one_scan_with_an_odd_stamp_is_dropped_and_the_map_stays(odd_s, caplog):
    mapper, expected = mapper_with(), mapper_with()
    drive(mapper, 100.0, 100.1)
    assert insert(mapper, scan_at(odd_s)) == []
    assert mapper.counters.dropped == {}  # held
    assert drive(mapper, 100.2, 100.3) == [100.2, 100.3]
    drive(expected, 100.0, 100.1, 100.2, 100.3)
    assert mapper.map.digest() == expected.map.digest()
    assert mapper.counters.dropped == {'odd_stamp': 1}
    assert mapper.counters.resets == 0
    assert 'the next message does not agree' in caplog.text
    assert_counts_add_up(mapper)


@pytest.mark.parametrize('ahead_s', [1.2, 5.0, 59.0])
def test_one_scan_with_a_stamp_ahead_is_dropped_while_it_waits_and_the_map_stays(ahead_s, caplog):
    mapper, expected = mapper_with(), mapper_with()
    drive(mapper, 100.0, 100.1)
    assert insert(mapper, scan_at(100.2 + ahead_s)) == []
    assert drive(mapper, 100.3, 100.4) == [100.3, 100.4]
    drive(expected, 100.0, 100.1, 100.3, 100.4)
    assert mapper.map.digest() == expected.map.digest()
    assert mapper.counters.dropped == {'odd_stamp': 1}
    assert mapper.counters.resets == 0
    assert f'its stamp is {ahead_s - 0.1:.3f} s ahead of the next scan' in caplog.text
    assert_counts_add_up(mapper)


def test_one_scan_with_a_stamp_ahead_stays_if_it_is_mapped_and_so_does_the_map(caplog):
    mapper, expected = mapper_with(pose__source='identity'), mapper_with(pose__source='identity')
    stamps_s = [100.0, 100.1, 105.2, 100.3, 100.4]
    updates = insert(mapper, *map(scan_at, stamps_s))
    assert [update.stamp_ns / 1e9 for update in updates] == stamps_s
    insert(expected, *map(scan_at, sorted(stamps_s)))
    assert mapper.map.digest() == expected.map.digest()
    assert mapper.counters.dropped == {}
    assert mapper.counters.resets == 0
    assert 'scan at 105.200000 s' in caplog.text
    assert_counts_add_up(mapper)


def test_a_scan_with_a_stamp_ahead_is_found_among_others_that_wait():
    mapper = mapper_with(pose__max_wait_s=10.0)
    drive(mapper, 100.0)
    scans = [scan_at(100.1), scan_at(100.1, 'rear'), scan_at(102.0), scan_at(100.2)]
    assert insert(mapper, *scans) == []
    assert mapper.counters.dropped == {'odd_stamp': 1}
    add_pose(mapper, 100.3)
    assert len(list(mapper.insert_ready())) == 3
    assert_counts_add_up(mapper)


def test_time_is_set_back_after_two_scans_ahead_and_to_before_the_last_two():
    for stamps_s in ([100.0, 105.0, 105.1, 98.1, 100.2], [100.0, 105.0, 99.5, 100.1]):
        mapper = mapper_with(pose__source='identity')
        insert(mapper, *map(scan_at, stamps_s))
        assert mapper.counters.resets == 1
        assert len(mapper.window) == 2


@pytest.mark.parametrize('odd_s', [YEAR_2033_S, 40.0])
def test_one_pose_with_an_odd_stamp_is_ignored(odd_s):
    mapper = mapper_with()
    drive(mapper, 100.0, 100.1)
    add_pose(mapper, odd_s, x=50.0)
    add_pose(mapper, 100.3, x=1.0)
    updates = insert(mapper, scan_at(100.2))
    assert [update.T_map_sensor[0, 3] for update in updates] == [pytest.approx(0.5)]
    assert mapper.counters.messages_ignored == {'odd_stamp': 1}
    assert mapper.counters.resets == 0


def test_time_is_set_back_when_pose_and_scan_agree():
    mapper, expected = mapper_with(), mapper_with()
    drive(mapper, 100.0, 100.1)
    assert drive(mapper, 40.0, 40.1) == [40.0, 40.1]
    drive(expected, 40.0, 40.1)
    assert mapper.map.digest() == expected.map.digest()
    assert mapper.counters.resets == 1
    assert mapper.counters.dropped == {}


def test_time_is_set_back_when_two_scans_agree():
    mapper = mapper_with(pose__source='identity')
    insert(mapper, scan_at(100.0), scan_at(100.1))
    assert insert(mapper, scan_at(40.0)) == []
    assert mapper.counters.resets == 0
    updates = insert(mapper, scan_at(42.0))  # slower than any lidar
    assert [update.stamp_ns / 1e9 for update in updates] == [40.0, 42.0]
    assert mapper.counters.resets == 1
    assert mapper.map.digest() != mapper_with().map.digest()


def test_after_a_long_pause_no_message_is_lost():
    mapper = mapper_with()
    stamps_s = [100.0, 100.0 + 2 * MAX_AHEAD_S, 100.1 + 2 * MAX_AHEAD_S]
    assert drive(mapper, *stamps_s) == stamps_s
    assert mapper.counters.dropped == {}
    assert mapper.counters.resets == 0


@pytest.mark.parametrize('steps_s', [[70] * 6, [70, 95, 64, 120, 61, 90], [10, 300, 20, 30]])
def test_every_scan_of_a_sensor_that_stops_to_scan_is_mapped(steps_s):
    mapper = mapper_with(pose__source='identity')
    stamps_s = [100.0, *(100.0 + sum(steps_s[: k + 1]) for k in range(len(steps_s)))]
    updates = insert(mapper, *(scan_at(stamp_s) for stamp_s in stamps_s))
    assert [update.stamp_ns / 1e9 for update in updates] == stamps_s
    assert mapper.counters.dropped == {}
    assert mapper.counters.resets == 0


def test_a_scan_after_a_step_far_longer_than_those_before_it_is_held():
    mapper = mapper_with(pose__source='identity')
    insert(mapper, *(scan_at(stamp_s) for stamp_s in (100.0, 170.0, 240.0)))
    assert insert(mapper, scan_at(YEAR_2033_S)) == []
    assert len(insert(mapper, scan_at(310.0), scan_at(380.0))) == 2
    assert mapper.counters.dropped == {'odd_stamp': 1}
    assert mapper.counters.resets == 0


def test_a_sensor_whose_scans_come_late_does_not_clear_the_map():
    mapper = mapper_with()
    late_s = 1.1  # more than input.reset_after_s, but near to the poses
    add_pose(mapper, 98.0)
    for k in range(20):
        stamp_s = 100.0 + 0.1 * k
        add_pose(mapper, stamp_s - 0.2)
        insert(mapper, scan_at(stamp_s, 'front'))
        insert(mapper, scan_at(stamp_s - late_s, 'rear'))
    add_pose(mapper, 103.0)
    list(mapper.insert_ready())
    assert mapper.counters.resets == 0
    assert mapper.counters.mapped == 40
    assert mapper.counters.dropped == {}
    assert_counts_add_up(mapper)


def test_a_message_that_is_held_at_the_end_is_counted():
    mapper = mapper_with()
    drive(mapper, 100.0)
    insert(mapper, scan_at(YEAR_2033_S))
    mapper.finish()
    assert mapper.counters.dropped == {'odd_stamp': 1}
    assert_counts_add_up(mapper)


def test_a_lidar_is_mapped_after_many_frames_that_came_once():
    mapper = mapper_with(pose__source='identity')
    for number in range(3 * MAX_FRAMES):
        insert(mapper, scan_at(100.0 + 0.01 * number, f'frame_{number}'))
    updates = insert(mapper, *(scan_at(102.0 + 0.1 * k) for k in range(5)))
    assert len(updates) == 5
    assert mapper.counters.dropped == {}
    insert(mapper, scan_at(102.3))
    assert mapper.counters.dropped == {'stamp_repeated': 1}  # its stamps are kept


def test_two_odd_messages_that_do_not_agree_are_both_dropped():
    guard = StampGuard(1.0, TransformBuffer())
    judged = []
    for stamp_s in (100.0, 2e9, 50.0, 100.1):
        for message, odd in guard.judge(scan_at(stamp_s)):
            judged.append((message.stamp_ns / 1e9, bool(odd)))
            if not odd:
                guard.order(message)
    assert judged == [(100.0, False), (2e9, True), (50.0, True), (100.1, False)]


def test_a_scan_far_before_the_last_of_its_frame_is_judged_by_those_before_that():
    def orders(*stamps_s):
        guard = StampGuard(1.0, TransformBuffer())
        return [guard.order(scan_at(stamp_s)) for stamp_s in stamps_s]

    *_, continued = orders(100.0, 105.0, 100.1)
    assert (continued.odd_ns, continued.back_s, continued.cause) == (105 * 10**9, 0.0, '')
    *_, set_back, after = orders(100.0, 105.0, 99.0, 99.1)
    assert (set_back.odd_ns, set_back.back_s, set_back.cause) == (None, 6.0, '')
    assert after == Order()
    *_, late, repeated = orders(100.0, 100.2, 100.1, 100.0)
    assert (late.cause, repeated.cause) == ('', 'stamp_repeated')
    assert repeated.reason == 'its stamp is that of an earlier scan'


def test_a_late_scan_is_dropped_if_its_pose_comes_from_registration():
    guard = StampGuard(1.0, TransformBuffer())
    orders = [guard.order(scan_at(stamp_s), takes_late=False) for stamp_s in (100.0, 100.2, 100.1)]
    assert [order.cause for order in orders] == ['', '', 'stamp_back']


def drive_of_two(offsets_s, *, rear_hz=20, pose_hz=50, start_s=1.7e9):
    """Drive for 3 s with a front lidar at 10 Hz and rear ones by other clocks."""
    mapper = mapper_with()
    events = [(k / pose_hz, 'pose') for k in range(-5, 3 * pose_hz + 5)]
    events += [(0.001 + k / 10, '') for k in range(30)]
    for number, offset_s in enumerate(offsets_s):
        events += [(0.002 + k / rear_hz, (number, offset_s)) for k in range(3 * rear_hz)]
    for time_s, kind in sorted(events, key=lambda event: event[0]):
        if kind == 'pose':
            add_pose(mapper, start_s + time_s, x=time_s)
        elif kind:
            number, offset_s = kind
            mapper.add_scan(scan_at(start_s + time_s + offset_s, f'rear{number}'), f'/b{number}')
        else:
            mapper.add_scan(scan_at(start_s + time_s), '/a')
        list(mapper.insert_ready())
    mapper.end_scans()
    list(mapper.insert_ready())
    mapper.finish()
    assert_counts_add_up(mapper)
    return mapper


@pytest.mark.parametrize('offset_s', [-1.7e9 + 614.0, -37.0, 3600.0])
@pytest.mark.parametrize('rear_hz', [5, 20])
def test_a_sensor_with_another_clock_leaves_the_map_of_the_first(offset_s, rear_hz, caplog):
    mapper = drive_of_two([offset_s], rear_hz=rear_hz)
    assert mapper.counters.resets == 0
    assert mapper.counters.mapped == 30
    assert mapper.map.digest() == drive_of_two([]).map.digest()
    assert 'on /b0 at' in caplog.text


def test_two_sensors_with_one_other_clock_do_not_outvote_the_poses():
    mapper = drive_of_two([-1.7e9 + 614.0, -1.7e9 + 614.0])
    assert mapper.counters.resets == 0
    assert mapper.map.digest() == drive_of_two([]).map.digest()


@pytest.mark.parametrize('source', ['tf', 'identity'])
def test_a_lidar_that_counts_from_1970_for_a_second_costs_that_second(source):
    mapper, expected = mapper_with(pose__source=source), mapper_with(pose__source=source)
    for k in range(60):
        stamp_s = 1.7e9 + 0.1 * k
        is_reset = 20 <= k < 30
        for each in (mapper, expected):
            if source == 'tf':
                add_pose(each, stamp_s, x=0.1 * k)
        insert(mapper, scan_at(0.1 * (k - 20) if is_reset else stamp_s))
        if not is_reset:
            insert(expected, scan_at(stamp_s))
    assert mapper.counters.dropped == {'odd_stamp': 10}
    assert mapper.counters.resets == 0
    assert mapper.counters.mapped == 50
    assert mapper.map.digest() == expected.map.digest()


def test_poses_that_begin_by_another_clock_than_the_scans_are_used():
    mapper = mapper_with()
    insert(mapper, scan_at(614.0), scan_at(614.1))
    for k in range(20):
        add_pose(mapper, 1.7e9 + 0.02 * k)
        insert(mapper, scan_at(614.2 + 0.02 * k))
    assert mapper.counters.messages_ignored == {}
    assert mapper.transforms.newest_ns == round((1.7e9 + 0.38) * 1e9)
