# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters by the direction in which a point is seen.

A point on an axis about which an angle is measured has no such angle: neither test can place it.
Angles are not computed: their cosines, or the side of an edge on which a point is, say as much.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from surfel_mapper.errors import ConfigError
from surfel_mapper.filters.base import Filter, Mask
from surfel_mapper.filters.kernels.directions import (
    ALWAYS,
    BOTH,
    EITHER,
    in_field_of_view,
    in_wedge,
    NEVER,
)
from surfel_mapper.filters.parameters import parameter
from surfel_mapper.filters.registry import register
from surfel_mapper.scan import Scan


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
        phi, theta = [self.phi_min_deg, self.phi_max_deg], [self.theta_min_deg, self.theta_max_deg]
        if self.remove_inside:  # above the highest or below the lowest
            phi, theta = phi[::-1], theta[::-1]
        kinds = [
            phi_kind(phi[0], below=False),
            phi_kind(phi[1], below=True),
            theta_kind(theta[0], below=False),
            theta_kind(theta[1], below=True),
        ]
        cosines = [cosine(limit) if math.isfinite(limit) else 0.0 for limit in (*phi, *theta)]
        found = np.empty(len(scan), np.bool_)
        of_type = np.array(cosines, scan.points.dtype)
        in_wedge(scan.points.T, of_type, np.array(kinds), not self.remove_inside, found)
        return found


def phi_kind(limit_deg: float, *, below: bool) -> int:
    """Return how phi, in (-180, 180] deg, is found to be above or below a limit."""
    if not -180.0 <= limit_deg <= 180.0:
        return ALWAYS if (limit_deg > 180.0) == below else NEVER
    return BOTH if (limit_deg >= 0.0) != below else EITHER


def theta_kind(limit_deg: float, *, below: bool) -> int:
    """Return how theta, in [0, 180] deg, is found to be above or below a limit."""
    if not 0.0 <= limit_deg <= 180.0:
        return ALWAYS if (limit_deg > 180.0) == below else NEVER
    return BOTH


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
        azimuth = (self.azimuth_min_deg, self.azimuth_max_deg)
        elevation = (self.elevation_min_deg, self.elevation_max_deg)
        has_low, has_high = (abs(limit) < 90.0 for limit in elevation)
        edges = [f(limit) for limit in azimuth for f in (cosine, sine)]
        edges += [sine(limit) / cosine(limit) if abs(limit) < 90.0 else 0.0 for limit in elevation]
        extent = azimuth[1] - azimuth[0]
        seen = np.empty(len(scan), np.bool_)
        in_field_of_view(
            scan.points.T,
            np.array(edges, scan.points.dtype),
            extent < 360.0,
            extent > 180.0,
            has_low,
            has_high,
            seen,
        )
        return seen


def sine(angle_deg: float) -> float:
    """Return a sine that is exactly 0 or 1 where it should be."""
    turned = math.remainder(angle_deg, 360.0)
    if abs(turned) > 90.0:
        turned = math.copysign(180.0, turned) - turned
    return math.sin(math.radians(turned))


def cosine(angle_deg: float) -> float:
    """Return a cosine as exact as the sine, and equal to it at 45 deg."""
    return sine(90.0 - abs(math.remainder(angle_deg, 360.0)))
