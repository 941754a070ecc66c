# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The pace of a node that maps: the next cloud is published when an earlier one was answered.

A message with the stamp of a cloud, or a later one, answers it, such as those on ``~/changed``.
"""

from __future__ import annotations

from collections import deque
import struct
import time

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

from surfel_mapper.errors import SubscriberError
from surfel_mapper.ros.message_types import message_type

UNANSWERED = 4
"""Clouds that may be on the way: a scan waits for its next pose, which may be recorded later."""

STAMP = struct.Struct('<iI')
"""Seconds and nanoseconds of the header that a serialized message begins with."""

HEADER_AT = 4
"""Bytes of the encapsulation before it."""

SPIN_S = 0.1
"""Longest wait inside the middleware, in which a signal is not handled."""


class Pace:
    """
    Waits for the answers of a node.

    Parameters
    ----------
    node : Node
        Subscribes.
    topic : str
        The topic of the answers; its messages begin with a header.
    timeout_s : float
        Longest wait for the topic, and for an answer, s.

    Raises
    ------
    SubscriberError
        If the topic has no publisher in time.

    """

    def __init__(self, node: Node, topic: str, timeout_s: float) -> None:
        self._topic, self._timeout_s = topic, timeout_s
        self._stamps: deque[int] = deque()
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        end_s = time.monotonic() + timeout_s
        name = node.resolve_topic_name(topic)
        while not (types := dict(node.get_topic_names_and_types()).get(name)):
            if time.monotonic() > end_s:
                raise SubscriberError(f'no publisher of {topic} within {timeout_s:g} s')
            time.sleep(0.02)
        kind = message_type(types[0])
        node.create_subscription(kind, topic, self._on_answer, QoSProfile(depth=100), raw=True)

    def published(self, raw: bytes | memoryview) -> None:
        """Note a cloud that was published; return when few enough are unanswered."""
        self._stamps.append(stamp_of(raw))
        self.wait(UNANSWERED)

    def wait(self, number: int = 0) -> None:
        """
        Return when at most ``number`` clouds are unanswered.

        Raises
        ------
        SubscriberError
            If no answer comes in time.

        """
        end_s = time.monotonic() + self._timeout_s
        while len(self._stamps) > number:
            if time.monotonic() > end_s:
                raise SubscriberError(
                    f'no answer on {self._topic} to the cloud at {self._stamps[0] / 1e9:.6f} s '
                    f'within {self._timeout_s:g} s; does the node map it?'
                )
            num_open = len(self._stamps)
            self._executor.spin_once(timeout_sec=SPIN_S)
            if len(self._stamps) < num_open:
                end_s = time.monotonic() + self._timeout_s

    def _on_answer(self, raw: bytes) -> None:
        stamp_ns = stamp_of(raw)
        while self._stamps and self._stamps[0] <= stamp_ns:
            self._stamps.popleft()


def stamp_of(raw: bytes | memoryview) -> int:
    """Return the stamp of the header that a serialized message begins with, ns."""
    seconds, nanoseconds = STAMP.unpack_from(raw, HEADER_AT)
    return int(seconds * 10**9 + nanoseconds)
