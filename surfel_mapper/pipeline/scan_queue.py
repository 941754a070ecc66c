# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
ScanQueue: scans that wait for their poses and images, in the order in which they came in.

Time is the stamps of the data alone, never the clock, so a bag replayed at any speed waits and
drops alike. Stamps ascend within each frame only: those of one lidar say nothing about another's.
A scan whose pose cannot come any more, or did not within ``pose.max_wait_s`` of the newest data,
is dropped and counted. The wait is longer, ``pose.max_delay_s``, while the scan is newer than all
poses: these are on the way.
"""

from __future__ import annotations

from collections import deque

from surfel_mapper.config import PoseConfig
from surfel_mapper.errors import PoseError, PoseNotYetError, PosesLateError
from surfel_mapper.geometry import Transform
from surfel_mapper.pipeline.drops import Drops
from surfel_mapper.pipeline.scan_images import ScanImages
from surfel_mapper.pipeline.scan_poses import ScanPoses
from surfel_mapper.scan import Scan

MAX_FRAMES = 64
"""Frames whose newest stamp is kept; of more, the one that was silent longest is forgotten."""

PosedScan = tuple[Scan, Transform]
"""A scan and its T_fixed_sensor."""


class ScanQueue:
    """
    A bounded queue of scans, and behind it the scans that have their poses.

    Parameters
    ----------
    max_scans : int
        Scans that may wait; of more, the oldest is dropped.
    poses : ScanPoses
        The poses of the sensors.
    images : ScanImages, optional
        Scans wait for these images as well.
    drops : Drops
        Counts the scans that are dropped.

    Attributes
    ----------
    posed : deque of (Scan, (4, 4) float64)
        The next scans to map, and their T_fixed_sensor.
    ended : bool
        No poses come any more: a scan without one is dropped at once, for those behind it.
    is_open : bool
        False while the source of the poses is unknown: scans wait, at most ``max_scans``.

    """

    def __init__(
        self, max_scans: int, poses: ScanPoses, images: ScanImages | None, drops: Drops
    ) -> None:
        self._max_scans = max_scans
        self._poses = poses
        self._images = images
        self._drops = drops
        self._scans: deque[Scan] = deque()
        self.posed: deque[PosedScan] = deque()
        self._newest_ns: dict[str, int] = {}
        self._before_ns: dict[str, int] = {}
        self.ended = False
        self.is_open = True

    @property
    def newest_ns(self) -> int | None:
        """The newest stamp that came in, whether its scan still waits or not."""
        return max(self._newest_ns.values(), default=None)

    def newest_of(self, frame_id: str) -> int | None:
        """Return the newest stamp of a frame; of a new one the older of all scans' and poses'."""
        scan_ns = self._newest_ns.get(frame_id, self.newest_ns)
        pose_ns = self._poses.transforms.newest_ns
        if frame_id in self._newest_ns or scan_ns is None or pose_ns is None:
            return scan_ns
        return min(scan_ns, pose_ns)

    @property
    def stamps(self) -> dict[str, int]:
        """The newest stamp of every frame, ns."""
        return dict(self._newest_ns)

    @property
    def waiting(self) -> list[tuple[str, int]]:
        """Frame and stamp of every scan that waits, in order."""
        return [(scan.frame_id, scan.stamp_ns) for scan in self._scans]

    def push(self, scan: Scan) -> None:
        """Add a scan, unless its stamp is not newer than the last of its frame."""
        self.ended = False
        last_ns = self._newest_ns.pop(scan.frame_id, None)
        if last_ns is not None and scan.stamp_ns <= last_ns:
            behind_s = (last_ns - scan.stamp_ns) / 1e9
            cause = 'stamp_back' if behind_s else 'stamp_repeated'
            reason = f'its stamp is {behind_s:.3f} s before the one before it'
            self._drops.scan(scan, cause, reason)
            self._newest_ns[scan.frame_id] = last_ns
            return
        if len(self._newest_ns) >= MAX_FRAMES:
            silent = next(iter(self._newest_ns))
            del self._newest_ns[silent]
            self._before_ns.pop(silent, None)
        self._newest_ns[scan.frame_id] = scan.stamp_ns  # at the end: in order of arrival
        if last_ns is not None:
            self._before_ns[scan.frame_id] = last_ns
        self._scans.append(scan)
        while len(self._scans) > self._max_scans:
            reason = f'{self._max_scans} newer scans wait for their poses'
            self._drops.scan(self._scans.popleft(), 'queue_full', reason)

    def drop_odd_before(self, scan: Scan) -> bool:
        """
        Take the last scan of a frame for the odd one, if the given scan continues those before it.

        Its stamp is forgotten, and it is dropped if it still waits for its pose. Returns whether
        that was so; if not, time was set back.
        """
        frame_id = scan.frame_id
        before_ns = self._before_ns.pop(frame_id, None)
        if before_ns is None or scan.stamp_ns <= before_ns:
            return False
        odd_ns = self._newest_ns[frame_id]
        self._newest_ns[frame_id] = before_ns
        reason = f'its stamp is {(odd_ns - scan.stamp_ns) / 1e9:.3f} s ahead of the next scan'
        for place, waiting in enumerate(self._scans):
            if (waiting.frame_id, waiting.stamp_ns) == (frame_id, odd_ns):
                del self._scans[place]
                self._drops.scan(waiting, 'odd_stamp', reason)
                return True
        text = f'scan at {odd_ns / 1e9:.6f} s in frame {frame_id!r}: {reason}, but it is mapped'
        self._drops.warn('odd_stamp', text)
        return True

    def fill_posed(self, number: int, config: PoseConfig) -> int:
        """Fill ``posed`` to a number of scans, if their poses are there; return its length."""
        while len(self.posed) < number and (found := self._next(config)) is not None:
            self.posed.append(found)
        return len(self.posed)

    def drop_waiting(self, cause: str, reason: str) -> None:
        """Drop every scan that waits for its pose."""
        while self._scans:
            self._drops.scan(self._scans.popleft(), cause, reason)

    def drop_all(self, cause: str, reason: str) -> None:
        """Drop every scan, with its pose or without."""
        while self.posed:
            self._drops.scan(self.posed.popleft()[0], cause, reason)
        self.drop_waiting(cause, reason)

    def forget_stamps(self) -> None:
        """Forget the newest stamps, as after time was set back."""
        self._newest_ns.clear()
        self._before_ns.clear()

    def _next(self, config: PoseConfig) -> PosedScan | None:
        """Remove the next scan whose pose is there; drop those before it that get none."""
        while self.is_open and self._scans:
            scan = self._scans[0]
            stamps = (self.newest_ns, self._poses.newest_for(scan.frame_id))
            newest_ns = max(stamp for stamp in stamps if stamp is not None)
            waited_s = (newest_ns - scan.end_ns) / 1e9
            images = self._images if waited_s <= config.max_wait_s else None
            if images is not None and images.is_waiting(scan):
                return None
            try:
                pose = self._poses.of(scan, self._scans[1] if len(self._scans) > 1 else None)
            except PoseNotYetError as error:
                if not self.ended and waited_s <= longest_wait_s(error, config):
                    return None
                within = 'until the end of the input' if self.ended else f'within {waited_s:.3f} s'
                reason = f'no pose {within}: {error}'
            except PoseError as error:
                reason = str(error)
            else:
                return self._scans.popleft(), pose
            self._drops.scan(self._scans.popleft(), 'no_pose', reason)
        return None


def longest_wait_s(error: PoseNotYetError, config: PoseConfig) -> float:
    """Return the limit of the wait of a scan whose pose is missing for this cause, s of data."""
    is_late = isinstance(error, PosesLateError)
    return max(config.max_wait_s, config.max_delay_s) if is_late else config.max_wait_s
