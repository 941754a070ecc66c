# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The subscription executor: poses before clouds, malformed messages, events, shutdown."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from std_msgs.msg import Int32, String

from surfel_mapper.ros.subscription_executor import SubscriptionExecutor
from test.ros.live import cloud, odometry, room, START_NS, TIMEOUT_S

ARGUMENTS = (
    '--ros-args',
    *('-p', 'pose.source:=odometry'),
    *('-p', 'frames.base_to_sensor:=[0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]'),
    *('-p', 'publish.diagnostics_rate_hz:=20.0'),
)
PERIOD_NS = 100_000_000
NUM_CLOUDS = 18
"""Fewer than the queue of the node holds, so that none is dropped."""

ALL = QoSProfile(depth=1000)


@pytest.mark.parametrize('rate_hz', [100, 200])
def test_every_cloud_of_a_burst_has_its_pose(start, peer, rate_hz):
    node = start('node', *ARGUMENTS)
    peer.advertise('/odom', '/points', depth=1000)
    step_ns = 10**9 // rate_hz
    for number in range(NUM_CLOUDS):
        first_ns = START_NS + number * PERIOD_NS
        for stamp_ns in range(first_ns, first_ns + PERIOD_NS, step_ns):
            peer.publish('/odom', odometry(stamp_ns, (1e-9 * (stamp_ns - START_NS), 0.0, 0.0)))
        if number:  # between two poses, both sent before it
            peer.publish('/points', cloud(first_ns - step_ns // 2, room(seed=number)))

    _, values = peer.diagnosis({'scans.received': NUM_CLOUDS - 1, 'queue': 0, 'waiting': 0})
    assert [key for key in values if key.startswith('scans.dropped')] == [], node.output
    assert values['scans.mapped'] == str(NUM_CLOUDS - 1)


@pytest.fixture
def peer(guarded_peer):
    return guarded_peer


class Bench:
    """A subscription executor in the node of a peer, the messages taken, and its failures."""

    def __init__(self, peer):
        self.taken = []
        self.failures = []
        self.executor = SubscriptionExecutor(peer.node, self.failures.append)

    def take(self, message):
        self.taken.append(message.data)


@pytest.fixture
def bench(peer):
    bench = Bench(peer)
    yield bench
    bench.executor.stop()


def published(peer, topic, kind, values, qos=ALL):
    """Publish messages once there is a subscriber; return when they are acknowledged."""
    publisher = peer.node.create_publisher(kind, topic, qos)
    peer.spin_until(publisher.get_subscription_count)
    for value in values:
        publisher.publish(kind(data=value))
    assert publisher.wait_for_all_acked(Duration(seconds=TIMEOUT_S))


def test_all_eager_messages_are_taken_before_every_other_one(peer, bench):
    bench.executor.subscribe(String, 'others', bench.take, ALL)
    bench.executor.subscribe(Int32, 'eager', bench.take, ALL, eager=True)
    published(peer, 'others', String, ['a', 'b', 'c'])
    published(peer, 'eager', Int32, range(100))

    bench.executor.start()

    peer.spin_until(lambda: len(bench.taken) == 103)
    assert bench.taken == [*range(100), 'a', 'b', 'c']
    assert bench.executor.topics() == ['/eager', '/others']
