# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reliability follows the publishers: the table of docs/inputs.md, and publishers that come and go.

The publishers of the table are processes that use rclpy and its defaults only.
"""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int32, String

from surfel_mapper.ros.base_node import BaseNode
from surfel_mapper.ros.context import PROFILE
from surfel_mapper.ros.diagnostics import publishers
from surfel_mapper.ros.subscription_executor import FOLLOW_S, SubscriptionExecutor
from test.ros.live import Peer, reliably, START_NS
from test.ros.ordinary import node_on_defaults, NUMBER, publish

SIZES = (200_000, 2_000_000, 8_000_000)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=10)


@pytest.fixture
def peer(guarded_peer):
    return guarded_peer


@pytest.fixture(scope='module')
def node(prefork, tmp_path_factory):
    """Run a node that other tests of this file share."""
    with node_on_defaults(tmp_path_factory.mktemp('qos')) as node:
        yield node


@pytest.mark.parametrize(
    ('reliability', 'profile', 'promised'),
    [
        ('reliable', False, SIZES),
        ('reliable', True, SIZES),
        ('best_effort', True, SIZES),
        ('best_effort', False, SIZES[:1]),
    ],
)
def test_all_clouds_of_the_promised_sizes_arrive(node, peer, reliability, profile, promised):
    number = 2 * (reliability == 'reliable') + profile
    first_ns = START_NS + number * 1000 * 10**9

    peer.diagnosis({'normals': 'not oriented'})
    options = {'profile': profile, 'promised': promised, 'sizes': SIZES}
    received = publish(peer, node, first_ns, reliability, **options)

    print(reliability, 'with profile' if profile else 'default', received)
    missing = {size: received[size] for size in promised if received[size] != NUMBER}
    assert not missing, f'of {NUMBER}: {missing}\n{node.output[-3000:]}'
    if sum(received.values()) < NUMBER * len(SIZES):
        assert '/plain_lidar publishes best effort' in node.output
        assert f'FASTRTPS_DEFAULT_PROFILES_FILE={PROFILE}' in node.output


class Bench:
    """A subscription executor in the node of a peer, and the publishers of a topic."""

    def __init__(self, peer, topic='followed'):
        self.peer = peer
        self.topic = topic
        self.taken, self.failures = [], []
        self.executor = SubscriptionExecutor(peer.node, self.failures.append)

    def subscribe(self):
        self.executor.subscribe(
            String, self.topic, lambda msg: self.taken.append(msg.data), RELIABLE
        )
        self.executor.start()

    def advertise(self, qos):
        return self.peer.node.create_publisher(String, self.topic, qos)

    def wait_until(self, reliability):
        self.peer.spin_until(
            lambda: self.executor.reliabilities() == {f'/{self.topic}': reliability},
            what=lambda: f'{self.executor.reliabilities()}, expected {reliability}',
        )

    def check_connected(self, publisher, text):
        """Check that a message of a publisher arrives."""
        self.peer.spin_until(publisher.get_subscription_count)

        def has_arrived():
            publisher.publish(String(data=text))
            return text in self.taken

        self.peer.spin_until(has_arrived)


@pytest.fixture
def bench(peer):
    bench = Bench(peer)
    yield bench
    bench.executor.stop()
    assert bench.failures == []


def test_reliability_follows_publishers_that_come_and_go(bench):
    bench.subscribe()
    bench.wait_until('reliable')
    first = bench.advertise(RELIABLE)
    bench.check_connected(first, 'reliable alone')
    second = bench.advertise(BEST_EFFORT)
    bench.wait_until('best effort')
    bench.check_connected(second, 'best effort beside reliable')
    bench.check_connected(first, 'reliable beside best effort')
    bench.peer.node.destroy_publisher(second)
    bench.wait_until('reliable')
    bench.check_connected(first, 'reliable again')
    bench.peer.node.destroy_publisher(first)
    bench.peer.spin_for(0.3)
    third = bench.advertise(BEST_EFFORT)
    bench.wait_until('best effort')
    bench.check_connected(third, 'best effort alone')


@pytest.mark.parametrize('chosen', ['reliable', 'best_effort'])
def test_a_reliability_set_by_the_user_stays(domain, chosen):
    peer = Peer(['--ros-args', *reliably('/chosen', value=chosen)], BaseNode)
    bench = Bench(peer, 'chosen')
    try:
        bench.subscribe()
        publisher = bench.advertise(BEST_EFFORT if chosen == 'reliable' else RELIABLE)
        if chosen == 'best_effort':
            peer.spin_until(publisher.get_subscription_count)
        peer.spin_for(1.0)
        assert bench.executor.reliabilities() == {'/chosen': chosen.replace('_', ' ')}
        assert publisher.get_subscription_count() == (chosen == 'best_effort')
        assert (
            peer.node.get_parameter('qos_overrides./chosen.subscription.reliability').value
            == chosen
        )
    finally:
        bench.executor.stop()
        peer.close()
    assert bench.failures == []


@pytest.fixture
def other_peer(domain):
    """Return a second participant: Fast DDS refuses two types of a topic in one."""
    peer = Peer()
    yield peer
    peer.close()


def test_publishers_of_another_type_do_not_decide_the_reliability(bench, other_peer):
    node = bench.peer.node
    other = other_peer.node.create_publisher(Int32, bench.topic, BEST_EFFORT)
    bench.peer.spin_until(lambda: node.count_publishers('/followed'))
    bench.subscribe()
    bench.peer.spin_for(0.5)
    assert bench.executor.reliabilities() == {'/followed': 'reliable'}
    assert bench.executor.publishers('/followed') == []
    assert publishers(node, '/followed')[0] == 0
    bench.check_connected(bench.advertise(RELIABLE), 'reliable beside another type')
    other_peer.node.destroy_publisher(other)
    bench.peer.spin_until(lambda: node.count_publishers('/followed') == 1)
    bench.peer.spin_until(lambda: publishers(node, '/followed') == (1, ''))
    assert bench.executor.reliabilities() == {'/followed': 'reliable'}


@pytest.mark.parametrize(
    ('policy', 'chosen', 'offered'),
    [
        ('reliability', 'reliable', 'best_effort'),
        ('durability', 'transient_local', 'volatile'),
    ],
)
def test_an_override_that_keeps_messages_away_is_named(domain, capfd, policy, chosen, offered):
    name = f'qos_overrides./chosen.subscription.{policy}'
    peer = Peer(['--ros-args', '-p', f'{name}:={chosen}'], BaseNode)
    bench = Bench(peer, 'chosen')
    said = f'publishes {offered}, but {name} is {chosen}, so that its messages do not arrive'
    try:
        bench.subscribe()
        bench.advertise(BEST_EFFORT)
        peer.spin_until(lambda: said in publishers(peer.node, '/chosen')[1])
        peer.spin_for(FOLLOW_S + 0.5)
    finally:
        bench.executor.stop()
        peer.close()
    assert bench.failures == []
    assert capfd.readouterr().err.count(f'/chosen: /peer {said}') == 1
