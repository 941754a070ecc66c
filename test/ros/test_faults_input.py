# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Faults of sensors, poses and clocks, one after the other, sent to one node.

The node survives each fault, every cloud is mapped or counted as dropped, and in the end the map
has the digest of a new map of the same scans.

(Longer than other files: the tests share one node and run in this order.)
"""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

from test.ros.driving import ARGUMENTS, drive, mapped, PERIOD_NS, send
from test.ros.fault_table import fault, PAGE, page_with, table
from test.ros.live import cloud, NODE, node_and_peer, odometry, Peer, room, ROOT, START_NS

SECOND_NS = 10**9


class Stream:
    """A node and its peer; stamps that increase from test to test; the growth of counters."""

    def __init__(self, node, peer):
        self.node, self.peer = node, peer
        self.now_ns = START_NS
        self._reports = peer.collect(DiagnosticArray, '/diagnostics')
        peer.spin_until(lambda: self._reports)
        peer.advertise('/odom', '/points')
        self.begin()

    def begin(self):
        """Count from the present values on."""
        num_reports = len(self._reports) + 2  # the second has counts from now on
        self.peer.spin_until(lambda: len(self._reports) >= num_reports)
        self._before = self.values()

    def step(self, period_ns=PERIOD_NS):
        """Return the next stamp."""
        self.now_ns += period_ns
        return self.now_ns

    def pose(self, stamp_ns=None, **names):
        self.peer.publish('/odom', odometry(stamp_ns or self.now_ns, (0.0, 0.0, 0.0), **names))

    def scan(self, stamp_ns=None, num=400, frame_id='lidar'):
        points = room(seed=num, num=num)
        self.peer.publish('/points', cloud(stamp_ns or self.now_ns, points, frame_id))

    def pair(self, **options):
        """Send a pose and a cloud with the next stamp, slowly enough for the queues."""
        self.step()
        self.pose()
        self.scan(**options)
        self.peer.spin_for(0.03)

    def values(self):
        status = self._reports[-1].status[0]
        found = {item.key: item.value for item in status.values}
        return {key: int(value) for key, value in found.items() if value.lstrip('-').isdigit()}

    def grown(self):
        now = self.values()
        return {key: value - self._before.get(key, 0) for key, value in now.items()}

    def wait(self, **expected):
        """Wait until counters have grown by these numbers; no other scan may be dropped."""
        wanted = {key.replace('__', '.'): value for key, value in expected.items()}
        self.peer.spin_until(
            lambda: all(self.grown().get(key, 0) == value for key, value in wanted.items()),
            what=lambda: f'{wanted} not in {self.grown()}: {self.node.output[-2000:]}',
        )
        self.check(wanted)

    def check(self, wanted):
        grown = self.grown()
        dropped = {k: v for k, v in grown.items() if k.startswith('scans.dropped.') and v}
        assert dropped == {k: v for k, v in wanted.items() if k.startswith('scans.dropped.') and v}
        assert grown['scans.received'] == grown['scans.mapped'] + sum(dropped.values())
        self.node.check()

    def settle(self):
        """Wait until no cloud has arrived for 1 s and all are mapped or counted as dropped."""
        last = [None, time.monotonic()]

        def is_settled():
            grown = self.grown()
            if grown != last[0] and grown.get('scans.received') != (last[0] or {}).get(
                'scans.received'
            ):
                last[:] = [grown, time.monotonic()]
            dropped = sum(v for k, v in grown.items() if k.startswith('scans.dropped.'))
            is_whole = grown['scans.received'] == grown['scans.mapped'] + dropped
            return is_whole and time.monotonic() - last[1] > 1.0

        self.peer.spin_until(is_settled, what=lambda: str(self.grown()))
        self.node.check()
        return self.grown()


@pytest.fixture(scope='module')
def running(prefork, tmp_path_factory):
    maps = tmp_path_factory.mktemp('faults') / 'maps'
    with node_and_peer(prefork, maps, *ARGUMENTS) as pair:
        yield Stream(*pair)


@pytest.fixture
def stream(running):
    running.begin()
    return running


SENDER = """
import sys, time
from test.ros.live import Peer, cloud, odometry, room
peer = Peer()
peer.advertise('/odom', '/points')
for number in range(10_000):
    stamp_ns = int(sys.argv[1]) + number * 10_000_000
    peer.publish('/odom', odometry(stamp_ns, (0.0, 0.0, 0.0)))
    peer.publish('/points', cloud(stamp_ns, room(seed=1, num=400)))
    peer.spin_for(0.02)
"""


@fault(
    'publisher killed (SIGKILL) and started again',
    happens='mapping stops, and continues with the first cloud of the new publisher',
    counted='silence in the diagnostics',
    lost='no cloud that was sent',
)
def test_a_restarted_publisher_is_mapped(stream):
    for _ in range(2):
        before = stream.grown().get('scans.mapped', 0)
        command = [sys.executable, '-c', SENDER, str(stream.step(200 * SECOND_NS))]
        with subprocess.Popen(command, cwd=ROOT) as sender:
            stream.peer.spin_until(lambda b=before: stream.grown()['scans.mapped'] >= b + 5)
            sender.send_signal(signal.SIGKILL)
    stream.step(200 * SECOND_NS)
    grown = stream.settle()
    assert not any(value for key, value in grown.items() if key.startswith('scans.dropped.'))


@fault(
    'every cloud sent three times',
    happens='the first is mapped',
    counted='`stamp_repeated`, each of the others',
    lost='nothing',
)
def test_repeated_clouds_are_mapped_once(stream):
    for _ in range(5):
        stream.pair()
        stream.scan()
        stream.scan()
        stream.peer.spin_for(0.02)
    stream.wait(scans__mapped=5, scans__dropped__stamp_repeated=10)


@fault(
    'clouds out of order',
    happens='clouds older than the newest by at most `input.reset_after_s` are mapped',
    counted='nothing; with poses from registration `stamp_back`',
    lost='nothing, if their poses are there',
)
def test_clouds_out_of_order_are_mapped(stream):
    for _ in range(4):
        stream.step()
        stream.pose()
        stream.pair()
        stream.scan(stream.now_ns - PERIOD_NS)
    stream.wait(scans__mapped=8)


@fault(
    'clock set back by an hour, and forward again',
    happens='set back: the map is cleared, mapping continues; set forward: mapping continues',
    counted='`resets`, one for each time back',
    lost='the earlier map, on purpose: it is of another time',
)
def test_a_clock_set_back_and_forward_is_followed(stream):
    stream.pair()
    stream.wait(scans__mapped=1)
    for hours, resets in ((-1, 1), (1, 1), (-1, 2)):
        mapped_before = stream.grown()['scans.mapped']
        stream.now_ns += hours * 3600 * SECOND_NS
        stream.pair()
        stream.pair()
        stream.wait(scans__mapped=mapped_before + 2, resets=resets)


@fault(
    'no transform at all for a cloud',
    happens='it waits `pose.max_wait_s` of data time, or `pose.max_delay_s` while all poses are '
    'older, then it is dropped',
    counted='`no_pose`, by frame',
    lost='clouds without a pose',
)
def test_a_cloud_without_a_transform_is_dropped(stream):
    stream.step()
    stream.scan()
    stream.peer.spin_for(0.1)
    stream.step(5 * SECOND_NS)
    stream.pose(child='something_else')
    stream.wait(scans__mapped=0, scans__dropped__no_pose=1)
    stream.pair()
    stream.wait(scans__mapped=1, scans__dropped__no_pose=1)


@fault(
    'transforms late',
    happens='clouds wait for them, in order',
    counted='nothing',
    lost='nothing',
)
def test_clouds_wait_for_late_transforms(stream):
    stamps = [stream.step() for _ in range(3)]
    for stamp_ns in stamps:
        stream.scan(stamp_ns)
    stream.peer.spin_for(0.2)
    assert stream.grown()['scans.mapped'] == 0
    for stamp_ns in stamps:
        stream.pose(stamp_ns)
    stream.wait(scans__mapped=3)


@fault(
    'transforms in a loop, or not finite',
    happens='they are ignored, with a warning; the tree stays',
    counted='`messages_ignored`',
    lost='nothing',
)
def test_contradictory_transforms_are_ignored(stream):
    stream.pair()
    broken = odometry(stream.now_ns, (np.nan, 0.0, 0.0))
    unturned = odometry(stream.now_ns, (0.0, 0.0, 0.0))
    unturned.pose.pose.orientation.w = 0.0
    for names in (('base_link', 'odom'), ('odom', 'odom'), ('', '')):
        stream.pose(parent=names[0], child=names[1])
    for message in (broken, unturned):
        stream.peer.publish('/odom', message)
    stream.pair()
    stream.wait(scans__mapped=2)
    grown = stream.grown()
    assert sum(v for k, v in grown.items() if k.startswith('messages_ignored')) == 5


@fault(
    'a frame gets another parent',
    happens='the new parent holds from its stamp on, with a warning that names both, until the '
    'map holds no scan of the old one or `~/clear` is called',
    counted='`no_pose`, if the new parent does not lead to the fixed frame',
    lost='such clouds',
)
def test_a_stray_parent_holds_until_the_next_pose(stream):
    stream.pair()
    stream.wait(scans__mapped=1)
    stream.step()
    stream.pose(parent='stray')
    stream.pair()
    stream.wait(scans__mapped=2)
    moved = "'base_link' has moved from (0.000, 0.000, 0.000) m in "
    texts = [f"{moved}'odom' to (0.000, 0.000, 0.000) m in 'stray'", f"{moved}'stray' to"]
    assert stream.node.output.count(texts[0]) == 1
    stream.peer.spin_until(lambda: texts[1] in stream._reports[-1].status[0].message)
    assert '(/odom by peer)' in stream._reports[-1].status[0].message
    stream.peer.call('clear')
    stream.peer.spin_until(lambda: 'has moved' not in stream._reports[-1].status[0].message)


@fault(
    'bursts at ten times the rate',
    happens='clouds are mapped as fast as possible; the oldest in the queue are dropped',
    counted='`overload`; losses of the middleware, as far as it reports them, `clouds_lost`',
    lost='clouds beyond `input.max_waiting_clouds`',
)
def test_a_burst_is_mapped_as_fast_as_possible(stream):
    for _ in range(100):
        stream.step(PERIOD_NS // 10)
        stream.pose()
        stream.scan(num=20_000)
    grown = stream.settle()
    assert grown['scans.mapped'] > 0
    stream.begin()
    stream.pair()
    stream.wait(scans__mapped=1)


@fault(
    'a subscriber that reads nothing',
    happens='the node does not wait for it',
    counted='nothing',
    lost='nothing in the map; that subscriber misses messages',
)
def test_a_slow_subscriber_does_not_delay_the_node(stream):
    asleep = Peer()  # it is never spun
    try:
        for topic in ('normals', 'changed'):
            asleep.subscribe(PointCloud2, f'{NODE}/{topic}', QoSProfile(depth=1))
        asleep.meet()
        for number in range(10, 40, 10):  # fewer than the queue of the node holds
            for _ in range(10):
                stream.pair(num=4000)
            stream.wait(scans__mapped=number)
    finally:
        asleep.close()


def test_the_map_is_exact_after_all_faults(stream):
    assert stream.peer.call('clear').success
    messages = drive(5)
    send(stream.peer, [(c, p) for c, p in messages])  # older than the map, which is reset
    _, mapper = mapped(messages)
    stream.peer.spin_until(lambda: stream.grown()['scans.mapped'] == 5)
    assert mapper.map.digest() in stream.peer.call('save_map').message
    assert stream.node.stop(signal.SIGTERM) == 0


def test_the_table_of_faults_is_generated_from_the_tests():
    assert PAGE.read_text(encoding='utf-8') == page_with(table()), 'python -m test.ros.fault_table'
