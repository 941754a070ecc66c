# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Clocks that differ, and messages without stamps, as the node receives them."""

from __future__ import annotations

import time

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry

from surfel_mapper.config import InputConfig
from surfel_mapper.ros import clock_watch
from surfel_mapper.ros.clock_watch import ClockWatch
from test.ros.driving import arguments
from test.ros.live import cloud, odometry, room

SECOND_NS = 10**9


@pytest.fixture
def arrival(monkeypatch):
    """Return the clock of arrivals, ns and s, which a test sets."""
    now = [1_700_000_000 * SECOND_NS]
    monkeypatch.setattr(clock_watch.time, 'time_ns', lambda: now[0])
    monkeypatch.setattr(clock_watch.time, 'monotonic', lambda: now[0] / SECOND_NS)
    return now


def watched(arrival, config, seconds, *, period_s=0.1, rate=1.0, topics=('/points',)):
    """Return the watch of a drive in which clouds are ahead of poses, and its warnings."""
    warnings = []
    watch = ClockWatch(config, warnings.append, lambda: arrival[0])
    begin_ns = arrival[0]
    for _ in range(60):
        arrival[0] += round(period_s * SECOND_NS)
        stamp_ns = begin_ns + round(rate * (arrival[0] - begin_ns))
        watch.note_poses('/odom', [stamp_ns - 10_000_000])
        for topic, ahead_s in zip(topics, seconds, strict=True):
            watch.note_cloud(topic, stamp_ns + round(ahead_s * SECOND_NS))
    return watch, warnings


@pytest.mark.parametrize('seconds', [37.0, -3600.0, 1.0, -1.7e9])
def test_a_steady_offset_is_named_once_with_its_correction(arrival, seconds):
    watch, warnings = watched(arrival, InputConfig(), [seconds])

    measured_s = seconds + 0.01
    side = 'ahead of' if seconds > 0 else 'behind'
    assert warnings == [watch.problem]
    assert f'by the arrival times, stamps of /points are {abs(measured_s):.3f} s {side} those' in (
        watch.problem
    )
    assert f'; input.time_offset_s: {-measured_s:.3f} corrects them' in watch.problem


@pytest.mark.parametrize(
    ('config', 'seconds', 'rate'),
    [
        (InputConfig(), 0.3, 1.0),  # a delay
        (InputConfig(time_offset_s=-37.0), 37.0, 1.0),
        (InputConfig(topics=('points',), time_offsets_s=(-37.0,)), 37.0, 1.0),
        (InputConfig(), 0.0, 0.3),  # a bag that is played slowly
    ],
)
def test_delays_and_corrected_clocks_are_no_offset(arrival, config, seconds, rate):
    watch, warnings = watched(arrival, config, [seconds], rate=rate)

    assert (watch.problem, warnings) == ('', [])


def test_one_of_two_lidars_with_another_clock_is_named(arrival):
    config = InputConfig(topics=('/a/points', '/b/points'), time_offsets_s=(0.0, 5.0))

    watch, _ = watched(arrival, config, [0.0, 37.0], topics=config.topics)

    assert 'stamps of /a/points' not in watch.problem
    assert 'stamps of /b/points are 42.010 s ahead of those of /odom' in watch.problem
    assert 'input.time_offsets_s, -37.010 for /b/points, corrects them' in watch.problem


def test_an_offset_that_ends_is_no_problem_any_more(arrival):
    watch, _ = watched(arrival, InputConfig(), [37.0])

    for _ in range(clock_watch.KEPT):
        arrival[0] += SECOND_NS
        watch.note_poses('/odom', [arrival[0]])
        watch.note_cloud('/points', arrival[0])

    assert watch.problem == ''


def drive(peer, number, cloud_ns, pose_ns=0):
    """Send poses and clouds with stamps relative to the present, or of 0 if None."""
    for step in range(number):
        now_ns = time.time_ns()
        for topic, offset_ns in (('/odom', pose_ns), ('/points', cloud_ns)):
            stamp_ns = 0 if offset_ns is None else now_ns + offset_ns
            message = cloud(stamp_ns, room(seed=step))
            if topic == '/odom':
                message = odometry(stamp_ns, (0.01 * step, 0.0, 0.0))
            peer.publish(topic, message)
        peer.spin_for(0.05)


def test_an_offset_is_named_in_log_and_diagnostics(start, peer):
    node = start('node', *arguments())
    node.wait_for_output('ready')
    reports = peer.collect(DiagnosticArray, '/diagnostics')
    peer.advertise('/odom', '/points')

    drive(peer, 50, 37 * SECOND_NS)

    text = 'ahead of those of /odom: the clocks differ (TAI is ahead of UTC by 37 s)'
    node.wait_for_output(text)
    peer.spin_until(lambda: any(text in report.status[0].message for report in reports))
    assert node.stop() == 0


def test_clouds_and_poses_without_stamps_get_the_times_of_their_arrival(start, peer):
    node = start('node', *arguments(**{'pose.max_wait_s': 5.0}))
    node.wait_for_output('ready')
    changed = peer.collect(type(cloud(0, room(seed=0))), '/surfel_mapper/changed')
    peer.advertise('/points')
    peer.advertise('/odom', kinds={'/odom': Odometry})

    before_ns = time.time_ns()
    drive(peer, 10, None, None)
    peer.spin_until(lambda: len(changed) >= 5, what=lambda: node.output)

    stamps_ns = [m.header.stamp.sec * SECOND_NS + m.header.stamp.nanosec for m in changed]
    assert all(before_ns < stamp_ns < time.time_ns() for stamp_ns in stamps_ns)
    for topic in ('/points', '/odom'):
        text = f'{topic}: header.stamp is 0, not set: the arrival times are used'
        assert node.output.count(text) == 1
    assert node.stop() == 0
