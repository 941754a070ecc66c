# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Solvers of the normal equations of height fields: banded for small ones, iterative for large ones.

The control points of a grid are counted y within x. A sample depends on W of them, at degree 3
on 16; ``rows`` and ``weights`` (M, W) are those of ``design`` in models/bspline.py. The penalty is
the squared second differences of the control points along both axes.

The band has a column for each control point along three rows of the short side. LAPACK solves it
in 4 ms for 50 x 50 cells and in 40 ms for 100 x 100, but needs 10 s and 2.1 GB for 450 x 450.
Conjugate gradients take the control points near samples only, and keep samples and differences
instead of the matrix.

Source: Golub and Van Loan, Matrix Computations, sections 4.3 (banded Cholesky factorisation) and
11.5 (Jacobi preconditioner).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

MOST_DIRECT = 1e9
"""Multiplications of a banded solve, 40 ms, above which a field is large: 100 x 100 cells."""

LEAST_SIDE = 16
"""Control points along the short side, below which the band is narrow enough at any length."""

MOST_STEPS = 400
"""Most conjugate gradient steps of one fit."""


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


def second_differences(places: Array) -> Array:
    """Return the matrix (N - 2, N) of second differences at (N,) places; 2 for equal steps."""
    steps = np.diff(places)
    before, after = steps[:-1], steps[1:]
    matrix, row = np.zeros((len(places) - 2, len(places))), np.arange(len(places) - 2)
    matrix[row, row] = 2.0 * after / (before + after)
    matrix[row, row + 1] = -2.0
    matrix[row, row + 2] = 2.0 * before / (before + after)
    return matrix


def solve_band(
    samples: FieldSamples, places: tuple[Array, Array], rules: tuple[float, float]
) -> Array:
    """
    Return the control points (Nx, Ny) that minimise squared residuals and the penalty, m.

    Parameters
    ----------
    samples : FieldSamples
        Samples of the field.
    places : (Nx,), (Ny,) float64, m
        Places of the control points along x and y; Ny decides the width of the band.
    rules : (float, float)
        Weight of the penalty, and weight that pulls control points to 0.

    """
    from scipy.linalg import solveh_banded  # seconds to import

    (smoothing, ridge), shape = rules, (len(places[0]), len(places[1]))
    reach = samples.rows[:, -1:] - samples.rows[:, :1] if len(samples.rows) else np.zeros((1, 1))
    width = max(int(reach.max()), 2 * shape[1], 2) + 1
    number = shape[0] * shape[1]
    weighted = samples.weights * samples.share[:, None]
    i, j = np.triu_indices(samples.rows.shape[1])
    place = (samples.rows[:, j] - samples.rows[:, i]) * number + samples.rows[:, i]
    entries = weighted[:, i] * samples.weights[:, j]
    band = np.bincount(place.ravel(), entries.ravel(), width * number)
    grid = band.reshape(width, *shape)
    for axis in range(2):
        second = second_differences(places[axis])
        product, step = second.T @ second, shape[1] if axis == 0 else 1
        for k in range(min(3, shape[axis])):
            along = np.zeros(shape[axis])
            along[: shape[axis] - k] = np.diagonal(product, -k)
            grid[k * step] += smoothing * (along[:, None] if axis == 0 else along)
    grid[0] += ridge
    right = np.bincount(samples.rows.ravel(), (weighted * samples.z[:, None]).ravel(), number)
    found = solveh_banded(
        band.reshape(width, number), right, lower=True, check_finite=False, overwrite_ab=True
    )
    return np.array(found.reshape(shape), np.float64)  # a view would keep the band


def relax(
    samples: FieldSamples,
    places: tuple[Array, Array],
    masks: tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]],
    rules: tuple[float, float, float],
    control: Array,
) -> Array:
    """
    Return control points (Nx, Ny) of which the free ones minimise residuals and the penalty, m.

    Parameters
    ----------
    samples : FieldSamples
        Samples of the field.
    places : (Nx,), (Ny,) float64, m
        Places of the control points along x and y.
    masks : (Nx, Ny), (Nx, Ny) bool
        Active control points, on which the penalty acts, and those of them that are free.
    rules : (float, float, float)
        Weight of the penalty, weight that pulls to 0, and length of the last step, m.
    control : (Nx, Ny) float64, m
        Where conjugate gradients start.

    """
    active, free = (mask.ravel() for mask in masks)
    smoothing, ridge, last_m = rules
    used = free[samples.rows].any(axis=1)
    weight = np.sqrt(samples.share[used])
    rows, values = samples.rows[used], samples.weights[used] * weight[:, None]
    parts = [sparse(rows, values, control.size)]
    parts += differences(places, active, free, np.sqrt(smoothing))
    x = control.ravel().copy()
    place = np.flatnonzero(free)
    residual = -ridge * x[place]
    diagonal, pairs = np.full(len(place), ridge), []
    for number, matrix in enumerate(parts):
        missing = -(matrix @ x)
        missing += samples.z[used] * weight if number == 0 else 0.0
        matrix = matrix[:, place]
        pairs.append((matrix, matrix.T.tocsr()))
        residual += pairs[-1][1] @ missing
        diagonal += np.asarray(matrix.multiply(matrix).sum(axis=0)).ravel()
    x[place] += conjugate_gradients(pairs, residual, diagonal, ridge, last_m)
    return x.reshape(control.shape).copy()


def conjugate_gradients(
    pairs: list[tuple[Any, Any]], residual: Array, diagonal: Array, ridge: float, last_m: float
) -> Array:
    """
    Return the solution (n,) for a right side (n,), which is overwritten.

    Parameters
    ----------
    pairs : list of (sparse matrix, sparse matrix)
        Matrices (M, n), and their transposes: the system is the sum of the squares and the ridge.
    residual, diagonal : (n,) float64
        Right side, and diagonal of the system.
    ridge : float
        Added to the diagonal.
    last_m : float
        Length of the last step.

    """
    x, inverse = np.zeros(len(residual)), 1.0 / diagonal
    direction = residual * inverse
    energy = dot(residual, direction)
    for _ in range(MOST_STEPS):
        product = ridge * direction
        for matrix, transposed in pairs:
            product += transposed @ (matrix @ direction)
        along = dot(direction, product)
        if not along > 0.0:
            break
        length = energy / along
        x += length * direction
        residual -= length * product
        scaled = residual * inverse
        before, energy = energy, dot(residual, scaled)
        if length * float(np.abs(direction).max()) < last_m:
            break
        direction *= energy / before
        direction += scaled
    return x


def dot(a: Array, b: Array) -> float:
    """Return the scalar product of vectors; threads of BLAS wait longer than it takes."""
    return float(np.einsum('i,i->', a, b))


def sparse(rows: Indices, values: Array, number: int) -> Any:
    """Return the sparse matrix (M, number) with values (M, W) in columns rows (M, W)."""
    from scipy.sparse import csr_array  # 0.4 s that mapping without models saves

    ends = np.arange(0, rows.size + 1, rows.shape[1])
    return csr_array((values.ravel(), rows.ravel(), ends), shape=(len(rows), number))


def differences(
    places: tuple[Array, Array],
    active: npt.NDArray[np.bool_],
    free: npt.NDArray[np.bool_],
    factor: float,
) -> list[Any]:
    """Return factor times the second differences of active points, with some free, by axis."""
    shape, found = (len(places[0]), len(places[1])), []
    index = np.arange(shape[0] * shape[1]).reshape(shape)
    for axis in range(2):
        along, step = np.moveaxis(index, axis, 0), shape[1] if axis == 0 else 1
        first, number = along[:-2].ravel(), along.shape[1]
        rows = first[:, None] + step * np.arange(3)
        second = second_differences(places[axis])
        line = np.arange(len(second))[:, None]
        values = np.repeat(second[line, line + np.arange(3)], number, axis=0)
        used = active[rows].all(axis=1) & free[rows].any(axis=1)
        found.append(sparse(rows[used], factor * values[used], index.size))
    return found
