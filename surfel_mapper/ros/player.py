# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Publish a bag over DDS at the pace of its record times.

Messages are published as the serialized bytes in the bag. A reliable subscriber receives all
messages published after its discovery, so the player can wait for subscribers before the first
message, and waits until the last is acknowledged.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
import logging
import time
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock

from surfel_mapper.bags.reader import BagReader
from surfel_mapper.errors import BagError, DependencyError, SubscriberError
from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.ros.context import context, enlarge_shared_memory
from surfel_mapper.ros.message_types import message_type
from surfel_mapper.ros.messages import time_message
from surfel_mapper.ros.pace import Pace

log = logging.getLogger(__name__)

DEPTH = 20
"""Queue of a publisher: messages kept until all subscribers have them."""

MAX_LATCHED = 100
"""Queue of a latched topic, which may hold the messages of several recorded publishers."""

SETTLE_S = 0.5
"""Time for the subscriber to discover the publisher, after the publisher has discovered it."""

CLOCK_PERIOD_S = 0.01

CLOUD = 'sensor_msgs/msg/PointCloud2'


def play(
    reader: BagReader,
    topics: Collection[str] | None = None,
    *,
    rate: float = 1.0,
    loop: bool = False,
    clock: bool = False,
    wait_for: Collection[str] = (),
    paced_by: str | None = None,
    timeout_s: float = 60.0,
    ros_args: Sequence[str] = (),
) -> dict[str, Any]:
    """
    Publish the messages of a bag.

    Parameters
    ----------
    reader : BagReader
        The bag.
    topics : collection of str, optional
        The topics to play; by default all whose types are installed.
    rate : float
        Speed relative to the recording.
    loop : bool
        Repeat the bag until interrupted.
    clock : bool
        Publish the record time on /clock.
    wait_for : collection of str
        Start when each of these topics has a subscriber.
    paced_by : str, optional
        Wait for messages on this topic with the stamps of the clouds, so that a node never gets
        more clouds than it maps.
    timeout_s : float
        Longest wait for subscribers, and for each answer on ``paced_by``, s.
    ros_args : sequence of str
        The command line from --ros-args on, that included.

    Returns
    -------
    dict
        ``published``: messages by topic; ``skipped``: the reason by topic; ``seconds``.

    Raises
    ------
    BagError
        If a topic is not in the bag, none can be played, or it is a ROS 1 bag.
    SubscriberError
        If a topic has no subscriber, or a cloud no answer, in time.

    """
    keep_freed_memory()
    enlarge_shared_memory()
    with context(ros_args):
        node = Node('surfel_mapper_player')
        try:
            player = Player(node, reader, topics, rate=rate, clock=clock)
            player.wait_for_subscribers(wait_for, timeout_s)
            if paced_by is not None:
                player.pace = Pace(node, paced_by, timeout_s)
            start = time.monotonic()
            player.play()
            while loop:
                player.play()
            player.flush()
            seconds = time.monotonic() - start
        finally:
            node.destroy_node()
    return {'published': player.published, 'skipped': player.skipped, 'seconds': seconds}


class Player:
    """
    Publishes the topics of a bag.

    Attributes
    ----------
    published : dict of str to int
        Number of messages published, by topic.
    skipped : dict of str to str
        Reason why a topic is not published.
    pace : Pace, optional
        Bounds the clouds that are on the way.

    """

    pace: Pace | None = None

    def __init__(
        self,
        node: Node,
        reader: BagReader,
        topics: Collection[str] | None,
        *,
        rate: float,
        clock: bool,
    ) -> None:
        """Create the publishers."""
        if reader.is_ros1:
            raise BagError(
                f'{reader.path}: a ROS 1 bag, whose messages ROS 2 cannot read; convert it: '
                f'`rosbags-convert --src {reader.path} --dst {reader.path.stem}`'
            )
        self._reader = reader
        self._rate = rate
        self._clock = node.create_publisher(Clock, '/clock', 10) if clock else None
        self.published: dict[str, int] = {}
        self.skipped: dict[str, str] = {}
        self._publishers: dict[str, Publisher] = {}
        self._clouds = {topic.name for topic in reader.topics if topic.type == CLOUD}
        self._make_publishers(node, topics)

    def _make_publishers(self, node: Node, names: Collection[str] | None) -> None:
        """Create a publisher for every topic whose type is installed."""
        topics = {topic.name: topic for topic in self._reader.topics}
        for name in topics if names is None else names:
            if name not in topics:
                raise BagError(
                    f'{self._reader.path}: no topic {name}; its topics: {", ".join(topics)}'
                )
            try:
                message = message_type(topics[name].type)
            except DependencyError as error:
                self.skipped[name] = str(error)
                continue
            self._publishers[name] = node.create_publisher(message, name, self._qos(name))
            self.published[name] = 0
        if not self._publishers:
            raise BagError(f'{self._reader.path}: no topic to play; skipped: {self.skipped}')

    def _qos(self, name: str) -> QoSProfile:
        """Return the QoS of a publisher: reliable, and latched if it was recorded so."""
        if self._reader.is_latched(name):
            return QoSProfile(depth=MAX_LATCHED, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        return QoSProfile(depth=DEPTH)

    def wait_for_subscribers(self, names: Collection[str], timeout_s: float) -> None:
        """Return when each of these topics has a subscriber."""
        unknown = [name for name in names if name not in self._publishers]
        if unknown:
            raise BagError(
                f'{self._reader.path}: no topic {", ".join(unknown)} to wait for; '
                f'topics played: {", ".join(self._publishers)}'
            )
        end_s = time.monotonic() + timeout_s
        while unread := [n for n in names if not self._publishers[n].get_subscription_count()]:
            if time.monotonic() > end_s:
                raise SubscriberError(
                    f'no subscriber of {", ".join(unread)} within {timeout_s:g} s; is the '
                    'subscriber running, with the same ROS_DOMAIN_ID and topic names?'
                )
            time.sleep(0.02)
        if names:
            time.sleep(SETTLE_S)

    def play(self) -> None:
        """Publish all messages once, each at its time."""
        start_s, first_ns = time.monotonic(), None
        for message in self._reader.messages(set(self._publishers)):
            first_ns = message.record_ns if first_ns is None else first_ns
            due_s = start_s + (message.record_ns - first_ns) / 1e9 / self._rate
            self._sleep_until(due_s, message.record_ns)
            self._publishers[message.topic].publish(bytes(message.raw))
            self.published[message.topic] += 1
            if self.pace is not None and message.topic in self._clouds:
                self.pace.published(message.raw)

    def _sleep_until(self, due_s: float, record_ns: int) -> None:
        """Sleep until a message is due; meanwhile publish the bag time on /clock."""
        while True:
            left_s = due_s - time.monotonic()
            if self._clock is not None:
                now_ns = record_ns - int(max(left_s, 0.0) * self._rate * 1e9)
                self._clock.publish(Clock(clock=time_message(now_ns)))
                time.sleep(min(max(left_s, 0.0), CLOCK_PERIOD_S))
            elif left_s > 0.0:
                time.sleep(left_s)
            if left_s <= 0.0:
                return

    def flush(self) -> None:
        """Wait until all reliable subscribers have all messages, and all clouds are answered."""
        if self.pace is not None:
            self.pace.wait()
        clock = {'/clock': self._clock} if self._clock is not None else {}
        for name, publisher in {**self._publishers, **clock}.items():
            if not publisher.wait_for_all_acked(Duration(seconds=5)):
                log.warning('%s: a subscriber has not confirmed all messages after 5 s', name)
        time.sleep(SETTLE_S)
