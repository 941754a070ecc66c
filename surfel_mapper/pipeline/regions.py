# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Regions of space, in the frame of the map, that can be cleared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from surfel_mapper.pipeline.kernels.polygons import cross_rows, mark_inside

MAX_CORNERS = 10_000
"""Limit of the corners of a polygon."""

MAX_CROSSINGS = 500_000
"""Limit of the rows of voxels that the edges of a polygon cross; these take 20 ms."""

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
        """Return which points are inside; they cost least if many have the same y."""
        corners = np.array(self.corners, np.float64)
        x, y = points[:, 0], points[:, 1]
        inside = (corners.min(axis=0) <= points[:, :2]).all(axis=1)
        inside &= (points[:, :2] <= corners.max(axis=0)).all(axis=1)
        (near,) = np.nonzero(inside)
        rows, row = np.unique(y[near], return_inverse=True)
        first, last = self._rows_crossed(rows)
        change = np.zeros(len(rows) + 1, np.int64)  # of the number of edges, at each row
        np.add.at(change, first, 1)
        np.subtract.at(change, last, 1)
        starts = np.concatenate([[0], np.cumsum(np.cumsum(change)[:-1])])
        crossings = np.empty(starts[-1])
        cross_rows(corners, rows, first, last, starts, crossings)
        marks = np.empty(len(near), np.bool_)
        mark_inside(x[near], row.reshape(-1), starts, crossings, marks)
        inside[near] = marks
        return np.asarray(inside)

    def check_cost(self, rows: Floats) -> None:
        """Raise ValueError if the edges cross rows of points at these y, sorted, too often."""
        first, last = self._rows_crossed(rows)
        cost = int((last - first).sum())
        if cost > MAX_CROSSINGS:
            raise ValueError(
                f'polygon whose {len(self.corners)} edges cross {cost} rows of voxels, expected '
                f'at most {MAX_CROSSINGS}; draw its outline with fewer corners'
            )

    def _rows_crossed(self, rows: Floats) -> tuple[npt.NDArray[np.int64], ...]:
        """Return the first row that the edge ending at each corner crosses, and one past it."""
        end = np.array([y for _, y in self.corners])
        start = np.roll(end, 1)
        return (
            np.searchsorted(rows, np.minimum(start, end)),
            np.searchsorted(rows, np.maximum(start, end)),
        )
