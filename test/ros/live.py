# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Verbs as processes, a peer node that communicates with them over DDS, and messages to send."""

from __future__ import annotations

from array import array
from contextlib import contextmanager
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import GetState
from nav_msgs.msg import Odometry
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2, PointField
from std_srvs.srv import Trigger

ROOT = Path(__file__).parents[2]
TIMEOUT_S = 300.0
"""Longest wait for an event that takes a second on an idle machine."""

RETRY_S = 1.0
START_NS = 1_700_000_000_000_000_000
NODE = '/surfel_mapper'

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
RVIZ = QoSProfile(depth=10)
ALL = QoSProfile(depth=1000)
"""Reliable, with a queue longer than any test needs: no message is lost."""


def reliably(*topics, value='reliable'):
    """Return the arguments of a node that reads topics with a fixed reliability."""
    names = [f'qos_overrides.{topic}.subscription.reliability' for topic in topics]
    return [item for name in names for item in ('-p', f'{name}:={value}')]


class Process:
    """A verb running as a process in a folder, which also gets its output."""

    def __init__(self, arguments, folder, prefork=None):
        """Start the verb in a new Python, or fork it from one with modules and kernels loaded."""
        self._output = Path(folder) / f'{arguments[0]}_{time.monotonic_ns()}.txt'
        if prefork is not None:
            self._process = prefork.start(arguments, self._output, folder, dict(os.environ))
            return
        with open(self._output, 'wb') as file:
            self._process = subprocess.Popen(
                [sys.executable, '-m', 'surfel_mapper.cli.main', *map(str, arguments)],
                stdout=file,
                stderr=subprocess.STDOUT,
                cwd=folder,
                env={**os.environ, 'PYTHONPATH': str(ROOT)},
            )

    @property
    def output(self):
        return self._output.read_text(encoding='utf-8') if self._output.exists() else ''

    def wait(self, timeout_s=TIMEOUT_S):
        return self._process.wait(timeout_s)

    def is_running(self):
        return self._process.poll() is None

    def check(self):
        """Check that the process runs and has printed no traceback."""
        assert self.is_running(), self.output
        assert 'Traceback' not in self.output, self.output

    def wait_for_output(self, text, timeout_s=TIMEOUT_S):
        end = time.monotonic() + timeout_s
        while text not in self.output:
            assert self.is_running(), self.output
            assert time.monotonic() < end, f'no {text!r} in: {self.output}'
            time.sleep(0.05)

    @contextmanager
    def paused(self):
        """Stop the process within the context; it runs on afterwards and notices nothing."""
        self._process.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            self._process.send_signal(signal.SIGCONT)

    def stop(self, number=signal.SIGINT):
        self._process.send_signal(number)
        return self.wait()

    def kill(self):
        if self.is_running():
            self._process.kill()
            self._process.wait(TIMEOUT_S)


class Peer:
    """A node of the test that publishes and collects messages."""

    def __init__(self, arguments=(), node_type=Node):
        self._context = rclpy.Context()
        rclpy.init(args=list(arguments), context=self._context)
        self.node = node_type('peer', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._publishers = {}

    def close(self):
        """Stop waiting, then destroy what was waited for, then its context, each in any case."""
        try:
            self._executor.shutdown()  # its wait set uses the handles of the node
        finally:
            try:
                self.node.destroy_node()
            finally:
                self._context.shutdown()

    def spin_once(self):
        self._executor.spin_once(0.05)

    def spin_until(self, condition, timeout_s=TIMEOUT_S, what=lambda: 'timed out'):
        end = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < end, what()
            self.spin_once()

    def spin_for(self, seconds):
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(left)

    def meet(self, name=NODE):
        """
        Return when a node has discovered all publishers and subscribers of this peer.

        Discovery has two directions: a publisher or client may know a node that does not know it
        yet. A server does not answer unknown clients, and a best-effort subscriber misses messages
        of unknown publishers. Endpoints are announced in the order of their creation, so a node
        that answers a new client has discovered everything created before it.
        """
        client = self.node.create_client(GetState, f'{name}/get_state')
        answers, asked_s = [], [-RETRY_S]

        def is_answered():
            if client.service_is_ready() and time.monotonic() - asked_s[0] > RETRY_S:
                answers.append(client.call_async(GetState.Request()))
                asked_s[0] = time.monotonic()
            return any(answer.done() for answer in answers)

        self.spin_until(is_answered, what=lambda: f'{name} does not answer')
        self.node.destroy_client(client)

    def advertise(self, *topics, depth=50, kinds=None):
        """Create publishers, of odometry if named so, else clouds; wait for readers."""
        for topic in topics:
            kind = Odometry if topic.endswith('odom') else PointCloud2
            kind = (kinds or {}).get(topic, kind)
            self._publishers[topic] = self.node.create_publisher(kind, topic, depth)
        self.wait_until_read(*topics)

    def wait_until_read(self, *topics):
        """Return when the node has subscribed to advertised topics."""
        self.spin_until(lambda: all(self._publishers[t].get_subscription_count() for t in topics))
        self.meet()

    def publish(self, topic, message):
        self._publishers[topic].publish(message)

    def subscribe(self, kind, topic, qos=ALL):
        """Return a list that fills with the messages of a topic."""
        messages = []
        self.node.create_subscription(kind, topic, messages.append, qos)
        return messages

    def collect(self, kind, topic, qos=ALL):
        """Do the same; return when the node publishes the topic and has discovered the peer."""
        messages = self.subscribe(kind, topic, qos)
        self.spin_until(lambda: self.node.count_publishers(topic) > 0)
        self.meet()
        return messages

    def call(self, service, kind=Trigger, request=None):
        client = self.client(kind, service)
        answer = self.result(client.call_async(request or kind.Request()))
        self.node.destroy_client(client)
        return answer

    def client(self, kind, service):
        """Return a client of a service of the node that is ready to use."""
        client = self.node.create_client(kind, f'{NODE}/{service}')
        self.meet()
        self.spin_until(client.service_is_ready)
        return client

    def parameters(self):
        client = AsyncParameterClient(self.node, NODE)
        self.meet()
        self.spin_until(client.services_are_ready)
        return client

    def result(self, future):
        self.spin_until(future.done)
        return future.result()

    def diagnosis(self, expected=None, timeout_s=TIMEOUT_S):
        """Return the first report with the expected values, as (status, values)."""
        reports, values = [], {}
        listening = self.node.create_subscription(
            DiagnosticArray, '/diagnostics', reports.append, ALL
        )

        def is_as_expected():
            if reports:
                values.update({item.key: item.value for item in reports[-1].status[0].values})
            return reports and all(
                values.get(key) == str(value) for key, value in (expected or {}).items()
            )

        try:
            self.spin_until(is_as_expected, timeout_s, lambda: f'no {expected}, but {values}')
        finally:
            self.node.destroy_subscription(listening)
        return reports[-1].status[0], values


@contextmanager
def node_and_peer(prefork, folder, *arguments):
    """Fork a node that saves maps to a folder, and make a peer, in a with-block."""
    arguments = ['node', *arguments, '-p', f'output.directory:={folder}']
    node = Process(arguments, folder.parent, prefork)
    peer = Peer()
    try:
        yield node, peer
    finally:
        peer.close()
        node.kill()


def odometry(stamp_ns, xyz, parent='odom', child='base_link'):
    """Return an Odometry message without rotation."""
    message = Odometry(child_frame_id=child)
    message.header.frame_id = parent
    stamp(message, stamp_ns)
    position = message.pose.pose.position
    position.x, position.y, position.z = map(float, xyz)
    return message


def cloud(stamp_ns, points, frame_id='lidar'):
    """Return points as a PointCloud2 with the fields x y z."""
    content = np.ascontiguousarray(points, '<f4')
    message = PointCloud2(
        height=1,
        width=len(content),
        fields=[
            PointField(name=name, offset=4 * i, datatype=7, count=1)
            for i, name in enumerate('xyz')
        ],
        point_step=12,
        row_step=12 * len(content),
        data=array('B', content.tobytes()),
    )
    message.header.frame_id = frame_id
    stamp(message, stamp_ns)
    return message


def stamp(message, stamp_ns):
    """Set the stamp of a message."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)


def room(seed, num=4000):
    """Return points on a floor and two walls, seen from the middle of a room."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-4.0, 4.0, (num, 3))
    points[: num // 2, 2] = -1.1
    points[num // 2 : 3 * num // 4, 1] = 3.3
    points[3 * num // 4 :, 0] = -3.7
    return points.astype(np.float32)
