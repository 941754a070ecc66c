# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The subscriptions of a node, and the thread that takes their messages out of the middleware.

An executor of rclpy takes one message of each subscription a turn, and a turn costs 1.2 ms since
all timers, services and subscriptions of the node are gathered anew: with odometry at 200 Hz a
backlog of clouds passes its poses by and is dropped for want of them. This thread waits for its
own subscriptions only, as ``rclpy.wait_for_message`` does, and takes all poses that are there
before every cloud; a pose costs a sixth then. It hears what the middleware reports of them too
(QoS that does not match, messages that were lost), because whoever waits for that is woken by
every message. The executor keeps timers, services and parameters.
"""

from __future__ import annotations

from collections.abc import Callable
import copy
import math
import threading
import time
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.subscription import Subscription

from surfel_mapper.errors import ConfigError

OVERRIDABLE = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
)
"""What a user may set of a subscription, in ``qos_overrides``."""

LAST_S = 1.0
"""What has arrived is taken before the end, but no longer than this where more keeps coming."""


class KeptFromExecutor(ReentrantCallbackGroup):
    """Keeps subscriptions, and their events, from the executor."""

    def can_execute(self, entity: object) -> bool:
        """Return that the executor may not."""
        return False


class SubscriptionExecutor:
    """
    Subscriptions, and the thread that calls their callbacks.

    Parameters
    ----------
    node : Node
        Whose subscriptions they are.
    on_failure : callable
        Called in the thread with an error that nobody foresaw; the thread ends with it.

    """

    def __init__(self, node: Node, on_failure: Callable[[BaseException], None]) -> None:
        """Prepare; ``subscribe`` to at least one topic, then ``start``."""
        self._node = node
        self._on_failure = on_failure
        self._group = KeptFromExecutor()
        self._eager: list[Subscription] = []
        self._others: list[Subscription] = []
        self._end_s = math.inf
        self._thread: threading.Thread | None = None

    def subscribe(
        self,
        message: Any,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile,
        *,
        eager: bool = False,
        events: SubscriptionEventCallbacks | None = None,
        raw: bool = False,
    ) -> None:
        """
        Subscribe, with a quality of service that the user may override.

        Parameters
        ----------
        message, topic, callback, qos, events, raw
            As ``Node.create_subscription`` takes them.
        eager : bool
            Taken until nothing is left, before every message of those that are not.

        Raises
        ------
        ConfigError
            If a parameter of qos_overrides is refused.

        """
        try:
            subscription = self._node.create_subscription(
                message,
                topic,
                callback,
                copy.copy(qos),  # rclpy enters the overrides in what it is given
                callback_group=self._group,
                event_callbacks=events,
                qos_overriding_options=QoSOverridingOptions(policy_kinds=OVERRIDABLE),
                raw=raw,
            )
        except (ParameterException, InvalidQosOverridesError, RuntimeError) as error:
            name = self._node.resolve_topic_name(topic)
            raise ConfigError(f'qos_overrides.{name}.subscription: {error}') from error
        (self._eager if eager else self._others).append(subscription)

    def topics(self) -> list[str]:
        """Return the full names of the topics subscribed to."""
        return [
            self._node.resolve_topic_name(subscription.topic)
            for subscription in (*self._eager, *self._others)
        ]

    def start(self) -> None:
        """Take messages from now on."""
        self._end_s = math.inf
        self._stop = GuardCondition(None, None, context=self._node.context)
        self._thread = threading.Thread(target=self._run, name='intake', daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Take what has arrived and no more, and destroy the subscriptions."""
        if self._thread is not None:
            self._end_s = time.monotonic() + LAST_S
            self._stop.trigger()
            self._thread.join()
            self._stop.destroy()
            self._thread = None
        for subscriptions in (self._eager, self._others):
            for subscription in subscriptions:
                self._node.destroy_subscription(subscription)
            subscriptions.clear()

    def _run(self) -> None:
        try:
            while self._end_s == math.inf:
                self._wait()
                while self._take_turn():
                    pass
        except BaseException as error:
            self._on_failure(error)

    def _wait(self) -> None:
        """Return when a message is there, or the thread has to end; call back about events."""
        subscriptions = (*self._eager, *self._others)
        events = [event for found in subscriptions for event in found.event_handlers]
        wait_set = rclpy_implementation.WaitSet(
            len(subscriptions), 1, 0, 0, 0, len(events), self._node.context.handle
        )
        wait_set.clear_entities()
        for subscription in subscriptions:
            wait_set.add_subscription(subscription.handle)
        for event in events:
            event.add_to_wait_set(wait_set)
        wait_set.add_guard_condition(self._stop.handle)
        wait_set.wait(-1)
        for event in events:
            if event.is_ready(wait_set) and (report := event.take_data()):
                event.callback(report)

    def _take_turn(self) -> bool:
        """Take one message of each of the others, all eager ones before it; false if none was."""
        taken = False
        for subscription in self._others:
            for eager in self._eager:
                while self._take(eager):
                    pass
            taken |= self._take(subscription)
        return taken

    def _take(self, subscription: Subscription) -> bool:
        """Take a message and call the callback; return whether there was one."""
        if time.monotonic() > self._end_s:
            return False
        taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        if taken is None:
            return False
        subscription.callback(taken[0])
        return True
