# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
StampGuard: the stamps of scans and poses decide which of them are used, and if time was set back.

One message with an odd stamp does not set time back or forward. A stamp is odd if it is before the
newest of its source by more than ``input.reset_after_s``, or ahead of all data by more than
MAX_AHEAD_S. The message is held until the next one, of any source, agrees with its stamp. Then
both are used, and time continues from their stamps. Otherwise it is dropped. After a message
ahead, any later stamp agrees: time went on. If that one is further than MAX_AHEAD_S again, as of a
sensor that stops to scan, steps up to twice as long are no longer odd.

The stamps of the scans of one frame ascend; those of two lidars say nothing about each other. The
clock is not read, and a replay decides as the node did.
"""

from __future__ import annotations

from typing import NamedTuple

from surfel_mapper.messages.poses import StampedPose
from surfel_mapper.poses import TransformBuffer
from surfel_mapper.scan import Scan

MAX_AHEAD_S = 60.0
"""A message whose stamp is further ahead of all data needs a second one that agrees, s."""

MAX_FRAMES = 64
"""Frames whose newest stamp is kept; of more, the one that was silent longest is forgotten."""


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
        self._held: Scan | StampedPose | None = None
        self._scan_ns: dict[str, int] = {}  # newest by frame, in order of arrival
        self._previous_ns: dict[str, int] = {}
        self.ahead_ns = round(MAX_AHEAD_S * 1e9)
        self.newest_ns: int | None = None

    @property
    def newest_scan_ns(self) -> int | None:
        """The newest stamp of a scan, whether the scan is mapped or still waits."""
        return max(self._scan_ns.values(), default=None)

    @property
    def scan_stamps(self) -> list[tuple[str, int]]:
        """The frames of scans, sorted, and the newest stamp of each, ns."""
        return sorted(self._scan_ns.items())

    @property
    def held_ns(self) -> int | None:
        """Stamp of the message that is held, if any."""
        return None if self._held is None else self._held.stamp_ns

    def judge(self, message: Scan | StampedPose) -> list[Judged]:
        """Return the messages that are decided now: the one that was held, and this one."""
        is_odd = self._is_odd(message)
        held, self._held = self._held, None
        judged = []
        if held is not None and self._agree(message.stamp_ns, held.stamp_ns, is_odd):
            is_odd, self.newest_ns = False, held.stamp_ns
            step_ns = message.stamp_ns - held.stamp_ns
            self.ahead_ns = max(round(MAX_AHEAD_S * 1e9), 2 * step_ns)
            judged.append(Judged(held))
        elif held is not None:
            judged.append(self._refused(held))
        if is_odd:
            self._held = message
            return judged
        if self.newest_ns is None or message.stamp_ns > self.newest_ns:
            self.newest_ns = message.stamp_ns
        return [*judged, Judged(message)]

    def release(self) -> list[Judged]:
        """Return the message that is held, refused: no other comes."""
        held, self._held = self._held, None
        return [] if held is None else [self._refused(held)]

    def order(self, scan: Scan) -> Order:
        """
        Enter the stamp of a scan that was judged as used; return its place in its frame.

        A stamp far before the last one of its frame sets time back, unless it continues the
        scans before the last one; then that one is odd.
        """
        frame_id, stamp_ns = scan.frame_id, scan.stamp_ns
        newest_ns, odd_ns, back_s = self._newest_of(frame_id), None, 0.0
        if newest_ns is not None and newest_ns - stamp_ns > self._back_ns:
            previous_ns = self._previous_ns.pop(frame_id, None)
            if previous_ns is not None and stamp_ns > previous_ns:
                odd_ns, self._scan_ns[frame_id] = newest_ns, previous_ns
            else:
                back_s = (newest_ns - stamp_ns) / 1e9
                self.forget_scans()
        last_ns = self._scan_ns.get(frame_id)
        if last_ns is not None and stamp_ns <= last_ns:
            cause = 'stamp_back' if stamp_ns < last_ns else 'stamp_repeated'
            behind_s = (last_ns - stamp_ns) / 1e9
            return Order(cause, f'its stamp is {behind_s:.3f} s before the one before it')
        self._enter(frame_id, stamp_ns, last_ns)
        return Order(back_s=back_s, odd_ns=odd_ns)

    def forget_scans(self) -> None:
        """Forget the stamps of all scans, as after time was set back."""
        self._scan_ns.clear()
        self._previous_ns.clear()

    def _enter(self, frame_id: str, stamp_ns: int, last_ns: int | None) -> None:
        """Keep the stamp of a scan as the newest of its frame."""
        if last_ns is not None:
            del self._scan_ns[frame_id]  # its new place is at the end
            self._previous_ns[frame_id] = last_ns
        elif len(self._scan_ns) >= MAX_FRAMES:
            silent = next(iter(self._scan_ns))
            del self._scan_ns[silent]
            self._previous_ns.pop(silent, None)
        self._scan_ns[frame_id] = stamp_ns

    def _newest_of(self, frame_id: str) -> int | None:
        """Return the newest stamp of a frame; of a new one the older of all scans' and poses'."""
        scan_ns = self._scan_ns.get(frame_id, self.newest_scan_ns)
        pose_ns = self._transforms.newest_ns
        if frame_id in self._scan_ns or scan_ns is None or pose_ns is None:
            return scan_ns
        return min(scan_ns, pose_ns)

    def _is_odd(self, message: Scan | StampedPose) -> bool:
        """Return whether the stamp of a message is far from those of its source and of others."""
        stamp_ns = message.stamp_ns
        if self.newest_ns is not None and stamp_ns - self.newest_ns > self.ahead_ns:
            return True
        if isinstance(message, Scan):
            own_ns, other_ns = self._newest_of(message.frame_id), self._transforms.newest_ns
        else:
            own_ns, other_ns = self._transforms.newest_of(message.child), self.newest_scan_ns
        if own_ns is None or own_ns - stamp_ns <= self._back_ns:
            return False
        return other_ns is None or abs(stamp_ns - other_ns) > self._back_ns

    def _agree(self, stamp_ns: int, held_ns: int, is_odd: bool) -> bool:
        """Return whether a stamp is within reset_after_s of the held one, or follows it if odd."""
        step_ns = stamp_ns - held_ns
        if is_odd and self.newest_ns is not None and held_ns > self.newest_ns:
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
