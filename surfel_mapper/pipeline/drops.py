# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Drops: scans and messages that are not used are counted by cause and frame, and logged.

A bad cable drops ten scans a second for hours; the log gets one line a second for each cause, the
counters get every drop.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import logging
import time

from surfel_mapper.counters import Counters
from surfel_mapper.errors import FilterError, MapError, one_line, PoseError, ScanRefusedError
from surfel_mapper.scan import Scan

_log = logging.getLogger(__name__)

WARN_EVERY_S = 1.0
"""Shortest time between two warnings of one cause, s; every drop is counted."""

MAX_CAUSES = 200
"""Causes whose last warning is kept; some name a frame."""

INTERNAL = 'internal_error'
"""Cause of drops by errors that no stage expects, out of memory among them."""

GATED = 'gated'
"""Cause of scans that the motion gate leaves out, which are not counted as dropped."""

CAUSES: dict[type[Exception], str] = {
    FilterError: 'filter',
    PoseError: 'no_pose',
    MapError: 'map_limit',
}
"""Cause of the drop of a scan by the type of an error; others are INTERNAL."""

REMEDIES = {
    'apart': 'it is in a map of its own; publish the pose of the robot on /initialpose',
    'empty_frame_id': 'set the frame in the driver of the sensor',
    'filter': 'compare the filters with the fields of the clouds',
    'filtered_out': 'are the limits of the filters too narrow?',
    INTERNAL: 'the map is unchanged by it and mapping goes on; please report it, unless memory is '
    'short (window.max_bytes, layers.tsdf.max_radius_m)',
    'map_limit': 'poses in UTM or ECEF need map.origin: auto; otherwise use a frame nearer to the '
    'robot, or larger voxels (map.voxel_size_m)',
    'missing_column': 'switch map.intensity or map.color off',
    'no_pose': 'compare frames.fixed, the frame of the clouds and their stamps with the data of '
    'pose.source; a sensor without a transform needs frames.base_to_sensor; '
    'pose.max_wait_s waits longer',
    'no_valid_points': 'compare input.min_range_m and input.max_range_m with the sensor',
    'odd_stamp': 'is the clock of this sensor right? input.time_offset_s corrects an offset',
    'overload': 'larger voxels (map.voxel_size_m) or a shorter range (input.max_range_m) map '
    'faster',
    'queue_full': 'poses come late; pose.max_waiting_scans lets more scans wait',
    'stamp_back': 'clouds are out of order, or two sensors share one topic and frame',
    'stamp_repeated': 'is the same cloud published twice, or header.stamp not set?',
}
"""Remedy by cause of a drop, for the log."""


def described(error: BaseException) -> str:
    """Return an error in a line: its type, and its text on one line if it has any."""
    text = one_line(' '.join(str(error).split()))
    return f'{type(error).__name__}: {text}' if text else type(error).__name__


class Drops:
    """
    Counts drops into the counters of a pipeline, and warns about them.

    Attributes
    ----------
    counters : Counters
        The counters.
    is_silent : bool
        Count without warnings.

    """

    is_silent = False

    def __init__(self, counters: Counters) -> None:
        self.counters = counters
        self._warned_s: dict[str, float] = {}

    def scan(self, scan: Scan, cause: str, reason: str) -> None:
        """Count a scan as dropped for a cause."""
        counters = self.counters
        counters.drop(cause, scan.frame_id)
        remedy = REMEDIES.get(cause)
        self.warn(
            cause,
            f'scan {f"on {scan.topic} " if scan.topic else ""}at {scan.stamp_ns / 1e9:.6f} s '
            f'in frame {scan.frame_id!r} dropped: {reason} '
            f'({counters.dropped[cause]} dropped for this cause)'
            f'{f"; {remedy}" if remedy else ""}',
        )

    def failure(self, scan: Scan, error: Exception, *, is_mapped: bool = False) -> None:
        """Count the error of a stage as the drop of a scan, unless the map has the scan."""
        cause = next((cause for kind, cause in CAUSES.items() if isinstance(error, kind)), '')
        if is_mapped:
            at = f'scan at {scan.stamp_ns / 1e9:.6f} s'
            self.message(INTERNAL, f'{at} is mapped, but not reported: {described(error)}')
        elif not isinstance(error, ScanRefusedError):
            self.scan(scan, cause or INTERNAL, str(error) if cause else described(error))
        elif error.cause == GATED:
            self.counters.gated += 1
        else:
            self.scan(scan, error.cause, str(error))
        if is_mapped or not (cause or isinstance(error, ScanRefusedError)):
            _log.debug('scan at %d ns', scan.stamp_ns, exc_info=error)

    def message(self, cause: str, reason: str, number: int = 1) -> None:
        """Count messages other than scans as ignored for a cause."""
        self.counters.messages_ignored[cause] += number
        self.warn(cause, reason)

    @contextmanager
    def guarded(self, task: str) -> Iterator[None]:
        """Count an unexpected error of a with-block as an ignored message, log it, and go on."""
        try:
            yield
        except Exception as error:  # MemoryError too
            self.message(INTERNAL, f'{task} failed: {described(error)}')
            _log.debug('%s failed', task, exc_info=True)

    def warn(self, cause: str, message: str) -> None:
        """Log a warning, unless one of the same cause was logged just before."""
        now_s = time.monotonic()
        if not self.is_silent and now_s - self._warned_s.get(cause, -WARN_EVERY_S) >= WARN_EVERY_S:
            if len(self._warned_s) >= MAX_CAUSES:
                self._warned_s.clear()
            self._warned_s[cause] = now_s
            _log.warning('%s', message)
