# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Scan: the points of one sweep of a sensor, as arrays.

Coordinates keep the type of the cloud (float32 or float64), because the map quantises a point
once, in float64; rounding it before would be a second quantisation. Those of a message are decoded
when they are first read, most often by the thread that reduces the scan.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, cast, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_array, as_numbers, check_kind, check_rows, Record
from surfel_mapper.errors import counted


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PointTimes(Record):
    """
    Measurement times of the points of a scan.

    Attributes
    ----------
    offsets : (N,) int64
        Nanoseconds after the stamp of the scan; undefined for invalid points.
    first_ns, last_ns : int
        Times of the first and of the last point.

    """

    offsets: npt.NDArray[np.int64]
    first_ns: int
    last_ns: int


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class DepthImage(Record):
    """
    A rectified depth image, for layers that need no points.

    Attributes
    ----------
    points : (N, 3) float32
        The points that were made of it.
    depth : (H, W) uint16, mm, or float32, m
        Along the optical axis; 0, negative values, nan and 65535 mm mean unknown, inf no return.
    color : (H, W, 3) uint8, optional
        Red, green, blue.
    label : (H, W) int32, optional
        -1 means unknown.

    """

    points: npt.NDArray[Any]
    depth: npt.NDArray[Any]
    color: npt.NDArray[np.uint8] | None = None
    label: npt.NDArray[np.int32] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class LazyPoints:
    """
    Points of a scan that are decoded when they are first read.

    Attributes
    ----------
    num_points : int
        N.
    decode : callable
        Returns the points, (N, 3) float32 or float64, m.
    xyz : tuple of three (N,) arrays, optional
        The same coordinates where the message has them, for a look at them before that.

    """

    num_points: int
    decode: Callable[[], npt.NDArray[Any]]
    xyz: tuple[npt.NDArray[Any], ...] | None = None

    def __len__(self) -> int:
        """Return the number of points."""
        return self.num_points


@dataclass(frozen=True, slots=True, eq=False)
class ComputedColumns(Mapping[str, npt.NDArray[Any]]):
    """
    Columns that are each computed when they are first read: most never are.

    Attributes
    ----------
    names : collection of str
        The columns that there are.
    compute : callable
        Returns the column of a name.
    num_rows : int
        Rows of each column.

    """

    names: Collection[str]
    compute: Callable[[str], npt.NDArray[Any]]
    num_rows: int
    _computed: dict[str, npt.NDArray[Any]] = field(default_factory=dict)

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        """Return a column, the same array every time."""
        if name not in self._computed:
            if name not in self.names:
                raise KeyError(name)
            self._computed[name] = self.compute(name)
        return self._computed[name]

    def __contains__(self, name: object) -> bool:
        """Return whether the column exists, without computing it."""
        return name in self.names

    def __iter__(self) -> Iterator[str]:
        """Yield the names."""
        return iter(self.names)

    def __len__(self) -> int:
        """Return the number of columns."""
        return len(self.names)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """
    The points of one sweep in the frame of the sensor.

    Attributes
    ----------
    points : (N, 3) float32 or float64, m
        In ``frame_id``. May contain nan and inf, which consumers leave out. In Fortran order
        the map takes them without a copy. LazyPoints are decoded when they are first read.
    stamp_ns : int
        Stamp of the message's header, nanoseconds.
    frame_id : str
        The coordinate frame of the sensor.
    columns : mapping of str to array of length N
        Further columns of the points (intensity, ring, time, ...).
    T_base_sensor, T_map_sensor : (4, 4) float64, optional
        Pose of the sensor on the robot, and in the map at the stamp; None if unknown. Filters that
        need the robot or the vertical use them.
    times : PointTimes, optional
        Measurement times of the points, for deskewing; None: all at the stamp.
    camera : tuple of float
        For points of a depth image: width and height of the image, focal lengths and centre
        fx, fy, cx, cy, all in pixels.
    depth : DepthImage, optional
        The depth image that has exactly these points; None as soon as a scan has others.
    free : (K, 3) float, optional
        Unit vectors along which the sensor reports no return within its range.
    topic : str
        The topic that it came from. Stamps of one topic and frame are not repeated.
    msg : sensor_msgs/PointCloud2, optional
        The cloud of the scan, if it has the same points in the same order.

    Raises
    ------
    ValueError
        If the points are not a floating point array (N, 3), or the stamp is no whole number. If
        a column is not of length N, or a pose or the free directions have another shape.
    TypeError
        If the frame is no name, or the columns are no mapping.

    Examples
    --------
    >>> import numpy as np
    >>> scan = Scan(points=np.zeros((2, 3), np.float32), stamp_ns=10**9, frame_id='lidar')
    >>> len(scan)
    2

    """

    points: npt.NDArray[Any]
    stamp_ns: int
    frame_id: str
    columns: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)
    T_base_sensor: npt.NDArray[np.float64] | None = None
    T_map_sensor: npt.NDArray[np.float64] | None = None
    times: PointTimes | None = None
    camera: tuple[float, ...] = ()
    depth: DepthImage | None = None
    free: npt.NDArray[Any] | None = None
    topic: str = ''
    msg: Any = None
    _lazy: LazyPoints | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the shapes."""
        points: Any = self.points
        if isinstance(points, LazyPoints):
            object.__setattr__(self, '_lazy', points)
            object.__delattr__(self, 'points')
        else:
            check_points(points)
        if isinstance(self.stamp_ns, bool) or not isinstance(self.stamp_ns, (int, np.integer)):
            raise ValueError(
                f'stamp_ns: {self.stamp_ns!r}, expected whole nanoseconds as an int, such as '
                'round(seconds * 1e9)'
            )
        if not isinstance(self.frame_id, str):
            raise TypeError(f'frame_id: {self.frame_id!r:.60}, expected the name of a frame')
        for name, kind in (('times', PointTimes), ('depth', DepthImage)):
            value = getattr(self, name)
            if not isinstance(value, (kind, type(None))):
                raise TypeError(f'{name}: a {type(value).__name__}, expected a {kind.__name__}')
        if self.times is not None:
            check_offsets(self.times.offsets, len(points))
        for name in ('T_base_sensor', 'T_map_sensor'):
            if (T := getattr(self, name)) is not None:
                object.__setattr__(self, name, as_numbers(name, T))
                if np.shape(T) != (4, 4):
                    raise ValueError(f'{name}: shape {np.shape(T)}, expected (4, 4)')
        if self.free is not None and as_array('free', self.free).shape[1:] != (3,):
            raise ValueError(f'free: shape {np.shape(self.free)}, expected directions (K, 3)')
        if self.depth is not None and self.depth.points is not points:
            object.__setattr__(self, 'depth', None)
        num_points = len(self)
        if getattr(self.columns, 'num_rows', None) == num_points:
            return  # columns of filters are lazy: measuring would compute each
        check_kind('columns', self.columns, Mapping)
        for name, column in self.columns.items():
            if not hasattr(column, '__len__'):
                raise ValueError(f'column {name}: {column!r:.60}, expected an array (N,)')
            if len(column) != len(points):
                raise ValueError(
                    f'column {name}: {len(column)} rows, expected one for each of '
                    f'{len(points)} points'
                )

    if not TYPE_CHECKING:  # hidden from mypy: any other attribute is an error

        def __getattr__(self, name: str) -> Any:
            """Decode the points: Python asks for an attribute here while it is not set."""
            if name != 'points' or self._lazy is None:
                raise AttributeError(f'{type(self).__name__!r} object has no attribute {name!r}')
            points = self._lazy.decode()  # two threads may do so at once, to the same bits
            object.__setattr__(self, 'points', points)
            return points

    def __repr__(self) -> str:
        """Return the number of points, stamp, frame and columns."""
        about = [counted(len(self), 'point'), f'{self.stamp_ns / 1e9:.3f} s']
        about.append(f'frame {self.frame_id!r}')
        return f'Scan({", ".join([*about, *self.columns])})'

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points) if self._lazy is None else self._lazy.num_points

    @property
    def xyz(self) -> tuple[npt.NDArray[Any], ...]:
        """Coordinates x, y and z, (N,) each; a look at them does not decode the points."""
        if self._lazy is not None and self._lazy.xyz is not None:
            return self._lazy.xyz
        return tuple(np.require(self.points, None, ['F', 'A', 'W']).T)

    @property
    def end_ns(self) -> int:
        """Time of the last point, or the stamp if that is later."""
        return self.stamp_ns if self.times is None else max(self.stamp_ns, self.times.last_ns)

    def with_times(self, times: PointTimes) -> Scan:
        """Return the scan with the times of its points, which are not decoded for that."""
        return self._changed(times=times)

    def of_topic(self, topic: str) -> Scan:
        """Return the scan with its topic."""
        return self._changed(topic=topic)

    def moved_in_time(self, offset_ns: int) -> Scan:
        """Return the scan with an offset added to its stamp and the times of its points."""
        if not offset_ns:
            return self
        times = self.times
        if times is not None:
            first_ns, last_ns = times.first_ns + offset_ns, times.last_ns + offset_ns
            times = replace(times, first_ns=first_ns, last_ns=last_ns)
        return self._changed(stamp_ns=self.stamp_ns + offset_ns, times=times)

    def _changed(self, **changes: Any) -> Scan:
        """Return the scan with other values; its points are not decoded for that."""
        if self._lazy is None or self.depth is not None:  # which has these very points
            return replace(self, **changes)
        once = partial(getattr, self, 'points')  # decoded once for both
        later = LazyPoints(len(self), once, self._lazy.xyz)
        return replace(self, points=cast(Any, later), **changes)

    def select(self, rows: npt.NDArray[Any]) -> Scan:
        """
        Return the scan with selected points and their columns.

        Parameters
        ----------
        rows : (N,) bool or (K,) int
            A mask over the points, or indices in the order of the result.

        """
        check_rows('rows', rows)
        columns = {name: column[rows] for name, column in self.columns.items()}
        times = self.times and replace(self.times, offsets=self.times.offsets[rows])
        return replace(self, points=self.points[rows], columns=columns, times=times, msg=None)


def check_offsets(offsets: object, num_points: int) -> None:
    """Raise ValueError unless the times of points are an array (N,) of int64."""
    array = offsets if isinstance(offsets, np.ndarray) else np.empty(0, object)
    if array.shape != (num_points,) or array.dtype != np.int64:
        kind = f'{array.dtype} {array.shape}' if array is offsets else type(offsets).__name__
        raise ValueError(f'offsets of times: {kind}, expected int64 ({num_points},)')


def check_points(points: object) -> None:
    """Raise ValueError unless points are an array (N, 3) of float32 or float64."""
    if isinstance(points, np.ma.MaskedArray):
        raise ValueError('points: a MaskedArray, expected an array: points.filled(np.nan)')
    if not isinstance(points, np.ndarray):
        raise ValueError(f'points: {type(points).__name__}, expected an array (N, 3)')
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f'points: shape {points.shape}, expected (N, 3)')
    if points.dtype not in (np.float32, np.float64):
        raise ValueError(f'points: dtype {points.dtype}, expected float32 or float64')
