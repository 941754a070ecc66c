# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The executor of the node's inputs: it takes poses before clouds, and follows publishers' QoS.

An executor of rclpy takes one message of each subscription per turn, and a turn costs 1.2 ms,
because it collects all timers, services and subscriptions of the node each time: with odometry at
200 Hz a backlog of clouds is taken before its poses and dropped without them. This thread waits
for its own subscriptions only, as ``rclpy.wait_for_message`` does, and takes all waiting poses
before every cloud; a pose costs a sixth. Timers, services and parameters stay with rclpy's
executor.

A subscription is reliable while all publishers of its topic are, and best effort as soon as one is
not, since a reliable subscription receives nothing from that one. Messages above 0.5 MB need a
reliable subscription: Fast DDS sends them in fragments, and of the best-effort ones most are
lost. The middleware reports publishers that come and go; the subscription is then created again.
"""

from __future__ import annotations

from collections.abc import Callable
import copy
from dataclasses import dataclass
from functools import partial
import math
import threading
import time
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import QoSMessageLostInfo, SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from surfel_mapper.errors import ConfigError
from surfel_mapper.ros.base_node import BaseNode
from surfel_mapper.ros.publishers import is_overridden, mismatch, override, publishers_of
from surfel_mapper.ros.turns import take_turns

OVERRIDABLE = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.DURABILITY)
"""Policies that a user can set for a subscription in ``qos_overrides``, beside reliability."""

POLICIES = ('history', 'depth', 'durability', 'reliability')
"""Their names in parameters."""

LAST_S = 1.0
"""Longest time to take the remaining messages at the end, if more keep arriving."""

FOLLOW_S = 2.0
"""After an event the graph is looked at for this time: it may lag behind the event."""

FOLLOW_PERIOD_S = 0.05

RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT


class KeptFromExecutor(ReentrantCallbackGroup):
    """Excludes subscriptions and their events from rclpy's executor."""

    def can_execute(self, entity: object) -> bool:
        """Return False."""
        return False


@dataclass(eq=False, kw_only=True)
class TopicReader:
    """
    A topic that is read, and its present subscription.

    Attributes
    ----------
    message : type
        Class of the messages.
    name, topic : str
        Name as given, and the full name after remapping.
    callback : callable
        Called with each message.
    qos : QoSProfile
        The profile wanted; its reliability holds while the topic has no publisher.
    on_lost : callable or None
        Called with the total number of messages that the middleware has reported as lost.
    raw : bool
        Pass serialized bytes to the callback instead of messages.
    follows : bool
        The reliability follows the publishers; False if the user has set it.
    subscription : Subscription
        The present subscription.
    reliability : ReliabilityPolicy
        Its reliability.
    follow_until_s : float
        Until then, by time.monotonic, the graph is checked for publishers of other QoS.
    lost : int
        Messages that the middleware has reported as lost.
    mismatch : str
        The publisher that cannot be heard, as the log has it.

    """

    message: Any
    name: str
    topic: str
    callback: Callable[[Any], None]
    qos: QoSProfile
    on_lost: Callable[[int], None] | None
    raw: bool
    follows: bool
    subscription: Subscription | None = None
    reliability: ReliabilityPolicy = RELIABLE
    follow_until_s: float = -math.inf
    lost: int = 0
    mismatch: str = ''

    def on_publishers_changed(self, _: object) -> None:
        """Check the QoS of the publishers soon."""
        self.follow_until_s = time.monotonic() + FOLLOW_S

    def on_message_lost(self, event: QoSMessageLostInfo) -> None:
        """Add up the messages lost by the present and all earlier subscriptions."""
        self.lost += event.total_count_change
        if self.on_lost is not None:
            self.on_lost(self.lost)


class SubscriptionExecutor:
    """
    Subscriptions, and the thread that calls their callbacks.

    Parameters
    ----------
    node : BaseNode
        The node that subscribes.
    on_failure : callable
        Called in the thread with the error that ends it; see take_turns.

    Attributes
    ----------
    on_turn : callable or None
        Called in the thread after each turn, at least every FOLLOW_PERIOD_S; it may subscribe and
        unsubscribe.

    """

    def __init__(self, node: BaseNode, on_failure: Callable[[BaseException], None]) -> None:
        self._node = node
        self._on_failure = on_failure
        self._group = KeptFromExecutor()
        self._eager: list[TopicReader] = []
        self._lazy: list[TopicReader] = []
        self._end_s = math.inf
        self._thread: threading.Thread | None = None
        self.on_turn: Callable[[], object] | None = None

    def subscribe(
        self,
        message: Any,
        name: str,
        callback: Callable[[Any], None],
        qos: QoSProfile,
        *,
        eager: bool = False,
        on_lost: Callable[[int], None] | None = None,
        raw: bool = False,
    ) -> None:
        """
        Subscribe with the reliability that the publishers offer.

        Parameters
        ----------
        message, name, callback, qos, raw
            As ``Node.create_subscription`` takes them; see ``TopicReader``.
        eager : bool
            Take all messages of this topic before each message of those that are not eager.
        on_lost : callable, optional
            Called with the total number of messages reported as lost.

        Raises
        ------
        ConfigError
            If a parameter of qos_overrides is refused.

        """
        topic = self._node.resolve_topic_name(name)
        reader = TopicReader(
            message=message,
            name=name,
            topic=topic,
            callback=callback,
            qos=copy.copy(qos),
            on_lost=on_lost,
            raw=raw,
            follows=not is_overridden(self._node, topic, 'reliability'),
        )
        if reader.follows:
            reader.qos.reliability = self._offered(reader, default=qos.reliability)
        self._open(reader)
        (self._eager if eager else self._lazy).append(reader)

    def unsubscribe(self, name: str) -> None:
        """End the subscription to a topic; called in the thread, or while it does not run."""
        topic = self._node.resolve_topic_name(name)
        for readers in (self._eager, self._lazy):
            for reader in [reader for reader in readers if reader.topic == topic]:
                readers.remove(reader)
                self._close(reader)

    def topics(self) -> list[str]:
        """Return the full names of the topics subscribed to."""
        return [reader.topic for reader in (*self._eager, *self._lazy)]

    def reliabilities(self) -> dict[str, str]:
        """Return the reliability of each subscription, by topic."""
        return {
            reader.topic: name_of(reader.reliability) for reader in (*self._eager, *self._lazy)
        }

    def publishers(self, topic: str) -> list[TopicEndpointInfo]:
        """Return the publishers of a topic, by its full name; if it is read, those of its type."""
        for reader in (*self._eager, *self._lazy):
            if reader.topic == topic:
                return publishers_of(self._node, topic, reader.message)
        return list(self._node.get_publishers_info_by_topic(topic))

    def eager_publishers(self) -> str:
        """Return the names of the nodes that publish eager topics, by topic."""
        names = {
            reader.topic: sorted({info.node_name for info in self.publishers(reader.topic)})
            for reader in tuple(self._eager)
        }
        return ', '.join(f'{topic} by {" and ".join(n)}' for topic, n in names.items() if n)

    def start(self) -> None:
        """Start the thread."""
        self._end_s = math.inf
        self._stop = GuardCondition(None, None, context=self._node.context)
        self._thread = threading.Thread(target=self._run, name='subscriptions', daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Take the messages received so far, end the thread, and destroy the subscriptions."""
        if self._thread is not None:
            self._end_s = time.monotonic() + LAST_S
            self._stop.trigger()
            self._thread.join()
            self._stop.destroy()
            self._thread = None
        for readers in (self._eager, self._lazy):
            for reader in readers:
                self._close(reader)
            readers.clear()

    def _open(self, reader: TopicReader) -> None:
        """Create the subscription of a reader."""
        # a parameter of qos_overrides keeps its first value, so that of the reliability is
        # declared only if the user has set it
        kinds = OVERRIDABLE if reader.follows else (*OVERRIDABLE, QoSPolicyKind.RELIABILITY)
        events = SubscriptionEventCallbacks(
            message_lost=reader.on_message_lost,
            matched=reader.on_publishers_changed,
            incompatible_qos=reader.on_publishers_changed,
        )
        qos = copy.copy(reader.qos)  # rclpy enters the overrides in the profile given
        try:
            reader.subscription = self._node.create_subscription(
                reader.message,
                reader.name,
                reader.callback,
                qos,
                callback_group=self._group,
                event_callbacks=events,
                qos_overriding_options=QoSOverridingOptions(policy_kinds=kinds),
                raw=reader.raw,
            )
        except (ParameterException, InvalidQosOverridesError, RuntimeError) as error:
            names = [
                override(reader.topic, policy)
                for policy in POLICIES
                if is_overridden(self._node, reader.topic, policy)
            ]
            causes = ', '.join(names) or f'no subscription to {reader.topic}'
            raise ConfigError(f'{causes}: {error}') from error
        reader.reliability = ReliabilityPolicy(qos.reliability)
        reader.on_publishers_changed(None)  # one may have come since the graph was looked at

    def _close(self, reader: TopicReader) -> None:
        """Destroy the subscription of a reader."""
        if reader.subscription is not None:
            self._node.destroy_subscription(reader.subscription)
            reader.subscription = None

    def _offered(self, reader: TopicReader, *, default: ReliabilityPolicy) -> ReliabilityPolicy:
        """Return the best reliability that all publishers of a topic offer."""
        publishers = publishers_of(self._node, reader.topic, reader.message)
        offered = {publisher.qos_profile.reliability for publisher in publishers}
        if not offered:
            return default
        return BEST_EFFORT if BEST_EFFORT in offered else RELIABLE

    def _follow_publishers(self) -> None:
        """Subscribe again to topics whose publishers now offer another reliability."""
        now_s = time.monotonic()
        for reader in (*self._eager, *self._lazy):
            if now_s > reader.follow_until_s:
                continue
            reliability = reader.qos.reliability
            if reader.follows:
                reliability = self._offered(reader, default=reliability)
            if reliability is reader.qos.reliability:
                self._report_mismatch(reader)
                continue
            reader.qos.reliability = reliability
            while self._take(reader):
                pass
            self._close(reader)
            self._open(reader)
            self._node.get_logger().info(
                f'{reader.topic} is now read {name_of(reliability)}, as its publishers offer'
            )

    def _report_mismatch(self, reader: TopicReader) -> None:
        """Warn once of a publisher that cannot be heard."""
        assert reader.subscription is not None
        qos = reader.subscription.qos_profile
        text = mismatch(self._node, reader.topic, reader.message, qos)
        if text and text != reader.mismatch:
            self._node.get_logger().warning(f'{reader.topic}: {text}')
        reader.mismatch = text

    def _run(self) -> None:
        try:
            take_turns(self._turn, partial(self._node.report_failure, 'a turn of subscriptions'))
        except BaseException as error:
            self._on_failure(error)

    def _turn(self) -> bool:
        """Wait for messages and call their callbacks; return False at the end."""
        if self._end_s != math.inf:
            return False
        self._wait()
        self._follow_publishers()
        while self._take_turn():
            pass
        if self.on_turn is not None:
            self.on_turn()
        return True

    def _wait(self) -> None:
        """Return when a message has arrived, or the thread has to end; call event callbacks."""
        readers = (*self._eager, *self._lazy)
        subscriptions = [r.subscription for r in readers if r.subscription is not None]
        events = [event for opened in subscriptions for event in opened.event_handlers]
        wait_set = rclpy_implementation.WaitSet(
            len(subscriptions), 1, 0, 0, 0, len(events), self._node.context.handle
        )
        wait_set.clear_entities()
        for subscription in subscriptions:
            wait_set.add_subscription(subscription.handle)
        for event in events:
            event.add_to_wait_set(wait_set)
        wait_set.add_guard_condition(self._stop.handle)
        follow_until_s = max((reader.follow_until_s for reader in readers), default=-math.inf)
        is_following = self.on_turn is not None or follow_until_s > time.monotonic()
        wait_set.wait(int(FOLLOW_PERIOD_S * 1e9) if is_following else -1)
        # all are taken before a callback is called, since the wait set holds their order
        reports = [(event, event.take_data()) for event in events if event.is_ready(wait_set)]
        for event, report in reports:
            if report:
                with self._node.surviving('an event of a subscription'):
                    event.callback(report)

    def _take_turn(self) -> bool:
        """Take a message of each other topic, all eager ones before it; False if none was left."""
        any_taken = False
        for reader in self._lazy:
            for eager in self._eager:
                while self._take(eager):
                    pass
            any_taken |= self._take(reader)
        return any_taken

    def _take(self, reader: TopicReader) -> bool:
        """Take a message and call the callback; return whether there was one."""
        subscription, received = reader.subscription, None
        if subscription is None or time.monotonic() > self._end_s:
            return False
        with self._node.surviving(f'a message on {reader.topic}'):
            received = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if received is not None:
                reader.callback(received[0])
        return received is not None


def name_of(reliability: ReliabilityPolicy) -> str:
    """Return a reliability as people write it: reliable, best effort."""
    return str(reliability.name).lower().replace('_', ' ')
