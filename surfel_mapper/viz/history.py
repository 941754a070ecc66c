# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
History: the figures of each scan of a replay, for the plots of the report.

The figures are flat arrays, about 100 bytes a scan: 4 MB an hour at 10 Hz.
"""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from surfel_mapper.pipeline import Mapper, Update


class History:
    """
    Figures of every scan that was mapped.

    Attributes
    ----------
    milliseconds : dict of str to array
        Time of each stage, one value a scan; nan for scans without the stage.

    """

    def __init__(self) -> None:
        self.milliseconds: dict[str, array[float]] = {}
        self._stamps_ns: array[int] = array('q')
        self._voxels: array[int] = array('q')
        self._dropped: array[int] = array('q')
        self._positions: array[float] = array('d')

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self._stamps_ns)

    def add(self, mapper: Mapper, update: Update) -> None:
        """Record the figures of a scan that was just mapped."""
        for stage, milliseconds in update.milliseconds.items():
            if stage not in self.milliseconds:
                self.milliseconds[stage] = array('d', [np.nan] * len(self))
            self.milliseconds[stage].append(milliseconds)
        self._stamps_ns.append(update.stamp_ns)
        for times in self.milliseconds.values():
            times.extend([np.nan] * (len(self) - len(times)))
        self._voxels.append(mapper.map.num_voxels)
        self._dropped.append(mapper.counters.dropped.total())
        self._positions.extend(update.T_map_sensor[:3, 3])

    @property
    def seconds(self) -> npt.NDArray[np.float64]:
        """Time of each scan after the first, (S,) s."""
        stamps = np.array(self._stamps_ns, np.int64)
        return np.asarray((stamps - stamps[:1].sum()) / 1e9)

    @property
    def voxels(self) -> npt.NDArray[np.int64]:
        """Number of voxels in the map after each scan, (S,)."""
        return np.array(self._voxels, np.int64)

    @property
    def dropped(self) -> npt.NDArray[np.int64]:
        """Number of scans dropped before each scan, (S,)."""
        return np.array(self._dropped, np.int64)

    @property
    def trajectory(self) -> npt.NDArray[np.float64]:
        """Position of the sensor at each scan, map frame, (S, 3) m."""
        return np.array(self._positions, np.float64).reshape(-1, 3)
