# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The queue of the mapping thread: order, bounds, and shutdown."""

from __future__ import annotations

from concurrent.futures import CancelledError
import threading

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from surfel_mapper.compilation import PROGRESS
from surfel_mapper.config import Config
from surfel_mapper.messages.poses import StampedPose
from surfel_mapper.pipeline import Mapper
from surfel_mapper.ros.mapping_thread import MappingThread, MAX_POSES
from test.messages.pose_messages import poses_in
from test.ros.live import cloud, odometry, room, START_NS

PERIOD_NS = 100_000_000
UNTURNED = (0.0, 0.0, 0.0, 1.0)
CONFIG = Config.from_mapping(
    {'pose.source': 'odometry', 'frames.base_to_sensor': [0.0, 0.0, 0.5, *UNTURNED]}
)
MAX_CLOUDS = CONFIG.input.max_waiting_clouds
TIMEOUT_S = 120


class Bench:
    """A running mapping thread, which can be blocked, and its results."""

    def __init__(self, on_update=None, config=CONFIG):
        self.mapper = Mapper(config)
        self.stamps = []
        self.failures = []
        self.thread = MappingThread(self.mapper, self.failures.append)
        self.thread.start(on_update or (lambda update: self.stamps.append(update.stamp_ns)))
        self._released = threading.Event()

    def hold(self):
        """Block the thread, so that all input waits in the queue."""
        busy = threading.Event()

        def wait():
            busy.set()
            self._released.wait(TIMEOUT_S)

        self.thread.call(wait)
        assert busy.wait(TIMEOUT_S)

    def release(self):
        self._released.set()

    def put_pose(self, stamp_ns):
        message = odometry(stamp_ns, (1e-9 * (stamp_ns - START_NS), 0.0, 0.0))
        self.thread.put_poses(poses_in('odometry', message, 'base_link'))

    def put_cloud(self, stamp_ns, message=None):
        self.thread.put_cloud(message or cloud(stamp_ns, room(seed=1, num=400)), '/points')


@pytest.fixture
def bench():
    bench = Bench()
    yield bench
    bench.release()
    bench.thread.stop()
    assert bench.failures == []


def test_no_cloud_is_dropped_because_kernels_compile(bench):
    stamps = [START_NS + i * PERIOD_NS for i in range(3 * MAX_CLOUDS)]
    bench.hold()
    PROGRESS.begin()
    for stamp_ns in stamps[:-1]:
        bench.put_cloud(stamp_ns)
    PROGRESS.end()
    bench.put_cloud(stamps[-1])  # the backlog is still there
    for stamp_ns in stamps:
        bench.put_pose(stamp_ns)
    bench.release()
    bench.thread.call(lambda: None).result(TIMEOUT_S)
    assert bench.stamps == stamps
    assert not bench.mapper.counters.dropped


def test_a_full_queue_drops_and_counts_the_oldest_clouds(bench):
    stamps = [START_NS + i * PERIOD_NS for i in range(MAX_CLOUDS + 3)]
    bench.hold()
    for stamp_ns in stamps:
        bench.put_pose(stamp_ns)
        bench.put_cloud(stamp_ns)
    bench.release()
    bench.thread.stop()

    assert bench.stamps == stamps[3:]
    assert bench.mapper.counters.received == len(stamps)
    assert bench.mapper.counters.dropped == {'overload': 3}
    assert bench.mapper.counters.dropped_by_frame == {'lidar': {'overload': 3}}


def static_pose(child, x=0.0):
    return StampedPose('base_link', child, START_NS, (x, 0.0, 0.0), UNTURNED)


def test_a_full_queue_drops_no_static_pose(bench):
    """Joints fill the queue within a second; a static transform is published once."""
    joint = StampedPose('base_link', 'joint', START_NS, (0.0, 0.0, 0.0), UNTURNED)
    bench.hold()
    bench.thread.put_poses([static_pose('lidar', 1.0), static_pose('lidar', 2.0)], static=True)
    bench.thread.put_poses([joint._replace(stamp_ns=START_NS + i) for i in range(MAX_POSES + 5)])
    bench.release()
    bench.thread.stop()

    x, y, z = bench.mapper.transforms.lookup('base_link', 'lidar', START_NS)[:3, 3]
    assert (x, y, z) == (2.0, 0.0, 0.0)  # the latest holds
    assert bench.mapper.transforms.num_transforms == MAX_POSES
    assert bench.mapper.counters.messages_ignored == {'overload': 5}


def test_a_call_follows_the_queued_clouds_and_returns_result_or_error(bench):
    bench.hold()
    bench.put_pose(START_NS)
    bench.put_cloud(START_NS)
    mapped = bench.thread.call(lambda: bench.mapper.counters.mapped)
    failed = bench.thread.call(lambda: 1 // 0)
    bench.release()

    assert mapped.result(TIMEOUT_S) == 1
    with pytest.raises(ZeroDivisionError):
        failed.result(TIMEOUT_S)


def test_bad_and_paused_clouds_are_counted_and_the_next_is_mapped(bench):
    bad = cloud(START_NS, room(seed=1))
    bad.point_step = 11
    stamps = [START_NS + i * PERIOD_NS for i in range(3)]
    for stamp_ns in stamps:
        bench.put_pose(stamp_ns)
    bench.put_cloud(stamps[0], bad)
    bench.thread.call(lambda: setattr(bench.thread, 'paused', True))
    bench.put_cloud(stamps[1])
    bench.thread.call(lambda: setattr(bench.thread, 'paused', False))
    bench.put_cloud(stamps[2])
    bench.thread.stop()

    assert bench.stamps == [stamps[2]]
    assert bench.mapper.counters.received == 3
    assert bench.mapper.counters.dropped == {'bad_cloud': 1, 'paused': 1}


def test_an_unexpected_error_is_counted_and_the_thread_goes_on():
    def fail(update):
        raise RuntimeError('broken')

    bench = Bench(on_update=fail)
    bench.hold()
    for number in range(3):
        bench.put_pose(START_NS + number)
        bench.put_cloud(START_NS + number)
    bench.thread.post(lambda: 1 // 0)
    waiting = bench.thread.call(lambda: 1)
    bench.release()
    assert waiting.result(TIMEOUT_S) == 1
    bench.thread.stop()

    assert bench.failures == []
    assert bench.mapper.counters.mapped == 3
    assert bench.mapper.counters.messages_ignored == {'internal_error': 4}


def test_a_fatal_error_ends_the_thread_and_cancels_calls():
    def fail(update):
        raise SystemExit('broken')

    bench = Bench(on_update=fail)
    bench.hold()
    bench.put_pose(START_NS)
    bench.put_cloud(START_NS)
    waiting = bench.thread.call(lambda: 1)
    bench.release()
    bench.thread.stop()

    assert [str(error) for error in bench.failures] == ['broken']
    with pytest.raises(CancelledError):
        waiting.result(TIMEOUT_S)
    with pytest.raises(CancelledError):
        bench.thread.call(lambda: 1).result(TIMEOUT_S)
