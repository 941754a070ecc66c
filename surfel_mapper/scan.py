# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Scan: one sweep of a sensor, as arrays.

Coordinates stay in the type they came in (float32, or float64 where the cloud has it), because
the map quantises a point once, in float64; rounding it before would be a second quantisation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True, eq=False)
class PointTimes:
    """
    When the points of a scan were measured.

    Attributes
    ----------
    offsets : (N,) int64
        Nanoseconds after the stamp of the scan; those of points that are none mean nothing.
    first_ns, last_ns : int
        Times of the first and the last point.

    """

    offsets: npt.NDArray[np.int64]
    first_ns: int
    last_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """
    The points of one sweep in the frame of the sensor.

    Attributes
    ----------
    points : (N, 3) float32 or float64, m
        In ``frame_id``. May hold nan and inf; whoever uses the points leaves those out. In
        Fortran order the map takes them without a copy.
    stamp_ns : int
        Time of the sweep in nanoseconds, of the message's header.
    frame_id : str
        The sensor's coordinate frame.
    columns : mapping of str to array of length N
        What else the points carry (intensity, ring, time, ...), one row a point.
    T_base_sensor, T_map_sensor : (4, 4) float64, optional
        Pose of the sensor on the robot, and in the map at the stamp; None if unknown. Filters that
        need the robot or the vertical use them.
    times : PointTimes, optional
        When the points were measured, for deskewing; None: all at the stamp.
    camera : tuple of float
        Of points of a depth image: width and height of the image, focal lengths and centre
        fx, fy, cx, cy, all in pixels.
    free : (K, 3) float, optional
        Unit vectors along which the sensor found nothing up to its range, as far as it says so.
    msg : sensor_msgs/PointCloud2, optional
        The cloud that it was read from, whose points are these: as many, in this order.

    Raises
    ------
    ValueError
        If the points are no array (N, 3) of floating point or a column is not of length N.

    """

    points: npt.NDArray[Any]
    stamp_ns: int
    frame_id: str
    columns: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)
    T_base_sensor: npt.NDArray[np.float64] | None = None
    T_map_sensor: npt.NDArray[np.float64] | None = None
    times: PointTimes | None = None
    camera: tuple[float, ...] = ()
    free: npt.NDArray[Any] | None = None
    msg: Any = None

    def __post_init__(self) -> None:
        """Check the shapes."""
        points = self.points
        if not isinstance(points, np.ndarray):
            raise ValueError(f'points: {type(points).__name__}, expected an array (N, 3)')
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f'points: shape {points.shape}, expected (N, 3)')
        if points.dtype not in (np.float32, np.float64):
            raise ValueError(f'points: dtype {points.dtype}, expected float32 or float64')
        if getattr(self.columns, 'num_rows', None) == len(points):
            return  # of filters: to be measured, each would have to be taken
        for name, column in self.columns.items():
            if len(column) != len(points):
                raise ValueError(
                    f'column {name}: {len(column)} rows, expected one for each of '
                    f'{len(points)} points'
                )

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points)

    @property
    def end_ns(self) -> int:
        """Time of the last point, or the stamp where that is later."""
        return self.stamp_ns if self.times is None else max(self.stamp_ns, self.times.last_ns)

    def select(self, rows: npt.NDArray[Any]) -> Scan:
        """
        Return the scan with some of its points, their columns with them.

        Parameters
        ----------
        rows : (N,) bool or (K,) int
            A mask over the points, or the indices of those wanted in the order wanted.

        """
        columns = {name: column[rows] for name, column in self.columns.items()}
        times = self.times and replace(self.times, offsets=self.times.offsets[rows])
        return replace(self, points=self.points[rows], columns=columns, times=times, msg=None)
