# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
SlidingWindow: the scans that a map holds, and the limits that evict the oldest.

The window keeps the moments of every scan; an evicted scan is subtracted from the map, so the map
equals the sum of the scans in the window at any time, to the bit. A new scan is added before old
ones are evicted, so that a voxel observed by both is not removed and created again.

Distances are measured between scans of one frame (Travel); alignment and loops measure theirs so
too.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_whole, check_kind, Record
from surfel_mapper.config import settings_of, WindowConfig
from surfel_mapper.errors import counted
from surfel_mapper.mapping.moments import point_keys, ScanMoments, unpack_keys
from surfel_mapper.mapping.surfel_map import SurfelMap


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class WindowedScan(Record):
    """
    A scan in the window.

    Attributes
    ----------
    moments : ScanMoments
        Its moments, which the map holds.
    stamp_ns : int
        Time of the scan.
    T_map_sensor : (4, 4) float64
        The pose at which it was added.
    points : (N, 3) float32 or float64, m, optional
        Its points in the sensor frame, if kept: the points of the moments, no others.
    columns : mapping of str to (N,) array
        Columns of these points that the map sums.
    frame_id : str
        The frame of its sensor; distances travelled are those of scans of one frame.

    """

    moments: ScanMoments
    stamp_ns: int
    T_map_sensor: npt.NDArray[np.float64]
    points: npt.NDArray[Any] | None = None
    columns: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)
    frame_id: str = ''

    def __post_init__(self) -> None:
        """Refuse what would fail only after the map has the scan."""
        if not isinstance(self.moments, ScanMoments):
            check_kind('moments', self.moments, ScanMoments)
        if isinstance(self.stamp_ns, bool) or not isinstance(self.stamp_ns, (int, np.integer)):
            raise ValueError(f'stamp_ns: {self.stamp_ns!r}, expected whole nanoseconds as an int')
        if np.shape(self.T_map_sensor) != (4, 4):
            raise ValueError(f'T_map_sensor: shape {np.shape(self.T_map_sensor)}, expected (4, 4)')

    @property
    def nbytes(self) -> int:
        """Size of moments, points and columns, bytes."""
        num_bytes = self.moments.nbytes + (0 if self.points is None else self.points.nbytes)
        for column in self.columns.values():
            num_bytes += column.nbytes
        return num_bytes


VOXEL_BYTES = 132
"""A row of a voxel with its stamp and number of scans, 104 bytes, its share of free rows and of
the hash table."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Eviction(Record):
    """
    A scan that was evicted from the window.

    Attributes
    ----------
    scan : WindowedScan
    limit : str
        Name in LIMITS of the limit that it exceeded.
    fallen : (E, 3) int32
        Indices of the voxels that fell below min_points, the number of points of a surfel.

    """

    scan: WindowedScan
    limit: str
    fallen: npt.NDArray[np.int32]


class Travel:
    """
    The path of sensors, each measured between its own scans.

    Sensors that are mounted apart do not travel from one to the other.

    Parameters
    ----------
    travelled_m : float
        Path until the first scan, m.

    Attributes
    ----------
    travelled_m : float
        Path of the sensor that travelled farthest, m.

    """

    def __init__(self, travelled_m: float = 0.0) -> None:
        self.travelled_m = travelled_m
        self._last: dict[str, tuple[npt.NDArray[np.float64], float]] = {}

    def add(self, frame_id: str, T_map_sensor: npt.NDArray[np.float64]) -> float:
        """Add the pose (4, 4) of a scan of a frame; return the path until then, m."""
        own_m = self.travelled_m
        if frame_id in self._last:
            T_map_last, own_m = self._last[frame_id]
            step = T_map_sensor[:3, 3] - T_map_last[:3, 3]
            own_m += float(np.sqrt((step * step).sum()))
        self._last[frame_id] = T_map_sensor, own_m
        self.travelled_m = max(self.travelled_m, own_m)
        return self.travelled_m

    def last_pose(self, frame_id: str) -> npt.NDArray[np.float64] | None:
        """Return the pose (4, 4) of a frame added last, None without any."""
        last = self._last.get(frame_id)
        return None if last is None else last[0]


class SlidingWindow:
    """
    The scans of a map, oldest first.

    Parameters
    ----------
    surfel_map : SurfelMap
        The map; only the window may add scans to it and remove them.
    config : WindowConfig, optional
        The limits; may be replaced at any time and apply from the next scan on.
    max_voxels : int
        Scans are evicted while the map holds more voxels; 0 means no such limit.

    Attributes
    ----------
    max_total_bytes : int
        Scans are evicted while the voxels and the kept scans need more bytes; 0 means no such
        limit.

    Examples
    --------
    >>> import numpy as np
    >>> from surfel_mapper import SurfelMap
    >>> from surfel_mapper.config import WindowConfig
    >>> surfel_map = SurfelMap(0.5)
    >>> window = SlidingWindow(surfel_map, WindowConfig(max_scans=2))
    >>> for second in range(3):
    ...     moments = surfel_map.reduce(np.full((10, 3), float(second)))
    ...     evictions = window.insert(
    ...         WindowedScan(moments=moments, stamp_ns=second * 10**9, T_map_sensor=np.eye(4))
    ...     )
    >>> window, len(evictions), surfel_map.num_points
    (SlidingWindow(2 scans), 1, 20)

    """

    def __init__(
        self,
        surfel_map: SurfelMap,
        config: WindowConfig | None = None,
        *,
        max_voxels: int = 0,
    ) -> None:
        check_kind('surfel_map', surfel_map, SurfelMap)
        if config is not None:
            check_kind('config', config, WindowConfig, hint='WindowConfig(max_scans=100)')
        self.config = config or WindowConfig()
        self.max_voxels = as_whole('max_voxels', max_voxels)
        self.max_total_bytes = 0
        self._map = surfel_map
        self._scans: deque[tuple[WindowedScan, float]] = deque()
        self._reset()

    def __repr__(self) -> str:
        """Return the number of scans."""
        return f'SlidingWindow({counted(len(self), "scan")})'

    def _reset(self) -> None:
        self._scans.clear()
        self._travel = Travel()
        self._num_settled = 0
        self._nbytes = 0

    def __len__(self) -> int:
        """Return the number of scans that the map holds."""
        return self._num_settled + len(self._scans)

    def __iter__(self) -> Iterator[WindowedScan]:
        """Iterate over the kept scans, oldest first; see ``insert``."""
        return (scan for scan, _ in self._scans)

    @property
    def nbytes(self) -> int:
        """Size of the kept scans, bytes."""
        return self._nbytes

    @property
    def newest(self) -> WindowedScan | None:
        """The scan added last, None if empty."""
        return self._scans[-1][0] if self._scans else None

    def last_pose(self, frame_id: str) -> npt.NDArray[np.float64] | None:
        """
        Return the pose (4, 4) of the scan of a frame added last, whether it was evicted or not.

        None if no scan of the frame was added since the window was cleared or restored. After
        ``move`` the kept scans alone count, as evicted ones have no pose that fits the others.
        """
        return self._travel.last_pose(frame_id)

    def insert(self, scan: WindowedScan, min_points: int = 1) -> list[Eviction]:
        """
        Add a scan to the map and evict the scans that exceed a limit.

        The newest scan always stays. Without any limit no scan is evicted. Then,
        unless ``keep_points`` is set, only the newest scan is kept, and memory does not grow with
        the number of scans.

        Parameters
        ----------
        scan : WindowedScan
            The newest scan.
        min_points : int
            Number of points of a surfel, for ``Eviction.fallen``.

        Raises
        ------
        MapError
            If the map refuses the scan; nothing is changed.

        """
        if not isinstance(scan, WindowedScan):
            check_kind('scan', scan, WindowedScan)
        if type(min_points) is not int:
            min_points = as_whole('min_points', min_points)
        self._map.insert(scan.moments)
        self._append(scan)
        evicted, limits = [], self._limits()
        while len(self._scans) > 1 and (limit := self._limit_reached(limits)):
            oldest, _ = self._scans[0]
            fallen = self._map.remove(oldest.moments, min_points)
            self._scans.popleft()
            self._nbytes -= oldest.nbytes
            evicted.append(Eviction(scan=oldest, limit=limit, fallen=fallen))
        while len(self._scans) > 1 and not (limits or self.config.keep_points):
            self._nbytes -= self._scans.popleft()[0].nbytes
            self._num_settled += 1
        return evicted

    def restore(self, scans: Iterable[WindowedScan]) -> None:
        """
        Restore the scans of a saved window, oldest first, which the map already holds.

        Distances are measured from these scans on. Scans without a frame, of files that do not
        have it, count as those of one sensor.

        Raises
        ------
        ValueError
            If the window is not empty.

        """
        if self._scans:
            raise ValueError(f'{len(self._scans)} scans in the window, expected none')
        for scan in checked_scans(scans):
            self._append(scan)

    def drop_voxels(
        self, voxel_index: npt.NDArray[Any], min_points: int = 1
    ) -> npt.NDArray[np.int32]:
        """
        Remove voxels from the map and from the scans, so that evictions stay exact.

        Kept points in these voxels are removed too.

        Parameters
        ----------
        voxel_index : (K, 3) int
            The voxels; those that the map does not contain are ignored.
        min_points : int
            Number of points of a surfel, for the result.

        Returns
        -------
        (E, 3) int32
            Indices of the voxels that held at least ``min_points`` and are empty now.

        """
        min_points = as_whole('min_points', min_points)
        moments = self._map.moments(voxel_index)
        if not len(moments):
            return np.empty((0, 3), np.int32)
        scans = deque((without(scan, moments.key), m) for scan, m in self._scans)
        nbytes = sum(scan.nbytes for scan, _ in scans)
        fallen = self._map.remove(moments, min_points)  # last: copies of scans can lack memory
        self._scans, self._nbytes = scans, nbytes
        return fallen

    def move(
        self, scans: Mapping[int, WindowedScan], min_points: int = 1
    ) -> npt.NDArray[np.int32]:
        """
        Move scans to other poses: replace their moments in the map.

        Parameters
        ----------
        scans : mapping of int to WindowedScan
            Position in the window, counted from the oldest kept scan, and the same scan with its
            moments at another pose.
        min_points : int
            Number of points of a surfel, for the result.

        Returns
        -------
        (E, 3) int32
            Indices of the voxels that held at least ``min_points`` before and hold fewer now.

        Raises
        ------
        IndexError
            If there is no kept scan at a position.
        MapError
            If the map refuses a scan; nothing is changed in either case.

        """
        check_kind('scans', scans, Mapping)
        min_points = as_whole('min_points', min_points)
        checked_scans(scans.values())
        old = list(self)
        if absent := [index for index in scans if index not in range(len(old))]:
            raise IndexError(f'scan {absent[0]} of {len(old)} kept ones, expected 0 or more')
        keys = np.concatenate([np.empty(0, np.int64), *(old[p].moments.key for p in scans)])
        full = self._full(keys, min_points)
        with ExitStack() as undo:
            for index, scan in scans.items():
                self._map.insert(scan.moments)
                undo.callback(self._map.remove, scan.moments)
                self._map.remove(old[index].moments)
                undo.callback(self._map.insert, old[index].moments)
            undo.pop_all()
        self._travel = Travel(self._scans[0][1] if self._scans else 0.0)
        self._scans.clear()
        self._nbytes = 0
        for index, scan in enumerate(old):
            self._append(scans.get(index, scan))
        return unpack_keys(np.setdiff1d(full, self._full(keys, min_points)))

    def _full(self, keys: npt.NDArray[np.int64], min_points: int) -> npt.NDArray[np.int64]:
        """Return those of the keys whose voxels hold at least min_points points."""
        moments = self._map.moments(unpack_keys(keys))
        return moments.key[moments.count >= min_points]

    def clear(self) -> None:
        """Remove all scans and clear the map."""
        self._reset()
        self._map.clear()

    def _append(self, scan: WindowedScan) -> None:
        self._scans.append((scan, self._travel.add(scan.frame_id, scan.T_map_sensor)))
        self._nbytes += scan.nbytes

    @property
    def keeps_scans(self) -> bool:
        """Whether scans are kept: some limit can evict them, or their points are wanted."""
        return bool(self.config.keep_points or self._limits())

    def _limits(self) -> list[tuple[str, float]]:
        """Return name and value of the limits that are set."""
        limits = []
        for name in LIMITS:
            largest: float = getattr(self.config if name in SETTINGS else self, name)
            if largest:
                limits.append((name, largest))
        return limits

    def _limit_reached(self, limits: list[tuple[str, float]]) -> str:
        """Return the name of the first limit that is exceeded, or an empty string."""
        for name, largest in limits:
            if LIMITS[name](self) > largest:
                return name
        return ''


LIMITS: dict[str, Callable[[SlidingWindow], float]] = {
    'max_scans': lambda window: len(window._scans),
    'max_age_s': lambda window: (
        (window._scans[-1][0].stamp_ns - window._scans[0][0].stamp_ns) / 1e9
    ),
    'max_distance_m': lambda window: window._travel.travelled_m - window._scans[0][1],
    'max_bytes': lambda window: window._nbytes,
    'max_voxels': lambda window: window._map.num_voxels,
    'max_total_bytes': lambda window: window._map.num_voxels * VOXEL_BYTES + window._nbytes,
}
"""
The limits of a window with two scans or more, and the measure that each limits.

The oldest scan is evicted while a measure is larger than the value of its limit: the setting of
this name in WindowConfig, or the attribute of SlidingWindow.
"""

SETTINGS = tuple(declared.key for declared in settings_of(WindowConfig) if declared.key in LIMITS)
"""The limits that are settings."""


def checked_scans(scans: Iterable[WindowedScan]) -> list[WindowedScan]:
    """Return scans as a list; raise TypeError for others."""
    check_kind('scans', scans, Iterable)
    listed = list(scans)
    for scan in listed:
        check_kind('scans', scan, WindowedScan)
    return listed


def without(scan: WindowedScan, keys: npt.NDArray[np.int64]) -> WindowedScan:
    """Return a scan without the voxels of sorted keys."""
    hit = contains(keys, scan.moments.key)
    if not hit.any():
        return scan
    kept = replace(scan, moments=scan.moments.select(~hit))
    if scan.points is None:
        return kept
    size_m = scan.moments.voxel_size_m
    stay = ~contains(keys, point_keys(scan.points, scan.T_map_sensor, size_m))
    columns = {name: column[stay] for name, column in scan.columns.items()}
    return replace(kept, points=scan.points[stay], columns=columns)


def contains(keys: npt.NDArray[np.int64], wanted: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Return which of the wanted keys are among the sorted keys."""
    at = np.searchsorted(keys, wanted)
    return np.asarray(keys[np.minimum(at, len(keys) - 1)] == wanted)
