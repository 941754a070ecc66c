# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""What the publishers of the node share: a quality of service, and timers."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.timer import Timer

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""The last message is kept for those who subscribe later."""


def steady_timer(node: Node, rate_hz: float, callback: Callable[[], None]) -> Timer:
    """Return a timer of a rate that holds while simulated time stands still or jumps."""
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    return node.create_timer(1.0 / rate_hz, callback, clock=steady)
