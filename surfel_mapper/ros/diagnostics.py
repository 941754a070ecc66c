# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reports on /diagnostics, from the first moment of a node to its last.

A report about a map is made in the mapping thread, where nothing changes meanwhile. The timer
that asks for it runs in the executor's, and tells if there was no answer: a thread that hangs
cannot say so itself. The rate is one of a steady clock, so it holds while simulated time stands.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
import resource
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np
from rclpy.node import Node
from std_msgs.msg import Header

from surfel_mapper.ros.base_node import CountedPublisher, steady_timer
from surfel_mapper.ros.health import ERROR, findings, Interval, OFF_S, OK
from surfel_mapper.ros.messages import time_message
from surfel_mapper.ros.session import Session

LEVELS = (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR)

BUSY_S = 5.0
"""A mapping thread that has not answered for so long is an error."""


class Diagnostics:
    """
    The reports of a node.

    Parameters
    ----------
    node : Node
        Has a ``state``, the name of its state.
    rate_hz : float
        So many reports a second; 0: none.

    """

    def __init__(self, node: Any, rate_hz: float) -> None:
        """Report from now on, at first the state alone."""
        self._session: Session | None = None
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._asked_s: float | None = None
        self._last = Totals()
        if rate_hz:
            steady_timer(node, rate_hz, self._on_timer)

    def watch(self, session: Session | None) -> None:
        """Report about a session from now on, or about none."""
        self._session, self._asked_s, self._last = session, None, Totals()

    def _on_timer(self) -> None:
        """Ask the mapping thread for a report, or report that it does not answer."""
        session, now_s = self._session, time.monotonic()
        if session is None:
            self._publish(OK, self._node.state, {'state': self._node.state})
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
        last, now = self._last, Totals.of(self._node, session)
        self._last = now
        found = []
        if self._node.state == 'active':
            interval = now.since(last, self._node, session)
            found = list(findings(interval, session.config.diagnostics))
        level = max((level for level, _ in found), default=OK)
        text = '; '.join(text for _, text in found)
        fine = 'ok' if self._node.state == 'active' else self._node.state
        values = {'state': self._node.state, **now.rates(last), **figures(session)}
        self._publish(level, text or fine, values)

    def _publish(self, level: int, text: str, values: Mapping[str, Any]) -> None:
        now_ns = self._node.get_clock().now().nanoseconds
        message = diagnostics(self._node.get_name(), now_ns, level, text, values)
        self._publisher.publish(message)


class Totals:
    """What happened until a moment, of which two make an interval."""

    def __init__(self) -> None:
        """Be the totals of the beginning."""
        self.time_s = time.monotonic()
        self.received = 0
        self.lost = 0
        self.dropped: Counter[str] = Counter()
        self.published: dict[str, int] = {}

    @classmethod
    def of(cls, node: Node, session: Session) -> Totals:
        """Return those of a session now."""
        now = cls()
        counters = session.mapper.counters
        now.received = counters.received
        now.lost = session.inputs.clouds_lost
        now.dropped = Counter(counters.dropped)
        now.published = {
            publisher.topic_name: publisher.num_published
            for publisher in list(node.publishers)
            if isinstance(publisher, CountedPublisher)
        }
        return now

    def since(self, last: Totals, node: Node, session: Session) -> Interval:
        """Return what happened since the last; of several topics the most silent one counts."""
        topic, heard_s = session.inputs.most_silent
        return Interval(
            topic=topic,
            num_publishers=node.count_publishers(topic),
            ever_received=self.received > 0,
            received=self.received - last.received,
            silent_s=max(self.time_s - heard_s, 0.0),
            dropped=self.dropped - last.dropped,
            latency_s=latency(session, 99) if self.received > last.received else None,
            paused=session.thread.paused,
            loss=session.inputs.loss() if self.lost > last.lost else '',
        )

    def rates(self, last: Totals) -> dict[str, Any]:
        """Return messages a second since the last, in and out."""
        seconds = self.time_s - last.time_s

        def rate_hz(number: int, before: int) -> float:
            return round(max(number - before, 0) / seconds, 2)

        return {
            'received_hz': rate_hz(self.received, last.received),
            'published_hz': {
                topic: rate_hz(number, last.published.get(topic, 0))
                for topic, number in self.published.items()
            },
        }


def figures(session: Session) -> dict[str, Any]:
    """Return counts, times and sizes of a session."""
    mapper, counters = session.mapper, session.mapper.counters
    done = counters.mapped + counters.gated + counters.localised + counters.dropped.total()
    return {
        'clouds_lost': session.inputs.clouds_lost,
        'queue': session.thread.num_clouds,
        'waiting': counters.received - done,
        'latency_ms': {
            name: None if found is None else round(found * 1e3, 1)
            for name, found in (('median', latency(session, 50)), ('p99', latency(session, 99)))
        },
        **counters.summary(),
        'voxels': mapper.map.num_voxels,
        'map_bytes': mapper.map.nbytes,
        'window_scans': len(mapper.window),
        'window_bytes': mapper.window.nbytes,
        'process_bytes': process_bytes(),
    }


def latency(session: Session, percentile: float) -> float | None:
    """Return a percentile of the latest latencies, s; None without any, or by another clock."""
    if not session.latencies_s:
        return None
    found = float(np.percentile(session.latencies_s, percentile))
    return found if abs(found) < OFF_S else None


def process_bytes() -> int:
    """Return the memory that the process has resident; 0 where nobody tells."""
    try:
        pages = Path('/proc/self/statm').read_text(encoding='ascii').split()[1]
    except OSError:
        return 0  # no Linux, or no file descriptor left
    return int(pages) * resource.getpagesize()


def diagnostics(
    name: str, stamp_ns: int, level: int, text: str, values: Mapping[str, Any]
) -> DiagnosticArray:
    """
    Return a report about one node.

    Parameters
    ----------
    name : str
        Of the node.
    stamp_ns : int
        The time now.
    level : int
        OK, WARN or ERROR.
    text : str
        What is wrong and what to do about it.
    values : mapping of str
        Figures; nested mappings become names with dots.

    """
    status = DiagnosticStatus(
        level=LEVELS[level],
        name=f'{name}: mapping',
        message=text,
        hardware_id=name,
        values=[KeyValue(key=key, value=str(value)) for key, value in leaves(values)],
    )
    return DiagnosticArray(header=Header(stamp=time_message(stamp_ns)), status=[status])


def leaves(values: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    """Yield the values of nested mappings under dotted names."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value
