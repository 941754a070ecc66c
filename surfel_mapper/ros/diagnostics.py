# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reports on /diagnostics, published in every state of the node.

The mapping thread makes the report, since the map does not change meanwhile. A timer in the
executor asks for it and reports an error if there is no answer, because a thread that hangs
cannot say so itself. The timer uses the steady clock, so it also runs while simulated time
stands still.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
import os
from pathlib import Path
import resource
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.utilities import get_rmw_implementation_identifier
from std_msgs.msg import Header

from surfel_mapper.compilation import PROGRESS
from surfel_mapper.config import Config, flatten
from surfel_mapper.errors import one_line
from surfel_mapper.pipeline.scan_poses import standing_sensor
from surfel_mapper.ros.base_node import CountedPublisher, Ticker
from surfel_mapper.ros.context import UDP_PROFILE
from surfel_mapper.ros.health import ERROR, findings, Interval, OFF_S, OK
from surfel_mapper.ros.messages import time_message
from surfel_mapper.ros.publishers import (
    mismatch,
    of_other_types,
    other_users,
    publishers_of,
    user_name,
)
from surfel_mapper.ros.session import Session

LEVELS = (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR)

SILENT_S = 3.0
"""Time without a cloud of a publisher that is known, after which other users are looked for, s."""

BUSY_S = 5.0
"""A mapping thread that does not answer for this time is reported as an error."""


class Diagnostics:
    """
    Publishes the reports of a node.

    Parameters
    ----------
    node : Node
        The node; ``node.state`` is the name of its life cycle state.
    rate_hz : float
        Rate of the reports; 0: none.

    """

    def __init__(self, node: Any, rate_hz: float) -> None:
        self._session: Session | None = None
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._asked_s: float | None = None
        self._last = Totals()
        self._ticker: Ticker | None = None
        if rate_hz:
            self._ticker = Ticker(node, 'diagnostics', 1.0 / rate_hz, self._on_timer)

    def stop(self) -> None:
        """Publish no more."""
        if self._ticker is not None:
            self._ticker.stop()

    def watch(self, session: Session | None) -> None:
        """Report about a session from now on; None: the state alone."""
        self._session, self._asked_s, self._last = session, None, Totals()

    def _on_timer(self) -> None:
        """Request a report from the mapping thread, or report that it does not answer."""
        session, now_s = self._session, time.monotonic()
        if session is None or PROGRESS.is_active:
            text = PROGRESS.text if PROGRESS.is_active else self._node.state
            self._asked_s = None if PROGRESS.is_active else self._asked_s
            self._publish(OK, text, {'state': self._node.state, 'compiling': PROGRESS.stage})
            return
        if self._asked_s is None:
            self._asked_s = now_s
            session.thread.post(self._report)
        elif now_s - self._asked_s > BUSY_S:
            text = f'the mapping thread has been busy for {now_s - self._asked_s:.0f} s'
            self._publish(ERROR, text, {'state': self._node.state})

    def _report(self) -> None:
        """Publish a report about the session; called in the mapping thread."""
        self._asked_s = None
        session = self._session
        if session is None:
            return
        last, totals = self._last, Totals.of(self._node, session)
        self._last = totals
        problems = []
        if self._node.state == 'active':
            interval = totals.since(last, self._node, session)
            problems = list(findings(interval, session.config.diagnostics))
        level = max((level for level, _ in problems), default=OK)
        text = '; '.join(text for _, text in problems)
        healthy = 'ok' if self._node.state == 'active' else self._node.state
        values = {'state': self._node.state, **totals.rates(last), **figures(session)}
        self._publish(level, text or healthy, values)

    def _publish(self, level: int, text: str, values: Mapping[str, Any]) -> None:
        now_ns = self._node.get_clock().now().nanoseconds
        name = self._node.get_fully_qualified_name().lstrip('/')
        message = diagnostics(name, now_ns, level, text, values)
        self._publisher.publish(message)


class Totals:
    """Counts since the start of the session; two of them make an interval."""

    def __init__(self) -> None:
        """Start at zero."""
        self.time_s = time.monotonic()
        self.received = self.mapped = 0
        self.num_publishers = 0
        self.lost = 0
        self.dropped: Counter[str] = Counter()
        self.published: dict[str, int] = {}

    @classmethod
    def of(cls, node: Node, session: Session) -> Totals:
        """Return the present counts of a session."""
        totals = cls()
        counters = session.mapper.counters
        totals.received = counters.received
        totals.mapped = counters.mapped + counters.gated + counters.localised
        totals.lost = session.inputs.clouds_lost
        totals.dropped = Counter(counters.dropped)
        totals.published = {
            publisher.topic_name: publisher.num_published
            for publisher in list(node.publishers)
            if isinstance(publisher, CountedPublisher)
        }
        return totals

    def since(self, last: Totals, node: Node, session: Session) -> Interval:
        """Return the interval since an earlier count; of several topics, the most silent one."""
        topic, received_s = session.inputs.most_silent
        registered = session.mapper.registered
        self.num_publishers, unheard = publishers(node, topic)
        silent_s = max(self.time_s - received_s, 0.0)
        is_silent = silent_s > SILENT_S and min(self.num_publishers, last.num_publishers) > 0
        if is_silent and not unheard:
            unheard = of_another_user(node)
        if unheard and not self.received:
            node.get_logger().warning(f'{topic}: {unheard}', throttle_duration_sec=60.0)
        return Interval(
            topic=topic,
            num_publishers=self.num_publishers,
            unheard=unheard,
            ever_received=self.received > 0,
            received=self.received - last.received,
            never_mapped=0 if self.mapped else last.received,
            silent_s=silent_s,
            dropped=self.dropped - last.dropped,
            latency_s=latency(session, 99) if self.received > last.received else None,
            paused=session.thread.paused,
            layers_off=session.mapper.counters.layers_off,
            loss=session.inputs.loss() if self.lost > last.lost or not self.received else '',
            alternatives=session.inputs.alternatives,
            poses=session.inputs.poses.warning or (registered.problem if registered else ''),
            clocks=session.inputs.clocks.problem,
            checkpoints=session.checkpoints.problem,
            mounts=session.inputs.poses.mount_changes(session.mapper.mount_changes),
        )

    def rates(self, last: Totals) -> dict[str, Any]:
        """Return the rates since an earlier count, received and published, in Hz."""
        seconds = self.time_s - last.time_s

        def rate_hz(number: int, previous: int) -> float:
            return round(max(number - previous, 0) / seconds, 2)

        return {
            'received_hz': rate_hz(self.received, last.received),
            'published_hz': {
                topic: rate_hz(number, last.published.get(topic, 0))
                for topic, number in self.published.items()
            },
        }


def publishers(node: Node, topic: str) -> tuple[int, str]:
    """Return the number of publishers of a subscribed topic, and why they are not heard."""
    subscription = subscription_to(node, topic)
    if subscription is None:
        return node.count_publishers(topic), ''
    number = len(publishers_of(node, topic, subscription.msg_type))
    unheard = mismatch(node, topic, subscription.msg_type, subscription.qos_profile)
    return number, unheard or (
        '' if number else of_other_types(node, topic, subscription.msg_type)
    )


def of_another_user(node: Node) -> str:
    """Return that publishers may be silent because their user is another one, and the remedy."""
    if not get_rmw_implementation_identifier().startswith('rmw_fastrtps'):
        return ''
    users = other_users(node.context.get_domain_id(), os.geteuid())
    if not users:
        return ''
    return (
        'its publisher is there, but no message arrives, and Fast DDS has shared memory of '
        f'another user ({users}), which this one ({user_name(os.geteuid())}) cannot open. Run '
        'driver and node as the same user, or put in front of the command of one of them: '
        f'FASTRTPS_DEFAULT_PROFILES_FILE={UDP_PROFILE}'
    )


def subscription_to(node: Node, topic: str) -> Subscription | None:
    """Return the newest subscription to a topic, if there is one."""
    for subscription in reversed(list(node.subscriptions)):
        with suppress(InvalidHandle):  # another thread may destroy it
            if subscription.topic_name == topic:
                return subscription
    return None


def is_oriented(config: Config) -> bool:
    """Return whether the positions of the sensors are known, so that normals turn to them."""
    return config.pose.source != 'identity' or standing_sensor(config) is not None


def figures(session: Session) -> dict[str, Any]:
    """Return the counts, times and sizes of a session."""
    mapper, counters = session.mapper, session.mapper.counters
    finished = counters.mapped + counters.gated + counters.localised + counters.dropped.total()
    return {
        'clouds_lost': session.inputs.clouds_lost,
        'qos': session.inputs.subscriptions.reliabilities(),
        'queue': session.thread.num_clouds,
        'waiting': counters.received - finished,
        'latency_ms': {
            name: None if value is None else round(value * 1e3, 1)
            for name, value in (('median', latency(session, 50)), ('p99', latency(session, 99)))
        },
        **counters.summary(),
        'pose_source': session.inputs.poses.source,
        'pose_reason': session.inputs.poses.reason,
        **({'registration': mapper.registered.summary()} if mapper.registered else {}),
        'normals': 'oriented' if is_oriented(mapper.config) else 'not oriented',
        'voxels': mapper.map.num_voxels,
        'map_bytes': mapper.map.nbytes,
        'window_scans': len(mapper.window),
        'window_bytes': mapper.window.nbytes,
        'process_bytes': process_bytes(),
        'compile_s': round(PROGRESS.seconds, 1),
    }


def latency(session: Session, percentile: float) -> float | None:
    """Return a percentile of the latest latencies, s; None without any or if clocks differ."""
    if not session.latencies_s:
        return None
    latency_s = float(np.percentile(session.latencies_s, percentile))
    return latency_s if abs(latency_s) < OFF_S else None


def process_bytes() -> int:
    """Return the resident memory of the process; 0 if it is not known."""
    try:
        pages = Path('/proc/self/statm').read_text(encoding='ascii').split()[1]
    except OSError:
        return 0  # not Linux, or no file descriptor left
    return int(pages) * resource.getpagesize()


def diagnostics(
    name: str, stamp_ns: int, level: int, text: str, values: Mapping[str, Any]
) -> DiagnosticArray:
    """
    Return a report about one node.

    Parameters
    ----------
    name : str
        Name of the node, with its namespace.
    stamp_ns : int
        Present time.
    level : int
        OK, WARN or ERROR.
    text : str
        The problem and its remedy.
    values : mapping of str
        Values; nested mappings become dotted names.

    """
    status = DiagnosticStatus(
        level=LEVELS[level],
        name=f'{name}: mapping',
        message=one_line(text),
        hardware_id=name,
        values=[
            KeyValue(key=one_line(key), value=one_line(str(value)))
            for key, value in flatten(values)
        ],
    )
    return DiagnosticArray(header=Header(stamp=time_message(stamp_ns)), status=[status])
