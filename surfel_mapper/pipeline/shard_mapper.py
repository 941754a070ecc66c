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

from surfel_mapper.config import Config
from surfel_mapper.pipeline.mapper import Mapper
from surfel_mapper.pipeline.update import Update

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
        self._passes_over = self._pipeline.drops.is_silent = value

    def outlook(self) -> str:
        """
        Return a hash of the state on which the fate of later scans depends, beside the settings.

        These are the newest stamps, the scans that wait, and the transforms from the oldest stamp
        on that can be looked up without time being set back.
        """
        guard, queue = self._pipeline.guard, self._pipeline.queue
        waiting = [(scan.frame_id, scan.stamp_ns) for scan in queue.waiting]
        stamps = guard.scan_stamps
        expected = [stamp_ns for _, stamp_ns in (*stamps, *waiting)]
        since_ns = None
        if expected:
            back_ns = round(self.config.input.reset_after_s * 1e9)
            since_ns = min(*expected, max(expected) - back_ns) - round(sweep_s(self.config) * 1e9)
        state = [guard.state(), waiting, self.transforms.content(since_ns)]
        return hashlib.sha256(repr(state).encode()).hexdigest()

    def insert_ready(self, *, more_follows: bool = False) -> Iterator[Update]:
        """Map the scans that are ready, unless scans are passed over; see Mapper."""
        if not self._passes_over:
            return super().insert_ready(more_follows=more_follows)
        self._pipeline.pass_over()
        return iter(())


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
