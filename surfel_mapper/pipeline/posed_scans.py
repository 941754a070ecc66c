# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
PosedScans: scans whose poses are there, taken in order from the queue of those that wait.

A scan whose pose cannot come any more, or did not within ``pose.max_wait_s`` of the time of the
data, is dropped and counted.
"""

from __future__ import annotations

from collections import deque

from surfel_mapper.config import Config
from surfel_mapper.errors import PoseError, PoseNotYetError
from surfel_mapper.geometry import Transform
from surfel_mapper.pipeline.drops import Drops
from surfel_mapper.pipeline.scan_images import ScanImages
from surfel_mapper.pipeline.scan_poses import ScanPoses
from surfel_mapper.pipeline.scan_queue import ScanQueue
from surfel_mapper.scan import Scan

PosedScan = tuple[Scan, Transform]
"""A scan and its T_fixed_sensor."""


class PosedScans:
    """
    The scans that can be mapped.

    Parameters
    ----------
    config : Config
        How long poses are waited for; may be replaced.
    queue : ScanQueue
        Of the scans that wait.
    poses : ScanPoses
        Of the sensors.
    images : ScanImages
        Scans wait for theirs as well.
    drops : Drops
        Counts scans that get no pose.

    """

    def __init__(
        self, config: Config, queue: ScanQueue, poses: ScanPoses, images: ScanImages, drops: Drops
    ) -> None:
        """Have taken none."""
        self.config = config
        self._queue = queue
        self._poses = poses
        self._images = images
        self._drops = drops
        self._posed: deque[PosedScan] = deque()

    @property
    def first(self) -> PosedScan | None:
        """The one that is to be mapped next."""
        return self._posed[0] if self._posed else None

    def take(self, number: int) -> int:
        """Have so many, if so many have their poses; return how many there are."""
        while len(self._posed) < number and (found := self._next()) is not None:
            self._posed.append(found)
        return len(self._posed)

    def pop(self) -> PosedScan:
        """Remove and return the first."""
        return self._posed.popleft()

    def drop_all(self, cause: str, reason: str) -> None:
        """Drop every scan, and those that wait."""
        for scan, _ in self._posed:
            self._drops.scan(scan, cause, reason)
        self._posed.clear()
        self._queue.drop_all(cause, reason)

    def _next(self) -> PosedScan | None:
        """Take the next scan whose pose is there from the queue; drop those that get none."""
        while (scan := self._queue.first) is not None:
            waited_s = (self._now_ns() - scan.end_ns) / 1e9
            may_wait = waited_s <= self.config.pose.max_wait_s
            if may_wait and self._images.is_waiting(scan):
                return None
            try:
                pose = self._poses.of(scan, self._queue.second)
            except PoseNotYetError as error:
                if may_wait:
                    return None
                reason = f'no pose within {waited_s:.3f} s: {error}'
            except PoseError as error:
                reason = str(error)
            else:
                return self._queue.pop(), pose
            self._drops.scan(self._queue.pop(), 'no_pose', reason)
        return None

    def _now_ns(self) -> int:
        """Return the newest stamp of all data seen."""
        stamps = (self._queue.newest_ns, self._poses.transforms.newest_ns)
        return max(stamp for stamp in stamps if stamp is not None)
