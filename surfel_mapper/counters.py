# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What happened so far: scans used and dropped, points left out, milliseconds by stage.

Everything that is dropped is counted here under a cause, so that the numbers of the summary and
of the diagnostics add up: scans received = mapped + gated + dropped + waiting.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
import time
from typing import Any

import numpy as np

LATEST = 1000
"""Times of so many scans are kept for the percentiles."""


@dataclass(slots=True)
class Counters:
    """
    Counts and times of one pipeline.

    Attributes
    ----------
    received, mapped, gated : int
        Scans that came in, entered the map, were left out by the motion gate.
    evicted : Counter of str
        Scans that left the map again, by the limit reached.
    resets : int
        How often the map was cleared because time went back.
    dropped : Counter of str
        Scans dropped, by cause.
    points : int
        Points that entered the map.
    points_left_out : Counter of str
        Points that did not, by cause.
    messages_ignored : Counter of str
        Other messages (transforms, odometry) not used, by cause.
    milliseconds : dict of str to deque of float
        Time of every stage for the latest scans.

    """

    received: int = 0
    mapped: int = 0
    gated: int = 0
    resets: int = 0
    points: int = 0
    evicted: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    points_left_out: Counter[str] = field(default_factory=Counter)
    messages_ignored: Counter[str] = field(default_factory=Counter)
    milliseconds: dict[str, deque[float]] = field(default_factory=dict)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time of a with-block to a stage, in milliseconds."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.add_time(stage, (time.perf_counter() - start) * 1e3)

    def add_time(self, stage: str, milliseconds: float) -> None:
        """Add the time that one scan spent in a stage."""
        self.milliseconds.setdefault(stage, deque(maxlen=LATEST)).append(milliseconds)

    def summary(self) -> dict[str, Any]:
        """Return everything as plain numbers, with median and 99th percentile of the times."""
        times = {
            stage: {
                'median': round(float(np.median(values)), 3),
                'p99': round(float(np.percentile(values, 99)), 3),
            }
            for stage, values in self.milliseconds.items()
        }
        return {
            'scans': {
                'received': self.received,
                'mapped': self.mapped,
                'gated': self.gated,
                'evicted': dict(self.evicted),
                'dropped': dict(self.dropped),
            },
            'resets': self.resets,
            'points': self.points,
            'points_left_out': dict(self.points_left_out),
            'messages_ignored': dict(self.messages_ignored),
            'milliseconds': times,
        }
