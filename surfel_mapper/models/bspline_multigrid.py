# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Solvers of the normal equations of height fields: banded for small ones, multigrid for large ones.

A control point shares samples with 48 others at degree 3, but a band has a column for each control
point along three rows of the short side, and its factorisation multiplies the square of that for
each control point: 10 s and 2.1 GB for 450 x 450 cells. Conjugate gradients need the 49 entries
only, stored as stencils. Alone they take 5,800 steps if the field has holes, where only the second
differences act; preconditioned by one V-cycle of multigrid they take 15 to 40.

A coarser level has half of the control points along each axis: uniform splines contain those with
every second knot. Its matrix is the Galerkin product, so holes and weights stay as they are. One
sweep of Gauss-Seidel precedes the coarser level, its adjoint follows; the coarsest level is solved
as a band.

Time on one core and memory of a fit of n x n cells, all filled, and on a diagonal street with
shadows and gaps (the band takes the same for both):

    n     band             multigrid, filled   multigrid, street
    50    4 ms, 2 MB       15 ms               15 ms
    75    16 ms, 11 MB     19 ms               21 ms
    100   40 ms, 26 MB     33 ms               37 ms
    150   164 ms, 80 MB    80 ms, 20 MB        106 ms
    450   10 s, 2.1 GB     0.75 s, 91 MB       1.5 s
    1000  not measured     4.3 s, 0.4 GB       8.9 s

Hence two solvers: multigrid would take four times as long for the small fields that most patches
are, the band more than memory holds for large ones. They meet where both take the same time.

Source: Hackbusch 1985, Multi-Grid Methods and Applications; Lane and Riesenfeld 1980 (refinement
of uniform splines).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.kernels.bspline import (
    add_differences,
    add_equations,
    coarsen_stencils,
    multiply_stencils,
    relax_backward,
    relax_forward,
)

Array = npt.NDArray[np.float64]
Parts = tuple[Array, float, tuple[int, int], tuple[Array, Array], Array]

LEAST_REACH = 3
"""Least reach of stencils for which the coarser ones fit into the same columns."""

MOST_DIRECT = 1e9
"""Multiplications of a banded solve, 40 ms, above which multigrid is used: 100 x 100 cells."""

LEAST_SIDE = 16
"""Control points along the short side, below which the band is narrow enough at any length."""

TOLERANCE = 1e-12
"""
Error at which conjugate gradients stop, relative to the initial one, in the norm of the matrix.
Of heights of metres, control points are then within 1e-8 m of the banded solution, and heights in
filled cells within 1e-9 m.
"""

MOST_STEPS = 200
"""
Most conjugate gradient steps, five times the usual number; then the band is solved instead. It
happens at weights of the second differences below 1e-4, which hardly bind the control points
between the samples.
"""


def least_squares(
    xyz: Array,
    weight: Array,
    field: Parts,
    places: tuple[Array, Array],
    rules: tuple[float, float],
) -> Array:
    """
    Return the control points (Nx, Ny) of the height field that fits samples best, m.

    Parameters
    ----------
    xyz : (M, 3) float64, m
        Samples.
    weight : (M,) float64
        Their weights.
    field : tuple
        Grid and degrees, see HeightField.parts; Ny is at most Nx, as it decides the width of the
        band.
    places : (Nx,), (Ny,) float64, m
        Greville abscissae along x and y.
    rules : (float, float)
        Weight of the second differences, and weight that pulls to 0.

    """
    (x, y), (num_x, num_y) = field[2], (len(places[0]), len(places[1]))
    direct, right = is_direct((num_x, num_y), max(x, y, 2)), np.zeros(num_x * num_y)
    if direct:
        stride, width = num_y, max(x * num_y + y, 2 * num_y) + 1
        matrix: Array = np.zeros((len(right), width))
    else:
        stencils = Stencils.zeros((num_x, num_y), max(x, y, LEAST_REACH))
        stride, matrix = stencils.stride, stencils.entries
    add_equations(xyz, weight, field, stride, matrix, right)
    add_differences(*places, rules[0], stride, matrix)
    matrix[:, 0] += rules[1]
    control = solve_band(matrix, right) if direct else solve_stencils(stencils, right)
    return control.reshape(num_x, num_y)


@dataclass(frozen=True, slots=True, eq=False)
class Stencils:
    """
    Symmetric matrix of the control points of a grid; see models/kernels/bspline.py for its layout.

    Attributes
    ----------
    shape : (2,) int
        Control points along x and y.
    reach : int
        Largest distance along an axis, in control points, of two that share an entry.
    entries : (n, W) float64
        Row for each control point, y within x.

    """

    shape: tuple[int, int]
    reach: int
    entries: Array

    @classmethod
    def zeros(cls, shape: tuple[int, int], reach: int) -> Stencils:
        """Return a matrix of zeros."""
        columns = reach * (2 * reach + 1) + reach + 1
        return cls(shape, reach, np.zeros((shape[0] * shape[1], columns)))

    @property
    def stride(self) -> int:
        """Columns from a control point to the next along x."""
        return 2 * self.reach + 1

    @property
    def offsets(self) -> npt.NDArray[np.int64]:
        """Difference of the indices of row and column, (W,); 0 for columns beyond the grid."""
        num_y = self.shape[1]
        x, y = np.divmod(np.arange(self.entries.shape[1]) + self.reach, self.stride)
        y -= self.reach
        found: npt.NDArray[np.int64] = np.where(np.abs(y) < num_y, x * num_y + y, 0)
        return found

    def padded(self, values: Array) -> Array:
        """Return a vector (n,) followed by the zeros that the kernels read."""
        return np.concatenate([values, np.zeros(int(self.offsets.max()))])

    def band(self) -> Array:
        """Return the matrix as a band, (n, width)."""
        used, offsets = self.entries.any(axis=0), self.offsets
        band = np.zeros((len(self.entries), int(offsets[used].max()) + 1))
        for k in np.flatnonzero(used):
            band[:, offsets[k]] += self.entries[:, k]  # offsets meet if the grid is narrow
        return band

    def coarser(self) -> Stencils:
        """Return the matrix of half of the control points along both axes."""
        found = self
        for _ in range(2):  # the kernel exchanges the axes
            x, y = found.shape
            halves = Stencils.zeros((y, halved(x)), self.reach)
            coarsen_stencils(found.entries, y, self.reach, halves.entries)
            found = halves
        return found


def is_direct(shape: tuple[int, int], reach: int) -> bool:
    """Return whether a banded solve of the control points (Nx, Ny) of a grid is as fast."""
    number, width = shape[0] * shape[1], reach * (shape[1] + 1)
    return number * width**2 <= MOST_DIRECT or min(shape) < LEAST_SIDE


def halved(number: int) -> int:
    """Return the number of control points along an axis at the next coarser level."""
    return (number + 5) // 2


def refinement(number: int) -> Any:
    """
    Return the sparse matrix (number, halved(number)) that refines a uniform cubic spline.

    Parameters
    ----------
    number : int
        Control points along an axis at the finer level; those with an even index 2 k - 2 are at
        the coarser ones k, of which one lies beyond each end.

    """
    from scipy.sparse import csr_array  # 0.4 s that mapping without models saves

    fine, shift = np.meshgrid(np.arange(number), np.arange(5), indexing='ij')
    share = np.broadcast_to(np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 8.0, fine.shape)
    used = (fine + shift) % 2 == 0
    places = fine[used], (fine[used] + shift[used]) // 2
    return csr_array((share[used], places), shape=(number, halved(number)))


class Multigrid:
    """
    Approximate inverse of a matrix, symmetric and positive definite as the matrix is.

    Parameters
    ----------
    finest : Stencils
        A positive definite matrix.

    """

    def __init__(self, finest: Stencils) -> None:
        from scipy.linalg import cholesky_banded  # seconds to import

        self.levels = [finest]
        while not is_direct(self.levels[-1].shape, finest.reach):
            self.levels.append(self.levels[-1].coarser())
        band = self.levels[-1].band()
        self._factor = cholesky_banded(band.T, overwrite_ab=True, lower=True, check_finite=False)
        self._refinements = [
            tuple(refinement(number) for number in level.shape) for level in self.levels[:-1]
        ]

    def multiply(self, right: Array, k: int = 0) -> Array:
        """Multiply a vector (n,) of level k by its approximate inverse; exact at the coarsest."""
        from scipy.linalg import cho_solve_banded  # seconds to import

        if k == len(self._refinements):
            exact: Array = cho_solve_banded((self._factor, True), right, check_finite=False)
            return exact
        level, number = self.levels[k], len(right)
        padded, offsets = level.padded(right), level.offsets
        x, rest = np.empty_like(padded), np.empty_like(padded)
        relax_forward(level.entries, offsets, padded, x, rest)
        along_x, along_y = self._refinements[k]
        below = along_x.T @ (rest[:number].reshape(level.shape) @ along_y)
        change = self.multiply(below.ravel(), k + 1).reshape(below.shape)
        x[:number] += (along_x @ change @ along_y.T).ravel()
        relax_backward(level.entries, offsets, padded, x, rest)
        return x[:number]


def solve_band(band: Array, right: Array) -> Array:
    """Return the solution (n,) for a band matrix (n, width), which is overwritten."""
    from scipy.linalg import solveh_banded  # seconds to import

    found: Array = solveh_banded(band.T, right, lower=True, check_finite=False, overwrite_ab=True)
    return found


def solve_stencils(matrix: Stencils, right: Array) -> Array:
    """
    Return the solution (n,) within TOLERANCE.

    Parameters
    ----------
    matrix : Stencils
        A positive definite matrix of n control points.
    right : (n,) float64
        Right side of the equations.

    Notes
    -----
    After MOST_STEPS the band is solved instead, with its time and memory.

    """
    found = conjugate_gradients(matrix, right)
    return solve_band(matrix.band(), right) if found is None else found


def conjugate_gradients(matrix: Stencils, right: Array) -> Array | None:
    """Return the solution (n,) for a right side (n,); None if it takes more than MOST_STEPS."""
    multigrid, offsets = Multigrid(matrix), matrix.offsets
    x, residual, number = np.zeros_like(right), right.copy(), len(right)
    change = multigrid.multiply(residual)
    direction = matrix.padded(change)
    product = np.empty_like(direction)
    energy = first = float(residual @ change)
    for _ in range(MOST_STEPS):
        if energy <= TOLERANCE**2 * first:
            return x
        multiply_stencils(matrix.entries, offsets, direction, product)
        length = energy / float(direction @ product)
        x += length * direction[:number]
        residual -= length * product[:number]
        change = multigrid.multiply(residual)
        before, energy = energy, float(residual @ change)
        direction *= energy / before
        direction[:number] += change
    return None
