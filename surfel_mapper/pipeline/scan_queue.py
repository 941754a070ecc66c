# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
ScanQueue: scans that wait for their poses and images, in the order in which they came in.

A scan older than the one before it of its topic and frame is put before that, if it still waits.

Time is the stamps of the data alone, never the clock: a bag replayed at any speed waits and drops
alike. A scan whose pose cannot come any more, or did not within ``pose.max_wait_s`` of the newest
data, is dropped and counted. The wait is longer, ``pose.max_delay_s``, while the scan is newer
than all poses: these are on the way.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from surfel_mapper.config import PoseConfig
from surfel_mapper.errors import PoseError, PoseNotYetError, PosesLateError
from surfel_mapper.geometry import Transform
from surfel_mapper.pipeline.drops import Drops
from surfel_mapper.pipeline.scan_images import ScanImages
from surfel_mapper.pipeline.scan_poses import ScanPoses
from surfel_mapper.pipeline.stamp_guard import source_of
from surfel_mapper.scan import Scan

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
    max_scans : int
        See above.
    waiting : deque of Scan
        The scans that wait for their poses.
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
        self.max_scans = max_scans
        self._poses = poses
        self._images = images
        self._drops = drops
        self.waiting: deque[Scan] = deque()
        self.posed: deque[PosedScan] = deque()
        self.ended = False
        self.is_open = True

    def push(self, scan: Scan) -> None:
        """Add a scan, before newer ones of its source; beyond the limit the first is dropped."""
        newer = (
            row
            for row, other in enumerate(self.waiting)
            if other.stamp_ns > scan.stamp_ns and source_of(other) == source_of(scan)
        )
        self.waiting.insert(next(newer, len(self.waiting)), scan)
        if len(self.waiting) > self.max_scans:
            reason = f'{self.max_scans} newer scans wait for their poses'
            self._drops.scan(self.waiting.popleft(), 'queue_full', reason)

    def drop_odd(self, scan: Scan, odd_ns: int) -> None:
        """Drop the scan of a stamp ahead of the next one of its frame, if it still waits."""
        reason = f'its stamp is {(odd_ns - scan.stamp_ns) / 1e9:.3f} s ahead of the next scan'
        for row, other in enumerate(self.waiting):
            if (source_of(other), other.stamp_ns) == (source_of(scan), odd_ns):
                del self.waiting[row]
                self._drops.scan(other, 'odd_stamp', reason)
                return
        at = f'scan at {odd_ns / 1e9:.6f} s in frame {scan.frame_id!r}'
        self._drops.warn('odd_stamp', f'{at}: {reason}, but it is mapped')

    def fill_posed(
        self, number: int, newest_of: Callable[[Scan], int | None], config: PoseConfig
    ) -> int:
        """
        Fill ``posed`` to a number of scans, if their poses are there; return its length.

        Parameters
        ----------
        number : int
            Length to fill it to.
        newest_of : callable
            Returns the newest stamp of scans that tells how long a scan has waited.
        config : PoseConfig
            Longest waits.

        """
        while self.is_open and self.waiting and len(self.posed) < number:
            scan = self.waiting[0]
            pose_or_reason = self._pose_of(scan, newest_of(scan), config)
            if pose_or_reason is None:
                break
            self.waiting.popleft()
            if isinstance(pose_or_reason, str):
                self._drops.scan(scan, 'no_pose', pose_or_reason)
            else:
                self.posed.append((scan, pose_or_reason))
        return len(self.posed)

    def drop_waiting(self, cause: str, reason: str) -> None:
        """Drop every scan that waits for its pose."""
        while self.waiting:
            self._drops.scan(self.waiting.popleft(), cause, reason)

    def drop_all(self, cause: str, reason: str) -> None:
        """Drop every scan, with its pose or without."""
        while self.posed:
            self._drops.scan(self.posed.popleft()[0], cause, reason)
        self.drop_waiting(cause, reason)

    def _pose_of(
        self, scan: Scan, newest_scan_ns: int | None, config: PoseConfig
    ) -> Transform | str | None:
        """Return T_fixed_sensor, the reason why it will not come, or None while it may come."""
        stamps = (newest_scan_ns, self._poses.newest_for(scan.frame_id), scan.stamp_ns)
        newest_ns = max(stamp for stamp in stamps if stamp is not None)
        waited_s = (newest_ns - scan.end_ns) / 1e9
        images = self._images if waited_s <= config.max_wait_s else None
        if images is not None and images.is_waiting(scan):
            return None
        try:
            return self._poses.of(scan, self.waiting[1] if len(self.waiting) > 1 else None)
        except PoseNotYetError as error:
            is_late = isinstance(error, PosesLateError)
            longest_s = max(config.max_wait_s, config.max_delay_s if is_late else 0.0)
            if not self.ended and waited_s <= longest_s:
                return None
            within = 'until the end of the input' if self.ended else f'within {waited_s:.3f} s'
            return f'no pose {within}: {error}'
        except PoseError as error:
            return str(error)
