# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
StampGuard: the stamps of scans and poses decide which of them are used, and if time was set back.

A stamp is odd if it is before the newest of its source by more than ``input.reset_after_s``, or
ahead of all by more than MAX_AHEAD_S. Odd messages wait until another message decides:

- A pose confirms scans, and a scan poses, with odd stamps near its own: time was set. All are
  used, and time continues from their stamps.
- A stamp in time refutes them: they are dropped. A sensor with another clock, or one that counts
  from 1970 for a second after a restart, leaves the map as it was.
- A source that no other contradicts for ALONE_S, by its own stamps, is believed; if it is ahead
  and there is no other, at its second message. After a message
  ahead, any later stamp agrees. If that is further than MAX_AHEAD_S again, as of a sensor that
  stops to scan, steps up to twice as long are no longer odd.

A scan may be older than the one before it of its topic and frame, by at most
``input.reset_after_s``, but not repeat a stamp. The stamps of two lidars say nothing about each
other. The clock is not read, and a replay decides as the node did.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from surfel_mapper.messages.poses import StampedPose
from surfel_mapper.poses import TransformBuffer
from surfel_mapper.scan import Scan

MAX_AHEAD_S = 60.0
"""A message whose stamp is further ahead of all data needs a second one that agrees, s."""

ALONE_S = 2.0
"""Span of the odd stamps of a source that no other message contradicts, to believe them, s."""

OUT_OF_STEP_NS = 4 * 10**9
"""A scan further ahead of the poses is odd if the scans of another sensor are not, ns."""

MAX_WAITING = 5000
"""Number of odd messages that wait; 2 s of poses at 1 kHz are within it."""

MAX_FRAMES = 64
"""Sources whose newest stamps are kept; of more, the one that was silent longest is forgotten."""

MAX_RECENT = 256
"""Number of stamps of a source that are kept to recognise repeated scans."""

Source = tuple[str, str]
"""Topic and frame of scans."""


class Judged(NamedTuple):
    """A scan or a pose, and the reason why its stamp is odd; empty if the message is used."""

    message: Scan | StampedPose
    odd: str = ''


class Order(NamedTuple):
    """
    The place of a scan among those of its frame.

    Attributes
    ----------
    cause, reason : str
        Cause and reason of its drop; empty if it is used.
    back_s : float
        Time was set back by this, s; 0 if it was not.
    odd_ns : int, optional
        Stamp of the scan before it, which was ahead of this one and is odd.

    """

    cause: str = ''
    reason: str = ''
    back_s: float = 0.0
    odd_ns: int | None = None


class StampGuard:
    """
    Judges the stamps of scans and poses.

    Parameters
    ----------
    reset_after_s : float
        A stamp further back than this is odd.
    transforms : TransformBuffer
        The poses that were used.

    Attributes
    ----------
    newest_ns : int or None
        The newest stamp accepted since time was set back.
    ahead_ns : int
        A stamp further ahead than this is odd.

    """

    def __init__(self, reset_after_s: float, transforms: TransformBuffer) -> None:
        self._back_ns = round(reset_after_s * 1e9)
        self._transforms = transforms
        self._odd: list[Scan | StampedPose] = []
        self._scan_ns: dict[Source, int] = {}  # newest, in order of arrival
        self._previous_ns: dict[Source, int] = {}
        self._recent_ns: dict[Source, deque[int]] = {}
        self.ahead_ns = round(MAX_AHEAD_S * 1e9)
        self.newest_ns: int | None = None
        self._newest_scan_ns: int | None = None  # of all sources

    def newest_of(self, scan: Scan) -> int | None:
        """Return the newest stamp of the source of a scan; of all scans if there are no poses."""
        own_ns = self._scan_ns.get(source_of(scan))
        return self._newest_scan_ns if self._transforms.newest_ns is None else own_ns

    def judge(self, message: Scan | StampedPose) -> list[Judged]:
        """Return the messages that are decided now, in their order."""
        is_odd, waiting = self._is_odd(message), self._odd
        agrees = bool(waiting) and self._agree(message.stamp_ns, waiting[-1].stamp_ns, is_odd)
        if agrees and is_odd and not self._is_confirmed(message):
            waiting.append(message)
            return []
        self._odd = []
        judged = []
        for odd in waiting:
            judged.append(Judged(odd) if agrees else self._refused(odd))
        if agrees:
            is_odd, self.newest_ns = False, waiting[-1].stamp_ns
            step_ns = message.stamp_ns - waiting[-1].stamp_ns
            self.ahead_ns = max(round(MAX_AHEAD_S * 1e9), 2 * step_ns)
        if is_odd:
            self._odd = [message]
            return judged
        if self.newest_ns is None or message.stamp_ns > self.newest_ns:
            self.newest_ns = message.stamp_ns
        return [*judged, Judged(message)]

    def release(self) -> list[Judged]:
        """Return the messages that wait, refused: no others come."""
        waiting, self._odd = self._odd, []
        return [self._refused(message) for message in waiting]

    def order(self, scan: Scan, *, takes_late: bool = True) -> Order:
        """
        Enter the stamp of a scan that was judged as used; return its place in its source.

        A stamp far before the last one sets time back, unless it continues the scans before the
        last one; then that one is odd.

        Parameters
        ----------
        scan : Scan
            The scan.
        takes_late : bool
            Whether its pose can be looked up if it is a little older than the scan before it.

        """
        source, stamp_ns = source_of(scan), scan.stamp_ns
        newest_ns, odd_ns, back_s = self._newest_of(source), None, 0.0
        if newest_ns is not None and newest_ns - stamp_ns > self._back_ns:
            previous_ns = self._previous_ns.pop(source, None)
            if previous_ns is not None and stamp_ns > previous_ns:
                odd_ns, self._scan_ns[source] = newest_ns, previous_ns
            else:
                back_s = (newest_ns - stamp_ns) / 1e9
                self.forget_scans()
        last_ns = self._scan_ns.get(source)
        if last_ns is not None and stamp_ns <= last_ns:
            is_repeated = stamp_ns == last_ns or stamp_ns in self._recent_ns[source]
            if is_repeated or not takes_late:
                cause = 'stamp_repeated' if is_repeated else 'stamp_back'
                behind = f'{(last_ns - stamp_ns) / 1e9:.3f} s before that of the last scan'
                problem = 'that of an earlier scan' if is_repeated else behind
                return Order(cause, f'its stamp is {problem}')
            self._recent_ns[source].append(stamp_ns)
            return Order()
        if last_ns is not None:
            del self._scan_ns[source]  # its new place is at the end
            self._previous_ns[source] = last_ns
        elif len(self._scan_ns) >= MAX_FRAMES:
            silent = next(iter(self._scan_ns))
            for stamps in (self._scan_ns, self._previous_ns, self._recent_ns):
                stamps.pop(silent, None)
        self._scan_ns[source] = stamp_ns
        self._newest_scan_ns = max(self._scan_ns.values())
        self._recent_ns.setdefault(source, deque(maxlen=MAX_RECENT)).append(stamp_ns)
        return Order(back_s=back_s, odd_ns=odd_ns)

    def forget_scans(self) -> None:
        """Forget the stamps of all scans, as after time was set back."""
        self._scan_ns.clear()
        self._newest_scan_ns = None
        self._previous_ns.clear()
        self._recent_ns.clear()

    def _newest_of(self, source: Source) -> int | None:
        """Return the newest stamp of a source; of a new one the older of all scans' and poses'."""
        scan_ns = self._scan_ns.get(source, self._newest_scan_ns)
        pose_ns = self._transforms.newest_ns
        if source in self._scan_ns or scan_ns is None or pose_ns is None:
            return scan_ns
        return min(scan_ns, pose_ns)

    def _is_odd(self, message: Scan | StampedPose) -> bool:
        """Return whether the stamp of a message is far from those of its source and of others."""
        stamp_ns, scan_ns, pose_ns = (
            message.stamp_ns,
            self._newest_scan_ns,
            self._transforms.newest_ns,
        )
        if isinstance(message, Scan):
            source, other_ns = source_of(message), pose_ns
            own_ns, kind_ns = self._newest_of(source), pose_ns if scan_ns is None else scan_ns
            is_ahead = pose_ns is not None and stamp_ns - pose_ns > OUT_OF_STEP_NS
            if pose_ns is not None and is_ahead and self._is_out_of_step(source, pose_ns):
                return True
            if self._previous_ns.get(source, stamp_ns) < stamp_ns <= (own_ns or stamp_ns):
                return False  # the last one is odd: this scan continues those before it
        else:
            own_ns, other_ns = self._transforms.newest_of(message.child), scan_ns
            kind_ns = pose_ns
        if kind_ns is not None and stamp_ns - max(kind_ns, other_ns or kind_ns) > self.ahead_ns:
            return True
        if own_ns is None or own_ns - stamp_ns <= self._back_ns:
            return False
        return other_ns is None or abs(stamp_ns - other_ns) > self._back_ns

    def _is_out_of_step(self, source: Source, pose_ns: int) -> bool:
        """Return whether scans of another sensor are near the poses, unlike those of a source."""
        return any(
            abs(scan_ns - pose_ns) <= OUT_OF_STEP_NS
            for sensor, scan_ns in self._scan_ns.items()
            if sensor != source
        )

    def _is_confirmed(self, message: Scan | StampedPose) -> bool:
        """Return whether an odd message confirms those that wait: of the other kind, or long."""
        kind, first = type(message), self._odd[0]
        return (
            self._is_only_source(message, first.stamp_ns)
            or any(type(waiting) is not kind for waiting in self._odd)
            or abs(message.stamp_ns - first.stamp_ns) >= ALONE_S * 1e9
            or len(self._odd) >= MAX_WAITING
        )

    def _is_only_source(self, message: Scan | StampedPose, stamp_ns: int) -> bool:
        """Return whether only one sensor gives data, and a stamp is ahead: it has paused."""
        return (
            isinstance(message, Scan)
            and self._transforms.newest_ns is None
            and self._scan_ns.keys() <= {source_of(message)}
            and (self.newest_ns is None or stamp_ns > self.newest_ns)
        )

    def _agree(self, stamp_ns: int, odd_ns: int, is_odd: bool) -> bool:
        """Return whether a stamp is within reset_after_s of an odd one, or follows it if odd."""
        step_ns = stamp_ns - odd_ns
        if is_odd and self.newest_ns is not None and odd_ns > self.newest_ns:
            return step_ns >= -self._back_ns
        return -self._back_ns <= step_ns <= (self.ahead_ns if is_odd else self._back_ns)

    def _refused(self, message: Scan | StampedPose) -> Judged:
        """Return a message with the reason why it is not used."""
        newest_ns = message.stamp_ns if self.newest_ns is None else self.newest_ns
        off_s = (message.stamp_ns - newest_ns) / 1e9
        side = f'{off_s:.3f} s ahead of' if off_s > 0.0 else f'{-off_s:.3f} s before'
        reason = (
            f'its stamp is {side} the newest data, and the next message does not agree with it'
        )
        return Judged(message, reason)


def source_of(scan: Scan) -> Source:
    """Return the topic and the frame of a scan."""
    return scan.topic, scan.frame_id
