# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Drops: scans and messages that are not used are counted by cause and frame, and logged.

ScanOutcome: the outcome of one scan, mapped or dropped; the log names some of them only.

A bad cable drops ten scans a second for hours; the log gets one line a second for each cause, the
counters get every drop.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
import logging
import time
from typing import Any

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


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanOutcome:
    """
    Outcome of a scan: mapped, or left out with the cause.

    Attributes
    ----------
    stamp_ns : int, optional
        Its stamp; None of a cloud that was not decoded.
    frame_id, topic : str
        Its frame and topic, as far as they are known.
    outcome : str
        ``mapped``, ``localised`` (in a frozen map), ``gated`` (left out by the motion gate) or
        ``dropped``.
    cause, reason : str
        Cause, as in the counts of the summary, and reason, if it was dropped or not reported.
    pose_source : str
        The source of its pose; empty if it was dropped before its pose was found.
    num_points : int
        Points of the scan that entered the map.
    milliseconds : mapping of str to float
        Time by stage, as far as it came.

    """

    stamp_ns: int | None
    frame_id: str
    topic: str
    outcome: str
    cause: str = ''
    reason: str = ''
    pose_source: str = ''
    num_points: int = 0
    milliseconds: Mapping[str, float] = field(default_factory=dict)


class Drops:
    """
    Counts drops into the counters of a pipeline, and warns about them.

    Attributes
    ----------
    counters : Counters
        The counters.
    outcomes : list of ScanOutcome, optional
        Outcomes of all scans, in the order of the decisions; None does not keep them.
    pose_source : str
        The source of the poses.

    """

    def __init__(self, counters: Counters, pose_source: str) -> None:
        self.counters = counters
        self.outcomes: list[ScanOutcome] | None = None
        self.pose_source = pose_source
        self._warned_s: dict[str, float] = {}

    def keep(self, scan: Scan, outcome: str, **details: Any) -> None:
        """Keep the outcome of a scan, if outcomes are kept; see ScanOutcome for the details."""
        if self.outcomes is not None:
            of_scan = {name: getattr(scan, name) for name in ('stamp_ns', 'frame_id', 'topic')}
            self.outcomes.append(ScanOutcome(**of_scan, outcome=outcome, **details))

    def clouds(self, cause: str, topic: str, reason: str, number: int, frame_id: str) -> None:
        """Count clouds as dropped that did not become scans."""
        self.counters.drop(cause, frame_id or topic, number)
        dropped = self.counters.dropped[cause]
        text = f'cloud on {topic} dropped: {reason} ({dropped} dropped for this cause)'
        self.warn(cause, text)
        if self.outcomes is not None:
            outcome = ScanOutcome(
                stamp_ns=None,
                frame_id=frame_id,
                topic=topic,
                outcome='dropped',
                cause=cause,
                reason=reason,
            )
            self.outcomes += [outcome] * number

    def scan(self, scan: Scan, cause: str, reason: str, **details: Any) -> None:
        """Count a scan as dropped for a cause; see ScanOutcome for further details."""
        self.keep(scan, 'dropped', cause=cause, reason=reason, **details)
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

    def failure(
        self,
        scan: Scan,
        error: Exception,
        milliseconds: Mapping[str, float],
        *,
        is_mapped: bool = False,
    ) -> None:
        """Count the error of a stage as the drop of a scan, unless the map has the scan."""
        cause = next((cause for kind, cause in CAUSES.items() if isinstance(error, kind)), '')
        is_refused = isinstance(error, ScanRefusedError)
        details = {'pose_source': self.pose_source, 'milliseconds': milliseconds}
        if is_mapped:
            reason = f'mapped, but not reported: {described(error)}'
            self.message(INTERNAL, f'scan at {scan.stamp_ns / 1e9:.6f} s is {reason}')
            self.keep(scan, 'mapped', cause=INTERNAL, reason=reason, **details)
        elif not isinstance(error, ScanRefusedError):
            reason = str(error) if cause else described(error)
            self.scan(scan, cause or INTERNAL, reason, **details)
        elif error.cause == GATED:
            self.counters.gated += 1
            self.keep(scan, GATED, **details)
        else:
            self.scan(scan, error.cause, str(error), **details)
        if is_mapped or not (cause or is_refused):
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
        if now_s - self._warned_s.get(cause, -WARN_EVERY_S) >= WARN_EVERY_S:
            if len(self._warned_s) >= MAX_CAUSES:
                self._warned_s.clear()
            self._warned_s[cause] = now_s
            _log.warning('%s', message)
