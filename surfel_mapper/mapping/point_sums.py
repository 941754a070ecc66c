# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
PointSums: count, sum and scatter of points in float64, with addition and removal.

The state of a Surfel. Sums are of deviations from an anchor, one of the points: subtracting close
numbers is exact, so 10 km from the origin cost no digits. The scatter is about the mean. A batch
is centred first, then merged; a point is a batch of one, so one formula adds and one removes.
Removing undoes adding up to the rounding of float64. A bound of that rounding is updated with each
step, so that a residue is not mistaken for a shape.

Source: Chan, Golub and LeVeque 1983 for centred batches and their merging.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

ROWS, COLUMNS = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2])
"""Row and column of the entries xx xy xz yy yz zz of a symmetric matrix."""

ROUNDING = 4.0 * float(np.finfo(np.float64).eps)
"""Bound of the rounding error of a few operations on the scatter, as a share of its trace."""

ZERO = np.zeros(3)
NO_SCATTER = np.zeros(6)


@dataclass(frozen=True, slots=True, eq=False)
class PointSums:
    """
    Count, sum and scatter of points; arrays are shared and must not be written to.

    Attributes
    ----------
    num_points : int
    anchor : (3,) float64, m
        The first point, or the mean.
    total : (3,) float64, m
        Sum of the deviations from the anchor.
    scatter : (6,) float64, m^2
        Sum of the products of deviations from the mean, xx xy xz yy yz zz.
    rounding : float, m^2
        Bound of the error of the scatter, summed over all additions and removals.

    """

    num_points: int
    anchor: Array
    total: Array
    scatter: Array
    rounding: float

    @classmethod
    def without_scatter(cls, num_points: int, anchor: Array, total: Array = ZERO) -> PointSums:
        """Return the sums of zero points or of one."""
        return cls(num_points, anchor, total, NO_SCATTER, 0.0)

    @classmethod
    def of_points(cls, points: Array) -> PointSums:
        """Return the sums of (N, 3) finite points, centred before they are squared."""
        count = len(points)
        if count == 0:
            return NO_POINTS
        anchor = points[0].copy()
        if count == 1:
            return cls.without_scatter(1, anchor)
        # one row for each axis: numpy sums contiguous memory pairwise, which rounds less
        deviation = np.ascontiguousarray((points - anchor).T)
        total = deviation.sum(axis=1)
        deviation -= (total / count)[:, None]
        residual = deviation.sum(axis=1)  # not 0, because the mean was rounded
        scatter = (deviation[ROWS] * deviation[COLUMNS]).sum(axis=1)
        scatter -= _products(residual) / count
        return cls(count, anchor, total, scatter, ROUNDING * _trace(scatter))

    @classmethod
    def of_stats(cls, total: Array, scatter: Array, num_points: int) -> PointSums:
        """Return the sums for a given sum (3,), preserved bit for bit, and scatter (6,)."""
        if num_points == 0:
            return NO_POINTS
        anchor = total / num_points
        return cls(num_points, anchor, total - num_points * anchor, scatter, 0.0)

    def sum(self) -> Array:
        """Return the sum of the points, (3,), m."""
        total: Array = self.num_points * self.anchor + self.total
        return total

    def mean(self) -> Array:
        """Return the mean of the points, (3,), m; nan if empty."""
        if self.num_points == 0:
            return np.full(3, np.nan)
        return self.anchor + self.total / self.num_points

    def with_added(self, sums: PointSums) -> PointSums:
        """Return the sums of the union of both sets of points."""
        if sums.num_points == 0:
            return self
        if self.num_points == 0:
            return sums
        added = sums._total_about(self.anchor)
        between = _between(self.num_points, self.total, sums.num_points, added)
        scatter = self.scatter + (sums.scatter + between)
        return PointSums(
            self.num_points + sums.num_points,
            self.anchor,
            self.total + added,
            scatter,
            self.rounding + sums.rounding + ROUNDING * _trace(scatter),
        )

    def with_removed(self, sums: PointSums) -> PointSums:
        """Return the sums without the points of another; empty if it has as many or more."""
        num_points = self.num_points - sums.num_points
        if sums.num_points == 0:
            return self
        if num_points <= 0:
            return NO_POINTS
        removed = sums._total_about(self.anchor)
        total = self.total - removed
        if num_points == 1:
            return PointSums.without_scatter(1, self.anchor, total)
        between = _between(num_points, total, sums.num_points, removed)
        return PointSums(
            num_points,
            self.anchor,
            total,
            self.scatter - (sums.scatter + between),
            self.rounding + sums.rounding + ROUNDING * _trace(self.scatter),
        )

    def _total_about(self, anchor: Array) -> Array:
        """Return the sum of deviations from a given anchor."""
        return self.total + self.num_points * (self.anchor - anchor)


NO_POINTS = PointSums.without_scatter(0, ZERO)


def _between(num_a: int, total_a: Array, num_b: int, total_b: Array) -> Array:
    """Return the scatter (6,) between the means of two sets of points."""
    weight = num_a / (num_a + num_b) * num_b
    return weight * _products(total_a / num_a - total_b / num_b)


def _products(vector: Array) -> Array:
    """Return the products of the components of a vector (3,), xx xy xz yy yz zz."""
    x, y, z = vector.tolist()
    return np.array([x * x, x * y, x * z, y * y, y * z, z * z])


def _trace(scatter: Array) -> float:
    """Return the trace of a scatter (6,), of absolute values."""
    return abs(float(scatter[0])) + abs(float(scatter[3])) + abs(float(scatter[5]))
