# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Regions of space, in the frame of the map, that can be cleared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

MAX_CORNERS = 1000
"""Limit of the corners of a polygon."""

Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


@runtime_checkable
class Region(Protocol):
    """A region of space."""

    def contains(self, points: Floats) -> Mask:
        """Return which points (N, 3), m, are inside, (N,) bool."""


@dataclass(frozen=True, slots=True)
class Box:
    """
    A box along the axes.

    Raises
    ------
    ValueError
        If a bound is nan, or a lower one is not below its upper one.

    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        """Check the bounds."""
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f'box from {self.low} to {self.high}, expected low below high')

    def contains(self, points: Floats) -> Mask:
        """Return which points are inside, the faces included."""
        inside = (points >= self.low) & (points <= self.high)
        return np.asarray(inside.all(axis=1))


@dataclass(frozen=True, slots=True)
class Ball:
    """
    A ball.

    Raises
    ------
    ValueError
        If the radius is not positive, or a number is not finite.

    """

    center: tuple[float, float, float]
    radius_m: float

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not (self.radius_m > 0.0 and np.isfinite([*self.center, self.radius_m]).all()):
            raise ValueError(
                f'radius {self.radius_m} m about {self.center}, expected finite and positive'
            )

    def contains(self, points: Floats) -> Mask:
        """Return which points are inside, the surface included."""
        offset = points - self.center
        return np.asarray((offset * offset).sum(axis=1) <= self.radius_m**2)


@dataclass(frozen=True, slots=True)
class Prism:
    """
    The column above and below a polygon in x and y, its last corner joined to the first.

    If edges cross, a point is inside if a ray from it crosses an odd number of them.

    Raises
    ------
    ValueError
        If there are fewer than three corners or more than MAX_CORNERS, or one is not finite.

    """

    corners: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        """Check the corners."""
        if not 3 <= len(self.corners) <= MAX_CORNERS:
            raise ValueError(
                f'polygon of {len(self.corners)} corners, expected 3 to {MAX_CORNERS}'
            )
        finite = np.isfinite(self.corners).all(axis=1)
        if not finite.all():
            number = int(np.argmin(finite))
            raise ValueError(
                f'corner {number} of the polygon: {self.corners[number]}, expected finite numbers'
            )

    def contains(self, points: Floats) -> Mask:
        """
        Return which points are inside: the edges that a ray along x crosses are counted.

        Source: Shimrat 1962, Algorithm 112, Position of point relative to polygon.
        """
        order = np.argsort(points[:, 1])
        x, y = points[order, 0], points[order, 1]
        is_odd = np.zeros(len(points), bool)
        corners = np.array(self.corners, np.float64)
        for (x0, y0), (x1, y1) in zip(np.roll(corners, 1, axis=0), corners, strict=True):
            beside = slice(*np.searchsorted(y, sorted((y0, y1))))
            is_odd[beside] ^= x[beside] < x0 + (y[beside] - y0) / (y1 - y0) * (x1 - x0)
        inside = np.empty_like(is_odd)
        inside[order] = is_odd
        return inside
