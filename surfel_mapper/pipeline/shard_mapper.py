# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
ShardMapper: a Mapper that begins in the middle of a bag as if it had been there from the start.

It is fed what comes before its part too, but passes over those scans. Whether that was enough is
not hoped for: its outlook there is compared with that of the mapper which mapped the part before.
Equal outlooks mean that every later scan is mapped, or dropped, at the same pose by both.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.pipeline.mapper import Mapper
from surfel_mapper.pipeline.update import Update
from surfel_mapper.scan import Scan

SWEEP_S = 1.0
"""No point of a scan that is put straight is further from its stamp than this."""


class ShardMapper(Mapper):
    """Maps a part of a recording."""

    _passes_over = False

    def __init__(self, config: Config | None = None) -> None:
        """Make an empty map; nobody looks at its surfels until all parts are together."""
        super().__init__(config)
        self._inserter.derives = False

    @property
    def passes_over(self) -> bool:
        """Whether scans whose turn it is are left out of the map, and nothing is warned about."""
        return self._passes_over

    @passes_over.setter
    def passes_over(self, value: bool) -> None:
        self._passes_over = self._drops.is_silent = value

    def outlook(self) -> str:
        """
        Return a hash of all that decides about later scans, beside the settings.

        That is which stamps are still to be expected, the scans that wait, and the transforms
        from the oldest stamp on that can be asked for without time being set back.
        """
        stamps, waiting = self._queue.stamps, self._queue.waiting
        expected = [*stamps.values(), *(stamp_ns for _, stamp_ns in waiting)]
        since_ns = None
        if expected:
            back_ns = round(self.config.input.reset_after_s * 1e9)
            since_ns = min(*expected, max(expected) - back_ns) - round(sweep_s(self.config) * 1e9)
        state = [sorted(stamps.items()), waiting, self.transforms.held(since_ns)]
        return hashlib.sha256(repr(state).encode()).hexdigest()

    def _insert(self, scan: Scan, pose: npt.NDArray[np.float64]) -> Update | None:
        """Map a scan, unless scans are passed over."""
        return None if self._passes_over else super()._insert(scan, pose)


def sweep_s(config: Config) -> float:
    """Return how far from its stamp a pose may be needed for a scan, s."""
    return SWEEP_S if config.deskew.enabled else 0.0


def is_divisible(config: Config) -> bool:
    """
    Return whether what becomes of a scan depends on its surroundings alone.

    With poses from registration, alignment of the window, or a motion gate it depends on the map
    and on all scans before: then a recording can only be mapped in one go.
    """
    settings: dict[str, Any] = config.to_mapping()
    neutral = {
        'window.gate_distance_m': 0.0,
        'window.gate_angle_deg': 0.0,
        'align.every_scans': 0,
    }
    return config.pose.source != 'registration' and all(
        settings[name] == value for name, value in neutral.items()
    )
