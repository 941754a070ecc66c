# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
ShardMapper: a Mapper of a part of a bag that continues exactly after the part before it.

It is fed with the messages before its part too, but passes over those scans. Its outlook at the
start of the part is compared with that of the mapper of the part before: if the outlooks are
equal, both would map or drop every later scan alike, at the same pose.
"""

from __future__ import annotations

from collections.abc import Iterator
import hashlib
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.pipeline.mapper import Mapper
from surfel_mapper.pipeline.update import Update
from surfel_mapper.scan import Scan

SWEEP_S = 1.0
"""Largest time of a point from the stamp of its scan with deskewing, s."""


class ShardMapper(Mapper):
    """Maps a part of a recording."""

    _passes_over = False

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        self.derives = False  # surfels are derived when all parts are merged

    @property
    def passes_over(self) -> bool:
        """Whether scans are left out of the map, and warnings are not logged."""
        return self._passes_over

    @passes_over.setter
    def passes_over(self, value: bool) -> None:
        self._passes_over = self._drops.is_silent = value

    def outlook(self) -> str:
        """
        Return a hash of the state on which the fate of later scans depends, beside the settings.

        These are the newest stamps, the scans that wait, and the transforms from the oldest stamp
        on that can be looked up without time being set back.
        """
        stamps, waiting = self._queue.stamps, self._queue.waiting
        expected = [*stamps.values(), *(stamp_ns for _, stamp_ns in waiting)]
        since_ns = None
        if expected:
            back_ns = round(self.config.input.reset_after_s * 1e9)
            since_ns = min(*expected, max(expected) - back_ns) - round(sweep_s(self.config) * 1e9)
        state = [
            sorted(stamps.items()),
            waiting,
            self._guard.newest_ns,
            self._guard.held_ns,
            self._guard.ahead_ns,
            self.transforms.held(since_ns),
        ]
        return hashlib.sha256(repr(state).encode()).hexdigest()

    def _insert(self, scan: Scan, pose: npt.NDArray[np.float64]) -> Iterator[Update]:
        """Map a scan, unless scans are passed over."""
        return iter(()) if self._passes_over else super()._insert(scan, pose)


def sweep_s(config: Config) -> float:
    """Return the largest time from its stamp at which a scan needs a pose, s."""
    return SWEEP_S if config.deskew.enabled else 0.0


def is_divisible(config: Config) -> bool:
    """
    Return whether a recording can be mapped in parts.

    With poses from registration, alignment of the window, a motion gate, or clearing of moving
    objects a scan depends on the map and on all scans before it; then the recording can only be
    mapped in one go.
    """
    settings: dict[str, Any] = config.to_mapping()
    neutral = {
        'window.gate_distance_m': 0.0,
        'window.gate_angle_deg': 0.0,
        'align.every_scans': 0,
        'dynamic.clear': False,
    }
    return config.pose.source != 'registration' and all(
        settings[name] == value for name, value in neutral.items()
    )
