# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters that a robot needs beside those of libpointmatcher: its own body, range, time, labels.

Where several sensors feed one map, those with a ``sensor`` filter only the scans of its frame.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import ConfigError, FilterError
from surfel_mapper.filters.base import Filter, Mask
from surfel_mapper.filters.kernels.boxes import outside_box
from surfel_mapper.filters.limits import range_sq, rounded
from surfel_mapper.filters.parameters import parameter
from surfel_mapper.filters.registry import register
from surfel_mapper.scan import Scan

TIME_COLUMNS = ('t', 'time', 'times', 'timestamp', 'time_stamp', 'timeStamp', 'offset_time')
"""Names under which drivers give the time of a point."""


@register
@dataclass(frozen=True, slots=True, kw_only=True)
class BodyBox(Filter):
    """Drop, or keep, the points in a box along the axes of the robot (frames.base)."""

    x_min_m: float = parameter(-1.0, 'Lowest x in the frame of the robot, m.')
    x_max_m: float = parameter(1.0, 'Highest x, m.')
    y_min_m: float = parameter(-1.0, 'Lowest y, m.')
    y_max_m: float = parameter(1.0, 'Highest y, m.')
    z_min_m: float = parameter(-1.0, 'Lowest z, m.')
    z_max_m: float = parameter(1.0, 'Highest z, m.')
    remove_inside: bool = parameter(True, '1: drop what is inside; 0: keep only that.')

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay; the faces are outside, a nan is nowhere."""
        if scan.T_base_sensor is None:
            raise FilterError(
                f'the place of {scan.frame_id!r} on the robot is not known; set '
                'frames.base_to_sensor, or let /tf_static have it'
            )
        pose = np.ascontiguousarray(scan.T_base_sensor[:3], np.float64)
        low = np.array([self.x_min_m, self.y_min_m, self.z_min_m])
        high = np.array([self.x_max_m, self.y_max_m, self.z_max_m])
        is_outside = np.empty(len(scan), np.int8)
        outside_box(scan.points.T, pose, low, high, is_outside)
        return np.asarray(is_outside == int(self.remove_inside))


@register
@dataclass(frozen=True, slots=True, kw_only=True)
class RangeLimit(Filter):
    """Keep the points between two distances from the sensor; both limits stay."""

    min_m: float = parameter(0.5, 'Nearest, m.', low=0.0)
    max_m: float = parameter(100.0, 'Farthest, m.', low=0.0)
    sensor: str = parameter('', 'Only scans in this frame are filtered; empty: all.')

    def check(self) -> None:
        """Refuse an empty range."""
        if not self.min_m <= self.max_m:
            raise ConfigError(
                f'{self.name}: max_m: {self.max_m:g}, expected at least min_m ({self.min_m:g})'
            )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay; nan never does."""
        if self.sensor and self.sensor != scan.frame_id:
            return np.ones(len(scan), np.bool_)
        distance_sq = range_sq(scan.points)
        limits_sq = [limit * limit for limit in (self.min_m, self.max_m)]
        near_sq, far_sq = rounded(limits_sq, scan.points.dtype)
        return np.asarray((distance_sq >= near_sq) & (distance_sq <= far_sq))


@register
@dataclass(frozen=True, slots=True, kw_only=True)
class TimeSlice(Filter):
    """Keep the points measured from one time on until another within their scan."""

    start_s: float = parameter(0.0, 'First time that stays, s.')
    end_s: float = parameter(math.inf, 'First time that does not, s.')
    since: str = parameter(
        'first',
        'Times count from the first point of the scan, from the stamp of the scan, or as they '
        'are (zero).',
        choices=('first', 'stamp', 'zero'),
    )
    column_name: str = parameter('', 'Column of the times; empty: the first usual name found.')
    unit_s: float = parameter(
        0.0, 'Unit of the times, s; 0: whole numbers are ns, others s.', low=0.0
    )

    def check(self) -> None:
        """Refuse an empty slice."""
        if not self.start_s < self.end_s:
            raise ConfigError(
                f'{self.name}: end_s: {self.end_s:g}, expected more than start_s '
                f'({self.start_s:g})'
            )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay; those without a time do not."""
        seconds = self.seconds(scan)
        return np.asarray((seconds >= self.start_s) & (seconds < self.end_s))

    def seconds(self, scan: Scan) -> npt.NDArray[np.float64]:
        """Return the times of the points in seconds, counted from where they should."""
        names = [name for name in TIME_COLUMNS if name in scan.columns]
        times = self.column(scan, self.column_name or (names[0] if names else 'time'))
        whole = times.dtype.kind in 'iu'
        unit_s = self.unit_s or (1e-9 if whole else 1.0)
        times = times.astype(np.int64 if whole else np.float64)
        if self.since == 'first' and len(times):
            times = times - (times.min() if whole else np.nanmin(times))
        elif self.since == 'stamp':  # subtracted as integers: no float holds ns since 1970
            stamp = scan.stamp_ns if unit_s == 1e-9 else scan.stamp_ns / 1e9 / unit_s
            times = times - (round(stamp) if whole else stamp)
        return np.asarray(times * unit_s)


@register
@dataclass(frozen=True, slots=True, kw_only=True)
class LabelMask(Filter):
    """Drop, or keep, the points with certain labels."""

    labels: tuple[int, ...] = parameter((), 'The labels.', items=int)
    remove: bool = parameter(True, '1: drop the points that have one; 0: keep only those.')
    column_name: str = parameter('label', 'Column of the labels.')

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay."""
        found = self.column(scan, self.column_name)
        listed = np.zeros(len(scan), np.bool_)
        for label in self.labels:  # of few labels, a third of the time of np.isin
            listed |= found == label
        return ~listed if self.remove else listed
