# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
History: the figures of each scan of a replay, for the plots of the report.

The figures are flat arrays, about 100 bytes a scan: 4 MB an hour at 10 Hz.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from surfel_mapper.pipeline import Mapper, Update

Array = npt.NDArray[np.float64]

FIGURES = 6
"""Figures of a scan: time after the first (s), voxels, drops, position of the sensor (m)."""


class History:
    """
    Figures of every scan that was mapped.

    Parameters
    ----------
    stamps_ns : sequence of int
    positions : (S, 3) float64, m
        Scans that other processes mapped, without their times by stage and numbers of voxels.

    Attributes
    ----------
    milliseconds : dict of str to array
        Time of each stage, one value a scan; nan for scans without the stage.

    """

    def __init__(self, stamps_ns: Sequence[int] = (), positions: Iterable[Array] = ()) -> None:
        self.milliseconds: dict[str, array[float]] = {}
        self._first_ns = stamps_ns[0] if stamps_ns else 0
        self._figures: array[float] = array('d')
        for stamp_ns, position in zip(stamps_ns, positions, strict=True):
            self._figures.extend([(stamp_ns - self._first_ns) / 1e9, np.nan, 0.0, *position])

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self._figures) // FIGURES

    def add(self, mapper: Mapper, update: Update) -> None:
        """Record the figures of a scan that was just mapped."""
        for stage in update.milliseconds.keys() - self.milliseconds.keys():
            self.milliseconds[stage] = array('d', [np.nan] * len(self))
        for stage, times in self.milliseconds.items():
            times.append(update.milliseconds.get(stage, np.nan))
        if not self._figures:
            self._first_ns = update.stamp_ns
        seconds, dropped = (update.stamp_ns - self._first_ns) / 1e9, mapper.counters.dropped
        self._figures.extend([seconds, mapper.map.num_voxels, dropped.total()])
        self._figures.extend(update.T_map_sensor[:3, 3])

    def move(self, positions: Array) -> None:
        """Take the positions (S, 3) after an alignment; after a restart they are fewer."""
        if len(positions) == len(self):
            figures = np.column_stack([self.figures[:, :3], positions])
            self._figures = array('d', figures.ravel())

    @property
    def figures(self) -> Array:
        """FIGURES of each scan, (S, 6)."""
        return np.array(self._figures, np.float64).reshape(-1, FIGURES)

    @property
    def seconds(self) -> Array:
        """Time of each scan after the first, (S,) s."""
        return self.figures[:, 0]

    @property
    def voxels(self) -> Array:
        """Number of voxels in the map after each scan, (S,)."""
        return self.figures[:, 1]

    @property
    def dropped(self) -> Array:
        """Number of scans dropped before each scan, (S,)."""
        return self.figures[:, 2]

    @property
    def trajectory(self) -> Array:
        """Position of the sensor at each scan, map frame, (S, 3) m."""
        return self.figures[:, 3:]
