# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What is left out: every drop is counted by cause and frame; the log hears of it now and then.

A bad cable drops ten scans a second for hours; a line a second for each cause is enough to see
it, and the counts tell the rest.
"""

from __future__ import annotations

import logging
import time

from surfel_mapper.counters import Counters
from surfel_mapper.scan import Scan

_log = logging.getLogger(__name__)

WARN_EVERY_S = 1.0
"""A warning of one cause is logged at most this often; all are counted."""

REMEDIES = {
    'bad_cloud': 'the log says what is wrong with them',
    'empty_frame_id': 'set the frame in the driver of the sensor',
    'filter': 'compare the filters with the fields of the clouds',
    'filtered_out': 'are the limits of the filters too narrow?',
    'map_limit': 'use a frame nearer to the robot, or larger voxels (map.voxel_size_m)',
    'missing_column': 'switch map.intensity or map.color off',
    'no_pose': 'compare frames.fixed and the frame of the clouds with what pose.source gives, '
    'and its stamps with theirs; a sensor that no transform places needs frames.base_to_sensor; '
    'pose.max_wait_s waits longer',
    'no_valid_points': 'compare input.min_range_m and input.max_range_m with the sensor',
    'overload': 'larger voxels (map.voxel_size_m) or a shorter range (input.max_range_m) map '
    'faster',
    'queue_full': 'poses come late; pose.max_waiting_scans lets more scans wait',
    'stamp_back': 'do two sensors share one frame?',
    'stamp_repeated': 'does somebody publish the same clouds twice?',
    'too_many_frames': 'give every sensor one frame for good',
}
"""What to do about scans that are dropped, by cause."""


class Drops:
    """
    Counts what is left out into the counters of a pipeline, and warns about it.

    Attributes
    ----------
    is_silent : bool
        Whether it only counts.
    topics : dict of str to str
        Where the scans of a frame come from, for the log.

    """

    is_silent = False

    def __init__(self, counters: Counters) -> None:
        """Count into these counters."""
        self.topics: dict[str, str] = {}
        self._counters = counters
        self._warned_s: dict[str, float] = {}

    def scan(self, scan: Scan, cause: str, reason: str) -> None:
        """Count a scan as dropped for a cause."""
        counters = self._counters
        counters.drop(cause, scan.frame_id)
        topic, remedy = self.topics.get(scan.frame_id), REMEDIES.get(cause)
        self.warn(
            cause,
            f'scan {f"on {topic} " if topic else ""}at {scan.stamp_ns / 1e9:.6f} s '
            f'in frame {scan.frame_id!r} dropped: {reason} '
            f'({counters.dropped[cause]} dropped for this cause)'
            f'{f"; {remedy}" if remedy else ""}',
        )

    def message(self, cause: str, reason: str, number: int = 1) -> None:
        """Count messages that are no scans as not used for a cause."""
        self._counters.messages_ignored[cause] += number
        self.warn(cause, reason)

    def warn(self, cause: str, message: str) -> None:
        """Log a warning, unless one of the same cause was logged just before."""
        now_s = time.monotonic()
        if not self.is_silent and now_s - self._warned_s.get(cause, -WARN_EVERY_S) >= WARN_EVERY_S:
            self._warned_s[cause] = now_s
            _log.warning('%s', message)
