# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Counters of a pipeline: scans used and dropped, points left out, milliseconds by stage; their text.

Every dropped scan is counted under a cause, so that the numbers of the summary and of the
diagnostics add up: scans received = mapped + gated + localised + dropped + waiting.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np

from surfel_mapper.compilation import clock, PROGRESS

STAGES = (
    'read',
    'decode',
    'poses',
    'deskew',
    'images',
    'filter',
    'register',
    'reduce',
    'insert',
    'dynamic',
    'align',
    'tsdf',
    'models',
    'normals',
    'clocks',
    'record',
    'total',
)
"""Timed stages in the order of a scan; ``total`` is all but read, decode, clocks and record."""

LATEST = 1000
"""Number of scans whose times are kept for the percentiles."""

MOST_FRAMES = 128
"""Number of frames and topics with separate counts of drops; further ones count as OTHERS."""

MAX_NAME = 256
"""Limit of the characters of such a name; those of longer names count as OTHERS too."""

OTHERS = '(others)'


@dataclass(slots=True)
class FilterCounts:
    """Counts of a filter: points in and out, points dropped as not finite, latest times."""

    points_in: int = 0
    points_out: int = 0
    not_finite: int = 0
    milliseconds: deque[float] = field(default_factory=lambda: deque(maxlen=LATEST))


@dataclass(slots=True)
class Counters:
    """
    Counts and times of one pipeline.

    Attributes
    ----------
    received, mapped, gated, localised : int
        Scans received, added to the map, skipped by the motion gate, aligned to a frozen map
        without being added.
    evicted : Counter of str
        Scans evicted from the map, by the limit exceeded.
    voxels_cleared : Counter of str
        Voxels that layers have cleared, by layer.
    resets : int
        Number of times that the map was cleared because time went back.
    dropped : Counter of str
        Scans dropped, by cause.
    dropped_by_frame : dict of str to Counter of str
        The same by frame, or by topic if the frame could not be read.
    points : int
        Points added to the map.
    points_left_out : Counter of str
        Points not added, by cause.
    messages_ignored : Counter of str
        Other messages (transforms, odometry) not used, by cause.
    layers_off : dict of str to str
        Layers that were switched off because they failed, with the last error.
    milliseconds : dict of str to deque of float
        Times of every stage for the latest scans.
    stage_s : dict of str to float
        Sum of the times of every stage, s.
    filters : dict of str to FilterCounts
        Counts of every filter, in the order of the chain.

    """

    received: int = 0
    mapped: int = 0
    gated: int = 0
    localised: int = 0
    resets: int = 0
    points: int = 0
    evicted: Counter[str] = field(default_factory=Counter)
    voxels_cleared: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    dropped_by_frame: dict[str, Counter[str]] = field(default_factory=dict)
    points_left_out: Counter[str] = field(default_factory=Counter)
    messages_ignored: Counter[str] = field(default_factory=Counter)
    layers_off: dict[str, str] = field(default_factory=dict)
    milliseconds: dict[str, deque[float]] = field(default_factory=dict)
    stage_s: dict[str, float] = field(default_factory=dict)
    filters: dict[str, FilterCounts] = field(default_factory=dict)

    def timed(self, stage: str) -> AbstractContextManager[None]:
        """Add the time of a with-block to a stage, in milliseconds."""
        return _Timed(self, stage)

    def drop(self, cause: str, frame_id: str, number: int = 1) -> None:
        """Count scans as dropped for a cause."""
        self.dropped[cause] += number
        is_new = frame_id not in self.dropped_by_frame
        is_over = len(self.dropped_by_frame) >= MOST_FRAMES or len(frame_id) > MAX_NAME
        if is_new and is_over:
            frame_id = OTHERS
        self.dropped_by_frame.setdefault(frame_id, Counter())[cause] += number

    def add_times(self, milliseconds: Mapping[str, float]) -> None:
        """Add the times of a scan by stage."""
        for stage, time_ms in milliseconds.items():
            self.milliseconds.setdefault(stage, deque(maxlen=LATEST)).append(time_ms)
            self.stage_s[stage] = self.stage_s.get(stage, 0.0) + 1e-3 * time_ms

    def add_filter(self, step: Any) -> None:
        """Add the counts and time of a step of a chain of filters (filters.chain.Step)."""
        counts = self.filters.setdefault(step.name, FilterCounts())
        counts.points_in += step.points_in
        counts.points_out += step.points_out
        counts.not_finite += step.not_finite
        counts.milliseconds.append(step.milliseconds)

    def summary(self) -> dict[str, Any]:
        """Return all counters as plain numbers, with median and 99th percentile of the times."""
        filters = {
            name: {
                'points_in': counts.points_in,
                'points_out': counts.points_out,
                'not_finite': counts.not_finite,
                'milliseconds': percentiles(counts.milliseconds),
            }
            for name, counts in self.filters.items()
        }
        return {
            'scans': {
                'received': self.received,
                'mapped': self.mapped,
                'gated': self.gated,
                **({'localised': self.localised} if self.localised else {}),
                'evicted': dict(self.evicted),
                'dropped': dict(self.dropped),
                'dropped_by_frame': {k: dict(v) for k, v in self.dropped_by_frame.items()},
            },
            'voxels_cleared': dict(self.voxels_cleared),
            'resets': self.resets,
            'points': self.points,
            'points_left_out': dict(self.points_left_out),
            'messages_ignored': dict(self.messages_ignored),
            **({'layers_off': dict(self.layers_off)} if self.layers_off else {}),
            'milliseconds': {k: percentiles(v) for k, v in self.milliseconds.items()},
            'stage_s': {stage: round(total, 6) for stage, total in self.stage_s.items()},
            'filters': filters,
        }


class Laps:
    """
    Times of consecutive stages, without the time of kernels that were compiled meanwhile.

    Attributes
    ----------
    milliseconds : dict of str to float
        Time of every ended stage, and their ``total``.

    """

    def __init__(self) -> None:
        self._lap = perf_counter() - PROGRESS.ended_s
        self.milliseconds = {'total': 0.0}

    def end(self, stage: str) -> None:
        """End a stage and start the next."""
        stop = perf_counter() - PROGRESS.ended_s
        spent_ms = max(stop - self._lap, 0.0) * 1e3
        total_ms = self.milliseconds.pop('total') + spent_ms  # it stays the last entry
        self.milliseconds |= {stage: spent_ms, 'total': total_ms}
        self._lap = stop


def percentiles(milliseconds: deque[float]) -> dict[str, float]:
    """Return median and 99th percentile of times; the latter without the first, a cold one."""
    return {
        'median': round(float(np.median(milliseconds)), 3),
        'p99': round(float(np.percentile([*milliseconds][len(milliseconds) > 1 :], 99)), 3),
    }


class _Timed(AbstractContextManager[None]):
    """Adds the time of a with-block to a stage; a class, because it runs for every message."""

    __slots__ = ('_counters', '_stage', '_start')

    def __init__(self, counters: Counters, stage: str) -> None:
        self._counters, self._stage = counters, stage

    def __enter__(self) -> None:
        self._start = clock()

    def __exit__(self, *_: object) -> None:
        self._counters.add_times({self._stage: (clock() - self._start) * 1e3})


def decimals(value: float | None, factor: float = 1.0) -> str:
    """Return a number with three decimals, or a dash for None."""
    return '-' if value is None else f'{value * factor:.3f}'
