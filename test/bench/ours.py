# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A map and its window by direct calls, each stage timed, without Mapper."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from time import perf_counter

import numpy as np

from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.surfel_map import SurfelMap
from test.bench.numpy_map import COUNT, NumpyMap, PRODUCT, SUM, VIEW


class Ours:
    """
    A map and its window of scans.

    Parameters
    ----------
    voxel_size_m : float
        Edge of a voxel.
    window : int
        Number of scans in the window.

    """

    def __init__(self, voxel_size_m: float, window: int) -> None:
        self.map = SurfelMap(voxel_size_m)
        self.scans: deque[ScanMoments] = deque()
        self.num_changed = 0
        self._window = window

    def put(self, moments: ScanMoments, clock: Callable[[], float] = perf_counter) -> list[float]:
        """Insert a reduced scan; return the times at the end of insert, evict and derive, s."""
        version = self.map.version
        self.map.insert(moments)
        self.scans.append(moments)
        times = [clock()]
        if len(self.scans) > self._window:
            self.map.remove(self.scans.popleft())
        times.append(clock())
        changed = self.map.surfels_changed(version)
        times.append(clock())
        self.num_changed = len(changed)
        return times

    def check_equal(self, numpy_map: NumpyMap) -> None:
        """Raise an error if the map differs from that of numpy."""
        key, moments = numpy_map.state()
        expected = (key, *(moments[:, part] for part in (COUNT, SUM, PRODUCT, VIEW)))
        for ours, theirs in zip(self.map.moments().arrays, expected, strict=True):
            if not np.array_equal(ours.ravel(), theirs.ravel()):
                raise RuntimeError('numpy and surfel_mapper have different maps: one has a bug')

    @property
    def bytes_a_voxel(self) -> float:
        """Bytes of the map by voxel: rows, also free ones, and hash table."""
        return self.map.nbytes / self.map.num_voxels

    @property
    def bytes_a_scan_voxel(self) -> float:
        """Bytes of the scans in the window by voxel: moments, and the hints of their rows."""
        arrays = sum(moments.nbytes for moments in self.scans)
        rows = sum(moments.rows.nbytes for moments in self.scans if moments.rows is not None)
        return (arrays + rows) / sum(len(moments) for moments in self.scans)
