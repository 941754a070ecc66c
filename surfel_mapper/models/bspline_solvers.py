# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Solvers of the normal equations of height fields: banded for small ones, iterative for large ones.

The control points of a grid are counted y within x. A sample depends on W of them, at degree 3
on 16; ``rows`` and ``weights`` (M, W) are those of ``design`` in models/bspline.py. The penalty is
the squared second differences of the control points along both axes.

The band has a column for each control point along three rows of the short side. LAPACK solves it
in 4 ms for 50 x 50 cells and in 40 ms for 100 x 100, but needs 10 s and 2.1 GB for 450 x 450.
Larger fields are solved by conjugate gradients, for the control points near samples only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.kernels.splines import sum_equations

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
    rows, weights : (M, W) int64, float64
        Control points that each depends on, and their weights.
    z, share : (M,) float64
        Heights, m, and weights of the samples.

    """

    rows: Indices
    weights: Array
    z: Array
    share: Array


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
    samples: FieldSamples, positions: tuple[Array, Array], rules: tuple[float, float]
) -> Array:
    """
    Return the control points (Nx, Ny) that minimise squared residuals and the penalty, m.

    Parameters
    ----------
    samples : FieldSamples
        Samples of the field.
    positions : (Nx,), (Ny,) float64, m
        Positions of the control points along x and y; Ny decides the width of the band.
    rules : (float, float)
        Weight of the penalty, and weight that pulls control points to 0.

    """
    from scipy.linalg.lapack import dpbsv  # seconds to import

    (smoothing, ridge), shape = rules, (len(positions[0]), len(positions[1]))
    reach = samples.rows[:, -1:] - samples.rows[:, :1] if len(samples.rows) else np.zeros((1, 1))
    width = max(int(reach.max()), 2 * shape[1], 2) + 1
    number = shape[0] * shape[1]
    band, right = equations(samples, width, number)
    grid = band.reshape(width, *shape)
    for axis in range(2):
        second = second_differences(positions[axis])
        product, step = second.T @ second, shape[1] if axis == 0 else 1
        for k in range(min(3, shape[axis])):
            along = np.zeros(shape[axis])
            along[: shape[axis] - k] = np.diagonal(product, -k)
            grid[k * step] += smoothing * (along[:, None] if axis == 0 else along)
    grid[0] += ridge
    _, solution, info = dpbsv(band, right, lower=1, overwrite_ab=1)
    assert info == 0, 'the ridge makes the matrix positive'
    return np.array(solution.reshape(shape), np.float64)  # a view would keep the band


def equations(samples: FieldSamples, width: int, number: int) -> tuple[Array, Array]:
    """Return the lower band (width, number) and right side (number,) of the normal equations."""
    band, right = np.zeros((width, number)), np.zeros(number)
    sum_equations(samples.rows, samples.weights, samples.share, samples.z, band, right)
    return band, right


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
    data = sparse(samples.rows, samples.weights * weight[:, None], control.size)
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
