# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The scans that wait for their poses, in the order of their stamps.

Time is the stamps of the data alone, never the clock, so that a bag replayed at any speed waits
and drops alike. Every sensor has its own order: that of one lidar says nothing of another's.
"""

from __future__ import annotations

from collections import deque

from surfel_mapper.pipeline.drops import Drops
from surfel_mapper.scan import Scan

MAX_FRAMES = 64
"""Sensors of one robot; more are frame names that change, and would be remembered forever."""


class ScanQueue:
    """
    A bounded queue of scans.

    Parameters
    ----------
    max_scans : int
        At most so many wait; the oldest is dropped.
    drops : Drops
        Counts those that are.

    """

    def __init__(self, max_scans: int, drops: Drops) -> None:
        """Make an empty queue."""
        self._max_scans = max_scans
        self._drops = drops
        self._scans: deque[Scan] = deque()
        self._newest_ns: dict[str, int] = {}

    def __len__(self) -> int:
        """Return how many scans wait."""
        return len(self._scans)

    @property
    def first(self) -> Scan | None:
        """The scan that waits longest."""
        return self._scans[0] if self._scans else None

    @property
    def second(self) -> Scan | None:
        """The one that comes after it."""
        return self._scans[1] if len(self._scans) > 1 else None

    @property
    def newest_ns(self) -> int | None:
        """The newest stamp that came in, whether its scan waits still or not."""
        return max(self._newest_ns.values(), default=None)

    @property
    def stamps(self) -> dict[str, int]:
        """The newest stamp of every frame, ns."""
        return dict(self._newest_ns)

    @property
    def waiting(self) -> list[tuple[str, int]]:
        """Frame and stamp of every scan that waits, in order."""
        return [(scan.frame_id, scan.stamp_ns) for scan in self._scans]

    def back_s(self, scan: Scan) -> float:
        """Return by how much the stamp of a scan is before the newest, s; 0 where it is not."""
        newest_ns = self.newest_ns
        return 0.0 if newest_ns is None else max(newest_ns - scan.stamp_ns, 0) / 1e9

    def has_room_for(self, frame_id: str) -> bool:
        """Return whether scans of a frame are taken: at most MAX_FRAMES have an order kept."""
        return frame_id in self._newest_ns or len(self._newest_ns) < MAX_FRAMES

    def push(self, scan: Scan) -> None:
        """Add a scan, unless its stamp is not newer than the last of its frame."""
        last_ns = self._newest_ns.get(scan.frame_id)
        if last_ns is not None and scan.stamp_ns <= last_ns:
            behind_s = (last_ns - scan.stamp_ns) / 1e9
            cause = 'stamp_back' if behind_s else 'stamp_repeated'
            reason = f'its stamp is {behind_s:.3f} s before the one before it'
            self._drops.scan(scan, cause, reason)
            return
        self._newest_ns[scan.frame_id] = scan.stamp_ns
        self._scans.append(scan)
        while len(self._scans) > self._max_scans:
            reason = f'{self._max_scans} newer scans wait for their poses'
            self._drops.scan(self._scans.popleft(), 'queue_full', reason)

    def pop(self) -> Scan:
        """Remove and return the scan that waits longest."""
        return self._scans.popleft()

    def drop_all(self, cause: str, reason: str) -> None:
        """Drop every scan that waits."""
        while self._scans:
            self._drops.scan(self._scans.popleft(), cause, reason)

    def forget_stamps(self) -> None:
        """Take any stamp next, as after time was set back."""
        self._newest_ns.clear()
