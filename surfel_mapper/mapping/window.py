# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
SlidingWindow: which scans a map holds, and which leave it when a new one comes.

The window keeps the moments of every scan; a scan that leaves is subtracted from the map, so
the map is at any time the sum of the scans in the window, to the bit. A new scan is added
before old ones leave, so that a voxel seen by both never comes and goes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import WindowConfig
from surfel_mapper.errors import MapError
from surfel_mapper.mapping.moments import unpack_keys
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.windowed_scan import WindowedScan as WindowedScan  # handed on
from surfel_mapper.mapping.windowed_scan import without


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Eviction:
    """
    A scan that left the window.

    Attributes
    ----------
    scan : WindowedScan
    limit : str
        The limit that it had reached: max_scans, max_age_s, max_distance_m, max_bytes or
        max_voxels.
    fallen : (E, 3) int32
        Indices of the voxels that fell below the number of points that makes a surfel.

    """

    scan: WindowedScan
    limit: str
    fallen: npt.NDArray[np.int32]


class SlidingWindow:
    """
    The scans of a map, oldest first.

    Parameters
    ----------
    surfel_map : SurfelMap
        Scans are added to it and removed from it by the window alone.
    config : WindowConfig, optional
        The limits; may be replaced at any time and hold from the next scan on.
    max_voxels : int
        The oldest scans leave while the map holds more voxels; 0: no such limit.

    """

    def __init__(
        self,
        surfel_map: SurfelMap,
        config: WindowConfig | None = None,
        *,
        max_voxels: int = 0,
    ) -> None:
        """Make an empty window."""
        self.config = config or WindowConfig()
        self.max_voxels = max_voxels
        self._map = surfel_map
        self._scans: deque[tuple[WindowedScan, float]] = deque()
        self._forget()

    def _forget(self) -> None:
        self._scans.clear()
        self._num_settled = 0
        self._travelled_m = 0.0
        self._nbytes = 0

    def __len__(self) -> int:
        """Return the number of scans that the map holds."""
        return self._num_settled + len(self._scans)

    def __iter__(self) -> Iterator[WindowedScan]:
        """Iterate over the scans that are kept, oldest first; see ``insert``."""
        return (scan for scan, _ in self._scans)

    @property
    def nbytes(self) -> int:
        """Bytes of the scans that are kept."""
        return self._nbytes

    @property
    def newest(self) -> WindowedScan | None:
        """The scan added last."""
        return self._scans[-1][0] if self._scans else None

    def insert(self, scan: WindowedScan, min_points: int = 1) -> list[Eviction]:
        """
        Add a scan to the map and remove those that are beyond a limit now.

        The newest scan stays, whatever the limits are. Without any limit no scan will leave;
        then, unless points are to be kept, only the newest is kept, and memory does not grow
        with the number of scans.

        Parameters
        ----------
        scan : WindowedScan
            The newest scan.
        min_points : int
            From how many points on a voxel counts as a surfel, for what an eviction states.

        Raises
        ------
        MapError
            If the map refuses the scan; nothing has changed then.

        """
        self._map.insert(scan.moments)
        self._append(scan)
        evicted = []
        while len(self._scans) > 1 and (limit := self._limit_reached()):
            evicted.append(self._evict(limit, min_points))
        while len(self._scans) > 1 and self._keeps_nothing:
            self._nbytes -= self._scans.popleft()[0].nbytes
            self._num_settled += 1
        return evicted

    def restore(self, scans: Iterable[WindowedScan]) -> None:
        """
        Take scans that the map holds already, oldest first, as a saved window.

        Raises
        ------
        ValueError
            If there are scans in the window.

        """
        if self._scans:
            raise ValueError(f'{len(self._scans)} scans in the window, expected none')
        for scan in scans:
            self._append(scan)

    def drop_voxels(
        self, voxel_index: npt.NDArray[Any], min_points: int = 1
    ) -> npt.NDArray[np.int32]:
        """
        Empty voxels of the map, and take them out of the scans, so that these leave exactly.

        Points that are kept go with their voxels.

        Parameters
        ----------
        voxel_index : (K, 3) int
            The voxels; those that the map does not hold are passed over.
        min_points : int
            From how many points on a voxel counts for the result.

        Returns
        -------
        (E, 3) int32
            Indices of the voxels that held ``min_points`` and are empty now.

        """
        held = self._map.moments(voxel_index)
        if not len(held):
            return np.empty((0, 3), np.int32)
        fallen = self._map.remove(held, min_points)
        self._scans = deque((without(scan, held.key), m) for scan, m in self._scans)
        self._nbytes = sum(scan.nbytes for scan in self)
        return fallen

    def move(
        self, scans: Mapping[int, WindowedScan], min_points: int = 1
    ) -> npt.NDArray[np.int32]:
        """
        Move scans: remove them where they are, add them where they are to be.

        Parameters
        ----------
        scans : mapping of int to WindowedScan
            Places in the window, counted from the oldest scan that is kept, and what is to be
            there: the same scan with the moments that it has at another pose.
        min_points : int
            From how many points on a voxel counts for the result.

        Returns
        -------
        (E, 3) int32
            Indices of the voxels that held ``min_points`` before and hold fewer now.

        Raises
        ------
        MapError
            If the map refuses a scan; nothing has changed then.

        """
        old = list(self)
        left = np.concatenate([np.empty(0, np.int64), *(old[p].moments.key for p in scans)])
        full = self._full(left, min_points)
        done: list[int] = []
        try:
            for place, scan in scans.items():
                self._map.insert(scan.moments)
                self._map.remove(old[place].moments)
                done.append(place)
        except MapError:
            for place in done:
                self._map.insert(old[place].moments)
                self._map.remove(scans[place].moments)
            raise
        travelled_m = self._scans[0][1] if self._scans else 0.0
        self._scans.clear()
        self._nbytes, self._travelled_m = 0, travelled_m
        for place, scan in enumerate(old):
            self._append(scans.get(place, scan))
        return unpack_keys(np.setdiff1d(full, self._full(left, min_points)))

    def _full(self, keys: npt.NDArray[np.int64], min_points: int) -> npt.NDArray[np.int64]:
        """Return the keys of those of some voxels that hold enough points."""
        held = self._map.moments(unpack_keys(keys))
        return held.key[held.count >= min_points]

    def clear(self) -> None:
        """Forget all scans and clear the map."""
        self._forget()
        self._map.clear()

    def _append(self, scan: WindowedScan) -> None:
        if self._scans:
            step = scan.T_map_sensor[:3, 3] - self._scans[-1][0].T_map_sensor[:3, 3]
            self._travelled_m += float(np.sqrt((step * step).sum()))
        self._scans.append((scan, self._travelled_m))
        self._nbytes += scan.nbytes

    @property
    def _keeps_nothing(self) -> bool:
        """Whether no scan can leave and none is wanted for anything else."""
        config = self.config
        limits = (config.max_scans, config.max_age_s, config.max_distance_m, config.max_bytes)
        return not (any(limits) or self.max_voxels or config.keep_points)

    def _evict(self, limit: str, min_points: int) -> Eviction:
        scan, _ = self._scans[0]
        fallen = self._map.remove(scan.moments, min_points)
        self._scans.popleft()
        self._nbytes -= scan.nbytes
        return Eviction(scan=scan, limit=limit, fallen=fallen)

    def _limit_reached(self) -> str:
        """Return the name of a limit that the oldest scan is beyond, or an empty string."""
        config = self.config
        (oldest, travelled_m), (newest, _) = self._scans[0], self._scans[-1]
        age_ns = newest.stamp_ns - oldest.stamp_ns
        limits = {
            'max_scans': (len(self._scans), config.max_scans),
            'max_age_s': (age_ns, round(config.max_age_s * 1e9)),
            'max_distance_m': (self._travelled_m - travelled_m, config.max_distance_m),
            'max_bytes': (self._nbytes, config.max_bytes),
            'max_voxels': (self._map.num_voxels, self.max_voxels),
        }
        reached = (name for name, (value, limit) in limits.items() if 0 < limit < value)
        return next(reached, '')
