# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters by the position of a point: box, distance, range, angle, field of view.

They work on one coordinate at a time and in its type: for 131,072 points in float32 a box takes
0.1 ms. A bound is rounded to that type, so that a point which float32 puts on a bound is on it.
Angles are not computed: their cosines, or the side of an edge on which a point is, decide. A point
on the axis about which an angle is measured has no such angle: neither test keeps it.

If several sensors feed one map, a filter with a ``sensor`` applies only to scans of that frame.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import ConfigError, FilterError
from surfel_mapper.filters.base import Array, Filter, Mask, parameter
from surfel_mapper.filters.kernels.limits import outside_box
from surfel_mapper.filters.registry import register
from surfel_mapper.scan import Scan


@register(libpointmatcher='IdentityDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class Identity(Filter):
    """Return the scan unchanged."""

    def apply(self, scan: Scan) -> Scan:
        """Return the scan itself."""
        return scan


@register(name='remove_nan', libpointmatcher='RemoveNaNDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class RemoveNaN(Filter):
    """Drop the points with a nan coordinate; infinite ones stay."""

    def keep(self, scan: Scan) -> Mask:
        """Return which points have no nan."""
        x, y, z = scan.points.T
        return np.asarray((x == x) & (y == y) & (z == z), np.bool_)  # nan equals nothing


@register(libpointmatcher='BoundingBoxDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class BoundingBox(Filter):
    """Drop, or keep, the points in a box along the axes; its faces are outside."""

    x_min_m: float = parameter(-1.0, 'Lowest x, m.', libpointmatcher='xMin')
    x_max_m: float = parameter(1.0, 'Highest x, m.', libpointmatcher='xMax')
    y_min_m: float = parameter(-1.0, 'Lowest y, m.', libpointmatcher='yMin')
    y_max_m: float = parameter(1.0, 'Highest y, m.', libpointmatcher='yMax')
    z_min_m: float = parameter(-1.0, 'Lowest z, m.', libpointmatcher='zMin')
    z_max_m: float = parameter(1.0, 'Highest z, m.', libpointmatcher='zMax')
    remove_inside: bool = parameter(
        True, '1: drop the points inside; 0: keep only those.', libpointmatcher='removeInside'
    )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay."""
        low = (self.x_min_m, self.y_min_m, self.z_min_m)
        high = (self.x_max_m, self.y_max_m, self.z_max_m)
        points, dtype = scan.points, scan.points.dtype
        lows, highs = rounded(low, dtype), rounded(high, dtype)
        if self.remove_inside:
            return np.asarray(((points <= lows) | (points >= highs)).any(axis=1))
        return np.asarray(((points > lows) & (points < highs)).all(axis=1))


def rounded(bounds: Any, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return bounds in the dtype of the coordinates; infinite beyond its range."""
    with np.errstate(over='ignore'):
        return np.asarray(bounds, np.float64).astype(dtype)


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisFilter(Filter):
    """Base of the filters that compare the distance from the origin or one coordinate."""

    axis: int = parameter(
        -1,
        '-1: distance from the origin; 0, 1, 2: x, y, z.',
        low=-1,
        high=2,
        libpointmatcher='dim',
    )


@register(libpointmatcher='DistanceLimitDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class DistanceLimit(AxisFilter):
    """Keep the points beyond, or before, a distance from the origin or along one axis."""

    distance_m: float = parameter(
        1.0,
        'The limit, m; points at it are dropped; for axis -1 its absolute value.',
        libpointmatcher='dist',
    )
    remove_inside: bool = parameter(
        True, '1: keep the points beyond; 0: keep those before.', libpointmatcher='removeInside'
    )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay."""
        test = beyond if self.remove_inside else nearer
        return test(scan, self.axis, self.distance_m)


@register(libpointmatcher='MaxDistDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class MaxDist(AxisFilter):
    """Keep the points nearer than a distance; distance_limit replaces it."""

    max_m: float = parameter(
        1.0, 'Points here or farther are dropped, m.', libpointmatcher='maxDist'
    )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay."""
        return nearer(scan, self.axis, self.max_m)


@register(libpointmatcher='MinDistDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class MinDist(AxisFilter):
    """Keep the points farther than a distance; distance_limit replaces it."""

    min_m: float = parameter(
        1.0, 'Points here or nearer are dropped, m.', libpointmatcher='minDist'
    )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay."""
        return beyond(scan, self.axis, self.min_m)


def nearer(scan: Scan, axis: int, limit_m: float) -> Mask:
    """Return which points lie below a limit along an axis; -1: nearer to the origin."""
    measured, limit = measure(scan, axis, limit_m)
    return np.asarray(measured < limit, np.bool_)


def beyond(scan: Scan, axis: int, limit_m: float) -> Mask:
    """Return which points lie beyond a limit along an axis; -1: farther from the origin."""
    measured, limit = measure(scan, axis, limit_m)
    return np.asarray(measured > limit, np.bool_)


def measure(scan: Scan, axis: int, limit_m: float) -> tuple[npt.NDArray[Any], Any]:
    """Return the values compared, coordinates or squared distances, and the limit."""
    if axis >= 0:
        return scan.points[:, axis], rounded(limit_m, scan.points.dtype)
    limit_sq = limit_m * limit_m if math.isfinite(limit_m) else math.inf
    return range_sq(scan.points), rounded(limit_sq, scan.points.dtype)


def range_sq(points: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the squared distances (N,) from the origin, in the type of the coordinates, m^2."""
    x, y, z = points.T
    with np.errstate(over='ignore'):  # of far points, which are beyond any limit
        return np.asarray((x * x + y * y) + z * z)


@register(libpointmatcher='AngleLimitDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class AngleLimit(Filter):
    """Drop, or keep, the points in a wedge of directions; those on its edge are dropped."""

    phi_min_deg: float = parameter(
        -math.inf,
        'Lowest angle about z, from x towards y, -180 to 180 deg.',
        libpointmatcher='phiMin',
    )
    phi_max_deg: float = parameter(
        math.inf,
        'Highest angle about z, deg.',
        libpointmatcher='phiMax',
        libpointmatcher_default=-math.inf,
    )
    theta_min_deg: float = parameter(
        -math.inf, 'Lowest angle from z, 0 to 180 deg.', libpointmatcher='thetaMin'
    )
    theta_max_deg: float = parameter(
        math.inf,
        'Highest angle from z, deg.',
        libpointmatcher='thetaMax',
        libpointmatcher_default=-math.inf,
    )
    remove_inside: bool = parameter(
        True, '1: drop the points inside; 0: keep only those.', libpointmatcher='removeInside'
    )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay."""
        phi, theta = [self.phi_min_deg, self.phi_max_deg], [self.theta_min_deg, self.theta_max_deg]
        if self.remove_inside:  # above the highest or below the lowest
            phi, theta = phi[::-1], theta[::-1]
        x, y, z = scan.points.T
        with np.errstate(over='ignore', invalid='ignore'):  # of points that are far or infinite
            planar_sq = x * x + y * y
            planar, distance = np.sqrt(planar_sq), np.sqrt(planar_sq + z * z)
            has_phi, has_theta = planar > 0.0, distance > 0.0
            beyond = [
                has_phi & phi_beyond(x, y, planar, phi[0], below=False),
                has_phi & phi_beyond(x, y, planar, phi[1], below=True),
                has_theta & theta_beyond(z, distance, theta[0], below=False),
                has_theta & theta_beyond(z, distance, theta[1], below=True),
            ]
        test = np.logical_or if self.remove_inside else np.logical_and
        return np.asarray(test.reduce(beyond))


def phi_beyond(x: Array, y: Array, planar: Array, limit_deg: float, *, below: bool) -> Any:
    """Return whether phi, in (-180, 180] deg, of points is above a limit, or below it."""
    if not -180.0 <= limit_deg <= 180.0:
        return (limit_deg > 180.0) == below
    edge = planar * planar.dtype.type(cosine(limit_deg))
    side = y < 0.0 if below else y >= 0.0
    return side & (x < edge) if (limit_deg >= 0.0) != below else side | (x > edge)


def theta_beyond(z: Array, distance: Array, limit_deg: float, *, below: bool) -> Any:
    """Return whether theta, in [0, 180] deg, of points is above a limit, or below it."""
    if not 0.0 <= limit_deg <= 180.0:
        return (limit_deg > 180.0) == below
    edge = distance * distance.dtype.type(cosine(limit_deg))
    return z > edge if below else z < edge


def sine(angle_deg: float) -> float:
    """Return the sine of an angle in degrees, exact at multiples of 90."""
    turned = math.remainder(angle_deg, 360.0)
    if abs(turned) > 90.0:
        turned = math.copysign(180.0, turned) - turned
    return math.sin(math.radians(turned))


def cosine(angle_deg: float) -> float:
    """Return the cosine of an angle in degrees, exact at multiples of 90."""
    return sine(90.0 - abs(math.remainder(angle_deg, 360.0)))


@register
@dataclass(frozen=True, slots=True, kw_only=True)
class BodyBox(Filter):
    """Drop, or keep, the points in a box along the axes of the robot (frames.base)."""

    x_min_m: float = parameter(-1.0, 'Lowest x in the frame of the robot, m.')
    x_max_m: float = parameter(1.0, 'Highest x, m.')
    y_min_m: float = parameter(-1.0, 'Lowest y, m.')
    y_max_m: float = parameter(1.0, 'Highest y, m.')
    z_min_m: float = parameter(-1.0, 'Lowest z, m.')
    z_max_m: float = parameter(1.0, 'Highest z, m.')
    remove_inside: bool = parameter(True, '1: drop the points inside; 0: keep only those.')

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay; the faces are outside, nan is dropped."""
        if scan.T_base_sensor is None:
            raise FilterError(
                f'the place of {scan.frame_id!r} on the robot is not known; set '
                'frames.base_to_sensor, or publish it on /tf_static'
            )
        pose = np.ascontiguousarray(scan.T_base_sensor[:3], np.float64)
        low = np.array([self.x_min_m, self.y_min_m, self.z_min_m])
        high = np.array([self.x_max_m, self.y_max_m, self.z_max_m])
        is_outside = np.empty(len(scan), np.int8)
        outside_box(scan.points.T, pose, low, high, is_outside)
        return np.asarray(is_outside == int(self.remove_inside))


@register
@dataclass(frozen=True, slots=True, kw_only=True)
class RangeLimit(Filter):
    """Keep the points between two distances from the sensor, limits included."""

    min_m: float = parameter(0.5, 'Nearest, m.', low=0.0)
    max_m: float = parameter(100.0, 'Farthest, m.', low=0.0)
    sensor: str = parameter('', 'Only scans in this frame are filtered; empty: all.')

    def check(self) -> None:
        """Refuse an empty range."""
        if not self.min_m <= self.max_m:
            raise ConfigError(
                f'{self.name}: max_m: {self.max_m:g}, expected at least min_m ({self.min_m:g})'
            )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay; nan is dropped."""
        if self.sensor and self.sensor != scan.frame_id:
            return np.ones(len(scan), np.bool_)
        distance_sq = range_sq(scan.points)
        limits_sq = [limit * limit for limit in (self.min_m, self.max_m)]
        near_sq, far_sq = rounded(limits_sq, scan.points.dtype)
        return np.asarray((distance_sq >= near_sq) & (distance_sq <= far_sq))
