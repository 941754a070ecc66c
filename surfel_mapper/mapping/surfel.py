# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surfel: statistics of a set of points as an object: mean, covariance, normal, planarity.

For single use and for tests; the map stores exact integers instead (moment_map.py). Removing
undoes adding up to the rounding of float64. A bound of that rounding is kept (point_sums.py), and
smaller eigenvalues count as 0, so a line or a repeated point is recognised even after other points
were removed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import cast

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_array, as_whole
from surfel_mapper.errors import counted
from surfel_mapper.mapping.point_sums import COLUMNS, NO_POINTS, PointSums, ROUNDING, ROWS

Array = npt.NDArray[np.float64]

MAX_COORDINATE_M = 1e100
"""Largest coordinate accepted: beyond it a scatter could overflow."""

MAX_POINTS = 2**53
"""Largest number of points: float64 holds every count up to it."""


class Surfel:
    """
    Count, sum and scatter of points, from which normal and planarity are derived.

    Points may be float64, float32 or integers; all arithmetic is float64. ``+`` and ``-`` return
    a new surfel, ``+=`` and ``-=`` are add and remove, ``==`` compares num_points, sum and
    sum_squares bit for bit; the last bits depend on the order of adding.

    Degenerate points: if empty, the mean is nan. For fewer than two or identical points the
    eigenvalues are 0, and normal, planarity and curvature nan. On a line the two smaller
    eigenvalues and the planarity are 0, and the normal is some unit vector orthogonal to the
    line. No eigenvalue is negative.

    Examples
    --------
    >>> surfel = Surfel([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
    >>> surfel.num_points, surfel.normal().tolist(), surfel.planarity()
    (4, [0.0, 0.0, 1.0], 1.0)

    """

    __slots__ = ('_sums',)

    def __init__(self, points: Surfel | npt.ArrayLike | Iterable[npt.ArrayLike] = ()) -> None:
        """Start with points, by default none; see from_points."""
        self._sums = _sums_of(points)

    @classmethod
    def from_points(cls, points: npt.ArrayLike | Iterable[npt.ArrayLike]) -> Surfel:
        """
        Return the surfel of points; the same as ``Surfel(points)``.

        Parameters
        ----------
        points : (N, 3) or (3,) of numbers, or iterable of (3,), m
            A batch, which may be empty, an iterator over points, or a single point.

        Raises
        ------
        ValueError
            If the shape differs, or a coordinate is not a number, nan or beyond 1e100.

        """
        return cls(points)

    @classmethod
    def from_stats(
        cls,
        sum: npt.ArrayLike,  # noqa: A002 (public, as the property)
        sum_squares: npt.ArrayLike,
        num_points: int,
    ) -> Surfel:
        """
        Return the surfel with given statistics.

        Parameters
        ----------
        sum : (3,) of numbers, m
            Sum of the points.
        sum_squares : (6,) of numbers, m^2
            Scatter about the mean, xx xy xz yy yz zz.
        num_points : int
            Number of points; 0 gives the empty surfel and ignores the sums.

        Raises
        ------
        ValueError
            If a shape differs, a number is nan or too large, or num_points is negative or
            beyond 2^53.

        """
        count = as_whole('num_points', num_points)
        if not 0 <= count <= MAX_POINTS:
            raise ValueError(f'num_points: {count}, expected 0 to {MAX_POINTS}')
        limit = MAX_COORDINATE_M * max(count, 1)
        total = _checked('sum', sum, (3,), limit)
        scatter = _checked('sum_squares', sum_squares, (6,), MAX_COORDINATE_M * limit)
        surfel = cls()
        surfel._sums = PointSums.of_stats(total, scatter, count)
        return surfel

    @classmethod
    def from_position(
        cls, position: npt.ArrayLike, scatter: npt.ArrayLike | None = None
    ) -> Surfel:
        """
        Return the surfel of a single point, optionally with a scatter.

        Parameters
        ----------
        position : (3,) of numbers, m
            Becomes the sum.
        scatter : (3, 3) of numbers, m^2, optional
            Its upper triangle becomes sum_squares.

        Raises
        ------
        ValueError
            If a shape differs, or a number is nan or too large.

        """
        matrix: npt.NDArray[np.float64] = np.zeros((3, 3))
        if scatter is not None:
            matrix = _checked('scatter', scatter, (3, 3), MAX_COORDINATE_M**2)
        return cls.from_stats(_checked('position', position, (3,)), matrix[ROWS, COLUMNS], 1)

    @property
    def empty(self) -> bool:
        """Whether the surfel holds no points."""
        return self._sums.num_points == 0

    @property
    def num_points(self) -> int:
        """Number of points."""
        return self._sums.num_points

    @property
    def sum(self) -> Array:
        """Sum of the points, (3,), m."""
        return self._sums.sum()

    @property
    def sum_squares(self) -> Array:
        """Scatter about the mean, (6,), m^2: xx xy xz yy yz zz."""
        return np.array(self._sums.scatter)

    def add(self, points: Surfel | npt.ArrayLike) -> None:
        """Add a point (3,), a batch (N, 3) or the points of another surfel; see from_points."""
        self._sums = self._sums.with_added(_sums_of(points))

    def remove(self, points: Surfel | npt.ArrayLike) -> None:
        """
        Remove a point (3,), a batch (N, 3) or the points of another surfel; see from_points.

        Removing at least num_points points empties the surfel; a single remaining point has no
        scatter. Removing points that were never added is not detected. The remaining scatter may
        then belong to no set of points, and its negative eigenvalues are reported as 0.
        """
        self._sums = self._sums.with_removed(_sums_of(points))

    def clear(self) -> None:
        """Remove all points."""
        self._sums = NO_POINTS

    def copy(self) -> Surfel:
        """Return an independent copy."""
        copy = Surfel()
        copy._sums = self._sums
        return copy

    def __add__(self, points: Surfel | npt.ArrayLike) -> Surfel:
        result = self.copy()
        result.add(points)
        return result

    def __sub__(self, points: Surfel | npt.ArrayLike) -> Surfel:
        result = self.copy()
        result.remove(points)
        return result

    def __iadd__(self, points: Surfel | npt.ArrayLike) -> Surfel:
        self.add(points)
        return self

    def __isub__(self, points: Surfel | npt.ArrayLike) -> Surfel:
        self.remove(points)
        return self

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Surfel):
            return NotImplemented
        return (
            self.num_points == other.num_points
            and np.array_equal(self.sum, other.sum)
            and np.array_equal(self._sums.scatter, other._sums.scatter)
        )

    def __repr__(self) -> str:
        return f'<Surfel of {counted(self.num_points, "point")}, mean {self.mean().tolist()}>'

    def mean(self) -> Array:
        """Return the mean of the points, (3,), m; nan if empty."""
        return self._sums.mean()

    def covariance(self) -> Array:
        """Return the covariance, (3, 3) m^2: scatter / (n - 1); 0 for fewer than two points."""
        matrix = np.zeros((3, 3))
        if self.num_points > 1:
            matrix[ROWS, COLUMNS] = self._sums.scatter / (self.num_points - 1)
            matrix[COLUMNS, ROWS] = matrix[ROWS, COLUMNS]
        return matrix

    def eigenvalues(self) -> Array:
        """Return the eigenvalues of the covariance, (3,), ascending, m^2; none negative."""
        return self._spectrum()[0]

    def eigenvectors(self) -> Array:
        """
        Return unit eigenvectors as the columns of (3, 3), in the order of the eigenvalues.

        The component of largest magnitude of each is positive. nan if all eigenvalues are 0.
        """
        return self._spectrum()[1]

    def normal(self) -> Array:
        """Return the unit eigenvector of the smallest eigenvalue, (3,); nan if all are 0."""
        return np.array(self._spectrum()[1][:, 0])

    def planarity(self) -> float:
        """Return 2 (e1 - e0) / (e0 + e1 + e2): 1 on a disc, 0 on a line or in a ball, or nan."""
        e0, e1, e2 = self.eigenvalues().tolist()
        return 2.0 * (e1 - e0) / (e0 + e1 + e2) if e2 > 0.0 else float('nan')

    def curvature(self) -> float:
        """Return e0 / (e0 + e1 + e2), from 0 to 1/3; nan if all eigenvalues are 0."""
        e0, e1, e2 = self.eigenvalues().tolist()
        return e0 / (e0 + e1 + e2) if e2 > 0.0 else float('nan')

    def _spectrum(self) -> tuple[Array, Array]:
        """Return eigenvalues (3,) and eigenvectors (3, 3), with rounding residues set to 0."""
        unknown = np.full((3, 3), np.nan)
        if self.num_points < 2:
            return np.zeros(3), unknown
        values, vectors = np.linalg.eigh(self.covariance())
        residue = self._sums.rounding / (self.num_points - 1) + ROUNDING * values[2]
        values = np.where(values > residue, values, 0.0)
        if values[2] == 0.0:
            return values, unknown
        largest = vectors[np.abs(vectors).argmax(axis=0), [0, 1, 2]]
        return values, vectors * np.sign(largest)


def _sums_of(points: Surfel | npt.ArrayLike | Iterable[npt.ArrayLike]) -> PointSums:
    """Return the sums of points or of a surfel."""
    if isinstance(points, Surfel):
        return points._sums
    if isinstance(points, Iterator):
        points = list(points)
    if isinstance(points, (list, tuple)) and not points:
        return NO_POINTS
    points = cast('npt.ArrayLike', points)
    return PointSums.of_points(_checked('points', points).reshape(-1, 3))


def _checked(
    name: str,
    numbers: npt.ArrayLike,
    shape: tuple[int, ...] | None = None,
    limit: float = MAX_COORDINATE_M,
) -> Array:
    """Return numbers as a new float64 array of a shape, by default (3,) or (N, 3)."""
    raw = as_array(name, numbers)
    if raw.dtype.kind not in 'fiu':
        raise ValueError(f'{name}: dtype {raw.dtype}, expected real numbers')
    fits = raw.shape == shape if shape else raw.ndim in (1, 2) and raw.shape[-1] == 3
    if not fits:
        raise ValueError(f'{name}: shape {raw.shape}, expected {shape or "(3,) or (N, 3)"}')
    array = raw.astype(np.float64)
    good = np.abs(array) <= limit  # false for nan
    if not good.all():
        raise ValueError(f'{name}: found {array[~good][0]}, expected numbers up to {limit:g}')
    return array
