# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What happened so far: scans used and dropped, points left out, milliseconds by stage.

Everything that is dropped is counted here under a cause, so that the numbers of the summary and
of the diagnostics add up: scans received = mapped + gated + localised + dropped + waiting.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
import time
from typing import Any

import numpy as np

STAGES = (
    'decode',
    'deskew',
    'images',
    'filter',
    'register',
    'reduce',
    'insert',
    'clear',
    'align',
    'normals',
    'tsdf',
    'models',
    'total',
)
"""What is timed, in the order in which a scan goes through it; ``total``: all but decoding."""

LATEST = 1000
"""Times of so many scans are kept for the percentiles."""

MOST_FRAMES = 128
"""Drops of so many frames and topics are told apart; those of all further ones are OTHERS."""

OTHERS = '(others)'


@dataclass(slots=True)
class FilterCounts:
    """What one filter of the chain did so far: points in and out, its latest times."""

    points_in: int = 0
    points_out: int = 0
    milliseconds: deque[float] = field(default_factory=lambda: deque(maxlen=LATEST))


@dataclass(slots=True)
class Counters:
    """
    Counts and times of one pipeline.

    Attributes
    ----------
    received, mapped, gated, localised : int
        Scans that came in, entered the map, were left out by the motion gate, were only aligned
        to a frozen map.
    evicted : Counter of str
        Scans that left the map again, by the limit reached.
    cleared_voxels : int
        Voxels emptied because scans see through them.
    resets : int
        How often the map was cleared because time went back.
    dropped : Counter of str
        Scans dropped, by cause.
    dropped_by_frame : dict of str to Counter of str
        The same by frame; by topic, where the frame could not be read.
    points : int
        Points that entered the map.
    points_left_out : Counter of str
        Points that did not, by cause.
    messages_ignored : Counter of str
        Other messages (transforms, odometry) not used, by cause.
    milliseconds : dict of str to deque of float
        Time of every stage for the latest scans.
    filters : dict of str to FilterCounts
        The same by filter, in the order of the chain.

    """

    received: int = 0
    mapped: int = 0
    gated: int = 0
    localised: int = 0
    cleared_voxels: int = 0
    resets: int = 0
    points: int = 0
    evicted: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    dropped_by_frame: dict[str, Counter[str]] = field(default_factory=dict)
    points_left_out: Counter[str] = field(default_factory=Counter)
    messages_ignored: Counter[str] = field(default_factory=Counter)
    milliseconds: dict[str, deque[float]] = field(default_factory=dict)
    filters: dict[str, FilterCounts] = field(default_factory=dict)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time of a with-block to a stage, in milliseconds."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.add_time(stage, (time.perf_counter() - start) * 1e3)

    def drop(self, cause: str, frame_id: str, number: int = 1) -> None:
        """Count scans as dropped for a cause."""
        self.dropped[cause] += number
        is_new = frame_id not in self.dropped_by_frame
        if is_new and len(self.dropped_by_frame) >= MOST_FRAMES:
            frame_id = OTHERS
        self.dropped_by_frame.setdefault(frame_id, Counter())[cause] += number

    def add_time(self, stage: str, milliseconds: float) -> None:
        """Add the time that one scan spent in a stage."""
        self.milliseconds.setdefault(stage, deque(maxlen=LATEST)).append(milliseconds)

    def add_filter(self, name: str, points_in: int, points_out: int, milliseconds: float) -> None:
        """Add what one filter did to one scan."""
        counts = self.filters.setdefault(name, FilterCounts())
        counts.points_in += points_in
        counts.points_out += points_out
        counts.milliseconds.append(milliseconds)

    def summary(self) -> dict[str, Any]:
        """Return everything as plain numbers, with median and 99th percentile of the times."""
        filters = {
            name: {
                'points_in': counts.points_in,
                'points_out': counts.points_out,
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
            'cleared_voxels': self.cleared_voxels,
            'resets': self.resets,
            'points': self.points,
            'points_left_out': dict(self.points_left_out),
            'messages_ignored': dict(self.messages_ignored),
            'milliseconds': {k: percentiles(v) for k, v in self.milliseconds.items()},
            'filters': filters,
        }


class Laps:
    """The times of stages that follow each other."""

    def __init__(self) -> None:
        """Start the first stage."""
        self._start = self._lap = time.perf_counter()
        self._stages: dict[str, float] = {}

    def end(self, stage: str) -> None:
        """End a stage and start the next."""
        now = time.perf_counter()
        self._stages[stage] = (now - self._lap) * 1e3
        self._lap = now

    @property
    def milliseconds(self) -> dict[str, float]:
        """Return the time of every stage that has ended, and ``total``, that of all."""
        return {**self._stages, 'total': (self._lap - self._start) * 1e3}


def percentiles(milliseconds: deque[float]) -> dict[str, float]:
    """Return median and 99th percentile of times."""
    return {
        'median': round(float(np.median(milliseconds)), 3),
        'p99': round(float(np.percentile(milliseconds, 99)), 3),
    }
