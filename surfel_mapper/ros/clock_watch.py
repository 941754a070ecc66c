# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Offsets between the clocks of clouds and poses, by the times at which their messages arrive.

A bag that is played fast or slowly has no steady offset. All calls come from one thread.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
import time

from surfel_mapper.config import InputConfig
from surfel_mapper.poses import ClockOffset, offset_s

KEPT = 100
"""Messages of a topic by which its clock is judged, the latest."""

LEAST = 10
"""Least number of messages for that."""

PERIOD_S = 1.0
"""Time between two comparisons, s."""


class ClockWatch:
    """
    The times by which stamps are ahead of the arrival of their messages, by topic.

    Parameters
    ----------
    config : InputConfig
        Its offsets are added to the stamps of clouds.
    warn : callable
        Called with the text of an offset when there is a new one.
    now_ns : callable
        Returns the time of the node, for messages without a stamp.

    Attributes
    ----------
    problem : str
        The present offset, its cause and remedy; empty if there is none.

    """

    def __init__(
        self, config: InputConfig, warn: Callable[[str], object], now_ns: Callable[[], int]
    ) -> None:
        self._config = config
        self._warn = warn
        self._now_ns = now_ns
        self._unstamped: set[str] = set()
        self._clouds: dict[str, deque[int]] = {}
        self._poses: dict[str, deque[int]] = {}
        self._checked_s = 0.0
        self._warned_s: dict[str, float] = {}
        self.problem = ''

    def arrival_ns(self, topic: str) -> int:
        """Return the present time for a message of which the stamp is 0; warn once a topic."""
        if topic not in self._unstamped:
            self._unstamped.add(topic)
            self._warn(f'{topic}: header.stamp is 0, not set: the arrival times are used')
        return self._now_ns()

    def note_cloud(self, topic: str, stamp_ns: int) -> None:
        """Note the stamp of a cloud that has just arrived."""
        offset_ns = round(1e9 * self._config.offset_s(topic))
        leads = self._clouds.setdefault(topic, deque(maxlen=KEPT))
        leads.append(stamp_ns + offset_ns - time.time_ns())
        now_s = time.monotonic()
        if now_s - self._checked_s >= PERIOD_S:
            self._checked_s = now_s
            self._compare()

    def note_poses(self, topic: str, stamps_ns: Iterable[int]) -> None:
        """Note the stamps of poses that have just arrived."""
        now_ns = time.time_ns()
        leads = self._poses.setdefault(topic, deque(maxlen=KEPT))
        leads.extend(stamp_ns - now_ns for stamp_ns in stamps_ns)

    def _compare(self) -> None:
        """Compare the clocks of clouds with those of poses, without poses of the first clouds."""
        references = self._poses or dict([*self._clouds.items()][:1])
        texts = []
        for topic, leads in self._clouds.items():
            for reference, pose_leads in references.items():
                enough = min(len(leads), len(pose_leads)) >= LEAST
                seconds = offset_s(leads, pose_leads) if enough and topic != reference else None
                if seconds is not None:
                    offset = ClockOffset(topic, reference, seconds, 'arrival times')
                    texts.append(self._text(offset))
                    self._warn_once(topic, seconds, texts[-1])
        self.problem = '; '.join(texts)

    def _text(self, offset: ClockOffset) -> str:
        topic = offset.clouds
        if len(self._config.topics) > 1:
            wanted_s = self._config.own_offset_s(topic) - offset.seconds
            remedy = f'input.time_offsets_s, {wanted_s:.3f} for {topic},'
        else:
            remedy = f'input.time_offset_s: {self._config.offset_s(topic) - offset.seconds:.3f}'
        return offset.described(remedy)

    def _warn_once(self, topic: str, seconds: float, text: str) -> None:
        """Warn of an offset, unless it was the same at the last warning."""
        if abs(self._warned_s.get(topic, 0.0) - seconds) > 0.1 * abs(seconds):
            self._warned_s[topic] = seconds
            self._warn(text)
