# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Solvers of the normal equations of height fields: banded for small ones, iterative for large ones.

The control points of a grid are counted y within x. A sample depends on W of them, at degree 3
on 16. The penalty is the squared second differences of the control points along both axes.

The band has a column for each control point along three rows of the short side. LAPACK solves it
in 4 ms for 50 x 50 cells and in 40 ms for 100 x 100, but needs 10 s and 2.1 GB for 450 x 450.
Larger fields are solved by conjugate gradients, for the control points near samples only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.kernels.splines import sum_equations, tensor_heights

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

MOST_DIRECT = 1e9
"""Multiplications of a banded solve, 40 ms, above which a field is large: 100 x 100 cells."""

LEAST_SIDE = 16
"""Control points along the short side, below which the band is narrow enough at any length."""

ACCURACY, MOST_STEPS = 1e-7, 400
"""Relative residual at which conjugate gradients end, and their largest number of steps."""


@dataclass(frozen=True, slots=True, eq=False)
class FieldSamples:
    """
    M samples of a height field.

    Attributes
    ----------
    bases : tuple
        Along x: first control point (M,) int64 that each depends on, and weights (M, degree + 1)
        float64 of these; the same along y.
    z, share : (M,) float64
        Heights, m, and weights of the samples.

    """

    bases: tuple[Indices, Array, Indices, Array]
    z: Array
    share: Array

    def transposed(self) -> FieldSamples:
        """Return the samples with x and y exchanged."""
        return FieldSamples((*self.bases[2:], *self.bases[:2]), self.z, self.share)

    def heights(self, control: Array) -> Array:
        """Return the heights (M,) of the field of control points (Nx, Ny) at the samples, m."""
        result = np.empty(len(self.z))
        tensor_heights(*self.bases, control, result)
        return result

    def design(self, num_y: int) -> tuple[Indices, Array]:
        """
        Return the rows of the design matrix, given the number of control points along y.

        Indices (M, W) int64 of the control points, y within x, and their weights (M, W) float64.
        """
        first_x, x, first_y, y = self.bases
        along_x, along_y = (np.arange(weights.shape[1]) for weights in (x, y))
        rows = (first_x[:, None] + along_x)[:, :, None] * num_y
        rows = rows + (first_y[:, None] + along_y)[:, None]
        weights = x[:, :, None] * y[:, None]
        return rows.reshape(len(x), -1), weights.reshape(len(x), -1)


def is_direct(shape: tuple[int, ...], reach: int) -> bool:
    """Return whether the control points (Nx, Ny) of a grid are solved as a band."""
    number, width = shape[0] * shape[1], reach * (shape[1] + 1)
    return number * width**2 <= MOST_DIRECT or min(shape) < LEAST_SIDE


def second_differences(positions: Array) -> Array:
    """Return the matrix (N - 2, N) of second differences at (N,) positions; 2 for equal steps."""
    steps = np.diff(positions)
    first, second = steps[:-1], steps[1:]
    matrix, row = np.zeros((len(positions) - 2, len(positions))), np.arange(len(positions) - 2)
    matrix[row, row] = 2.0 * second / (first + second)
    matrix[row, row + 1] = -2.0
    matrix[row, row + 2] = 2.0 * first / (first + second)
    return matrix


def solve_band(
    samples: FieldSamples, penalties: tuple[Array, Array], rules: tuple[float, float]
) -> Array:
    """
    Return the control points (Nx, Ny) that minimise squared residuals and the penalty, m.

    Parameters
    ----------
    samples : FieldSamples
        Samples of the field.
    penalties : (3, Nx), (3, Ny) float64
        Diagonals of the penalty along x and y; Ny decides the width of the band.
    rules : (float, float)
        Weight of the penalty, and weight that pulls control points to 0.

    """
    from scipy.linalg.lapack import dpbsv  # seconds to import

    (smoothing, ridge), (along_x, along_y) = rules, penalties
    num_x, num_y, (_, x, _, y) = along_x.shape[1], along_y.shape[1], samples.bases
    width = max((x.shape[1] - 1) * num_y + y.shape[1], 2 * num_y + 1, 3)
    band, right = np.zeros((num_x * num_y, width)), np.zeros(num_x * num_y)
    sum_equations(samples.bases, samples.share, samples.z, num_y, band, right)
    grid = band.reshape(num_x, num_y, width)
    for k in range(3):
        grid[:, :, k * num_y] += smoothing * along_x[k][:, None]
        grid[:, :, k] += smoothing * along_y[k]
    grid[:, :, 0] += ridge
    _, solution, info = dpbsv(band.T, right, lower=1, overwrite_ab=1)
    assert info == 0, 'the ridge makes the matrix positive'
    return np.array(solution.reshape(num_x, num_y), np.float64)  # a view would keep the band


def relax(
    samples: FieldSamples,
    positions: tuple[Array, Array],
    active: npt.NDArray[np.bool_],
    rules: tuple[float, float],
    control: Array,
) -> Array:
    """
    Return the control points (Nx, Ny) of which the active ones minimise residuals and penalty, m.

    Parameters
    ----------
    samples : FieldSamples
        Samples of the field.
    positions : (Nx,), (Ny,) float64, m
        Positions of the control points along x and y.
    active : (Nx, Ny) bool
        Control points on which samples depend; the penalty acts on these.
    rules : (float, float)
        Weight of the penalty, and weight that pulls to 0.
    control : (Nx, Ny) float64, m
        Where conjugate gradients start.

    """
    from scipy.sparse import diags_array, vstack  # 0.4 s that mapping without models saves
    from scipy.sparse.linalg import cg

    (smoothing, ridge), weight = rules, np.sqrt(samples.share)
    rows, weights = samples.design(control.shape[1])
    data = sparse(rows, weights * weight[:, None], control.size)
    matrices = [data, *differences(positions, active, np.sqrt(smoothing))]
    free = np.flatnonzero(active)
    design = vstack(matrices, format='csr')[:, free]
    matrix = design.T @ design + ridge * diags_array(np.ones(len(free)))
    right = data[:, free].T @ (samples.z * weight)
    jacobi = diags_array(1.0 / matrix.diagonal())
    start = control.ravel()[free]
    solution, _ = cg(matrix, right, start, rtol=ACCURACY, maxiter=MOST_STEPS, M=jacobi)
    result = control.copy()
    result.ravel()[free] = solution
    return result


def sparse(rows: Indices, values: Array, number: int) -> Any:
    """Return the sparse matrix (M, number) with values (M, W) in columns rows (M, W)."""
    from scipy.sparse import csr_array  # 0.4 s that mapping without models saves

    ends = np.arange(0, rows.size + 1, rows.shape[1])
    return csr_array((values.ravel(), rows.ravel(), ends), shape=(len(rows), number))


def differences(
    positions: tuple[Array, Array], active: npt.NDArray[np.bool_], factor: float
) -> list[Any]:
    """Return factor times the second differences of active points, by axis."""
    shape, matrices = (len(positions[0]), len(positions[1])), []
    index = np.arange(shape[0] * shape[1]).reshape(shape)
    for axis in range(2):
        along, step = np.moveaxis(index, axis, 0), shape[1] if axis == 0 else 1
        first, number = along[:-2].ravel(), along.shape[1]
        rows = first[:, None] + step * np.arange(3)
        second = second_differences(positions[axis])
        line = np.arange(len(second))[:, None]
        values = np.repeat(second[line, line + np.arange(3)], number, axis=0)
        used = active.ravel()[rows].all(axis=1)
        matrices.append(sparse(rows[used], factor * values[used], index.size))
    return matrices
