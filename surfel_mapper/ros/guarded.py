# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A node that outlives what rclpy itself does not: messages and requests of anybody on the wire.

rclpy raises where a time on /clock is negative, and where a parameter is to be set to a value of a
type that there is not; either ends the executor, and with it the node.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.service import Service
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock

TYPES = {kind.value for kind in Parameter.Type}


class GuardedNode(Node):
    """A node of which the subscriptions and services that rclpy makes are guarded."""

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[[Any], None], *args: Any, **kwargs: Any
    ) -> Subscription:
        """Create a subscription; that of simulated time passes over what is no time."""
        if msg_type is Clock:
            callback = partial(self._on_clock, callback)
        return super().create_subscription(msg_type, topic, callback, *args, **kwargs)

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **kwargs: Any
    ) -> Service:
        """Create a service; those that set parameters refuse what is no value."""
        if srv_type in (SetParameters, SetParametersAtomically):
            callback = partial(_on_set_parameters, callback)
        return super().create_service(srv_type, srv_name, callback, **kwargs)

    def _on_clock(self, set_time: Callable[[Clock], None], msg: Clock) -> None:
        if msg.clock.sec >= 0:
            set_time(msg)
            return
        self.get_logger().warning(
            f'message on /clock ignored: {msg.clock.sec} s, expected a time that is not negative',
            throttle_duration_sec=10.0,
        )


def _on_set_parameters(set_parameters: Callable[..., Any], request: Any, response: Any) -> Any:
    """Set parameters, none where one of them has no known type."""
    unknown = [p for p in request.parameters if p.value.type not in TYPES]
    if not unknown:
        return set_parameters(request, response)
    found = unknown[0].value.type
    reason = f'{unknown[0].name}: a value of type {found}, expected 1 to {max(TYPES)}'
    refused = SetParametersResult(successful=False, reason=reason)
    if isinstance(response, SetParametersAtomically.Response):
        response.result = refused
    else:
        response.results = [refused] * len(request.parameters)
    return response
