# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surfel: what a handful of points say about their surface, as one object.

For single use and for tests; the map holds exact integers instead (surfel_map.py). Removing
undoes adding up to the rounding of float64. That rounding is accounted for (point_sums.py), and
an eigenvalue no larger counts as 0, so a line or a repeated point is known as such even after
other points were removed.
"""

from __future__ import annotations

import operator

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.point_sums import COLUMNS, NO_POINTS, PointSums, ROUNDING, ROWS

Array = npt.NDArray[np.float64]

MAX_COORDINATE_M = 1e100
"""Beyond this a scatter could overflow."""

MAX_POINTS = 2**53
"""Up to here float64 holds every count."""


class Surfel:
    """
    Count, sum and scatter of points, and the normal and planarity that follow from them.

    Points may be float64, float32 or integers; everything inside is float64. ``+`` and ``-``
    return a new surfel, ``+=`` and ``-=`` are add and remove, ``==`` compares num_points, sum
    and sum_squares to the last bit, which the order of adding may change.

    Of no point the mean is nan; of fewer than two, or of equal ones, the eigenvalues are 0 and
    normal, planarity and curvature nan; on a line the two smaller eigenvalues and the planarity
    are 0 and the normal is some unit vector orthogonal to the line. No eigenvalue is negative.
    """

    __slots__ = ('_sums',)

    def __init__(self) -> None:
        """Make a surfel of no points."""
        self._sums = NO_POINTS

    @classmethod
    def from_points(cls, points: npt.ArrayLike) -> Surfel:
        """
        Return the surfel of some points.

        Parameters
        ----------
        points : (N, 3) or (3,) of numbers, m
            Several, none or one.

        Raises
        ------
        ValueError
            If the shape is another, or a coordinate is no number, nan or beyond 1e100.

        """
        surfel = cls()
        surfel.add(points)
        return surfel

    @classmethod
    def from_stats(
        cls,
        sum: npt.ArrayLike,  # noqa: A002 (public, as the property)
        sum_squares: npt.ArrayLike,
        num_points: int,
    ) -> Surfel:
        """
        Return the surfel of given statistics.

        Parameters
        ----------
        sum : (3,) of numbers, m
            Sum of the points.
        sum_squares : (6,) of numbers, m^2
            Scatter about the mean, xx xy xz yy yz zz.
        num_points : int
            0 gives the empty surfel, whatever the sums.

        Raises
        ------
        ValueError
            If a shape is another, a number is nan or too large, or num_points is negative or
            beyond 2^53.

        """
        count = operator.index(num_points)
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
        Return the surfel of one point that may bring a scatter along.

        Parameters
        ----------
        position : (3,) of numbers, m
            Becomes the sum.
        scatter : (3, 3) of numbers, m^2, optional
            Its upper triangle becomes sum_squares.

        Raises
        ------
        ValueError
            If a shape is another, or a number is nan or too large.

        """
        matrix = np.zeros((3, 3))
        if scatter is not None:
            matrix = _checked('scatter', scatter, (3, 3), MAX_COORDINATE_M**2)
        return cls.from_stats(_checked('position', position, (3,)), matrix[ROWS, COLUMNS], 1)

    @property
    def empty(self) -> bool:
        """Whether no point is held."""
        return self._sums.num_points == 0

    @property
    def num_points(self) -> int:
        """How many points are held."""
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
        """Add a point (3,), a batch (N, 3), or what another surfel holds; see from_points."""
        self._sums = self._sums.with_added(_sums_of(points))

    def remove(self, points: Surfel | npt.ArrayLike) -> None:
        """
        Remove a point (3,), a batch (N, 3), or what another surfel holds; see from_points.

        Removing as many points as are held, or more, empties the surfel; one point left has no
        scatter. Points that were never added cannot be told from others: what is left then may
        be the scatter of no points, whose eigenvalues below 0 are given as 0.
        """
        self._sums = self._sums.with_removed(_sums_of(points))

    def clear(self) -> None:
        """Forget all points."""
        self._sums = NO_POINTS

    def copy(self) -> Surfel:
        """Return another surfel that holds the same."""
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
        return f'<Surfel of {self.num_points} points, mean {self.mean().tolist()}>'

    def mean(self) -> Array:
        """Return the mean of the points, (3,), m; nan without any."""
        return self._sums.mean()

    def covariance(self) -> Array:
        """Return the covariance, (3, 3) m^2: scatter / (n - 1); 0 of fewer than two points."""
        matrix = np.zeros((3, 3))
        if self.num_points > 1:
            matrix[ROWS, COLUMNS] = self._sums.scatter / (self.num_points - 1)
            matrix[COLUMNS, ROWS] = matrix[ROWS, COLUMNS]
        return matrix

    def eigenvalues(self) -> Array:
        """Return the eigenvalues of the covariance, (3,), ascending, m^2; none below 0."""
        return self._spectrum()[0]

    def eigenvectors(self) -> Array:
        """
        Return unit eigenvectors as the columns of (3, 3), in the order of the eigenvalues.

        Of each, the component of largest magnitude is positive. nan where there is no normal.
        """
        return self._spectrum()[1]

    def normal(self) -> Array:
        """Return the unit eigenvector of the smallest eigenvalue, (3,); nan where all are 0."""
        return np.array(self._spectrum()[1][:, 0])

    def planarity(self) -> float:
        """Return 2 (e1 - e0) / (e0 + e1 + e2): 1 on a disc, 0 on a line or in a ball, or nan."""
        e0, e1, e2 = self.eigenvalues().tolist()
        return 2.0 * (e1 - e0) / (e0 + e1 + e2) if e2 > 0.0 else float('nan')

    def curvature(self) -> float:
        """Return e0 / (e0 + e1 + e2), from 0 to 1/3; nan where all eigenvalues are 0."""
        e0, e1, e2 = self.eigenvalues().tolist()
        return e0 / (e0 + e1 + e2) if e2 > 0.0 else float('nan')

    def _spectrum(self) -> tuple[Array, Array]:
        """Return eigenvalues (3,) and eigenvectors (3, 3), residues of rounding set to 0."""
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


def _sums_of(points: Surfel | npt.ArrayLike) -> PointSums:
    """Return the sums of points, or those that a surfel holds."""
    if isinstance(points, Surfel):
        return points._sums
    return PointSums.of_points(_checked('points', points).reshape(-1, 3))


def _checked(
    name: str,
    numbers: npt.ArrayLike,
    shape: tuple[int, ...] | None = None,
    limit: float = MAX_COORDINATE_M,
) -> Array:
    """Return numbers as a new float64 array of a shape, or of (3,) or (N, 3); else ValueError."""
    found = np.asarray(numbers)
    if found.dtype.kind not in 'fiu':
        raise ValueError(f'{name}: dtype {found.dtype}, expected real numbers')
    fits = found.shape == shape if shape else found.ndim in (1, 2) and found.shape[-1] == 3
    if not fits:
        raise ValueError(f'{name}: shape {found.shape}, expected {shape or "(3,) or (N, 3)"}')
    array = found.astype(np.float64)
    good = np.abs(array) <= limit  # which nan is not
    if not good.all():
        raise ValueError(f'{name}: found {array[~good][0]}, expected numbers up to {limit:g}')
    return array
