# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The node's end of a bond with Nav2's lifecycle manager, which watches active nodes by heartbeats.

The manager expects a heartbeat on ``bond`` under the name of the node soon after activation
(``bond_timeout``), and brings the robot to a stop if it ceases. This end only sends, and ignores
the heartbeats of the manager. So it needs only the message class, from the package ``bond`` that
Nav2 depends on.

Source: bond_core, bond/msg/Status.msg and the state machine of bondcpp.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any
import uuid

from surfel_mapper.ros.base_node import BaseNode, Ticker

TOPIC = 'bond'

HEARTBEAT_PERIOD_S = 0.25
"""The manager waits for half of ``bond_timeout`` for the first heartbeat, 2 s by default. With one
a second, discovery of a new subscriber and a busy machine can use these up."""

HEARTBEAT_TIMEOUT_S = 4.0
"""The default of bondcpp; it is sent with each heartbeat, like the period."""


class Bond:
    """
    Heartbeats while the node is active; none if the package ``bond`` is not installed.

    Parameters
    ----------
    node : BaseNode
        The node that sends.

    """

    def __init__(self, node: BaseNode) -> None:
        self._node = node
        self._ticker: Ticker | None = None
        self._publisher: Any = None
        self._instance_id = ''
        try:
            self._message: Any = import_module('bond.msg').Status
        except ImportError:
            self._message = None

    def start(self) -> None:
        """Send heartbeats from now on."""
        if self._message is None or self._ticker is not None:
            return
        self._instance_id = str(uuid.uuid4())
        self._publisher = self._node.create_publisher(self._message, TOPIC, 1)
        self._send()
        self._ticker = Ticker(self._node, 'bond', HEARTBEAT_PERIOD_S, self._send)

    def stop(self) -> None:
        """Tell the manager that the bond ends on purpose, and send no more."""
        if self._ticker is None:
            return
        self._ticker.stop()
        self._send(active=False)
        self._node.destroy_publisher(self._publisher)
        self._ticker = self._publisher = None

    def _send(self, *, active: bool = True) -> None:
        """Send a heartbeat, or the end of the bond."""
        message = self._message(
            id=self._node.get_name(),
            instance_id=self._instance_id,
            active=active,
            heartbeat_timeout=HEARTBEAT_TIMEOUT_S,
            heartbeat_period=HEARTBEAT_PERIOD_S,
        )
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
