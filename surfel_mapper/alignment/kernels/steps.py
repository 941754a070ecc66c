# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A Gauss-Newton step from its normal equations.

A search takes 35 steps a scan, each on a few numbers: in numpy a step took 120 us, most of it the
overhead of calls, here 10. Eigenvalues come from Jacobi's rotations, whose bits do not depend on
the linear algebra of the machine.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel

SWEEPS = 30
"""Limit of the sweeps of Jacobi's rotations; six are usual."""

SMALL = 1e-30
"""Squared sum of the entries beside the diagonal, relative to the trace, that counts as 0."""


@kernel(error_model='numpy')
def solve_step(hessian, gradient, least, step, values, vectors):
    """
    Solve normal equations in the directions that have enough information.

    hessian   (6, 6) float64, for position (m) and rotation (rad)
    gradient  (6,) float64
    least     float64, smallest eigenvalue of a determined direction
    step      (6,) float64, out
    values    (6,) float64, out: eigenvalues, ascending, scaled so that those of position sum to 1
              and those of rotation too; 0 without any information
    vectors   (6, 6) float64, out: a row for each eigenvalue, a unit vector, rotations scaled

    Returns the scale of rotations, m.
    """
    for i in range(6):
        step[i] = values[i] = 0.0
        for j in range(6):
            vectors[i, j] = 1.0 if i == j else 0.0
    weight = hessian[0, 0] + hessian[1, 1] + hessian[2, 2]
    if not weight > 0.0:
        return 1.0
    radius = math.sqrt((hessian[3, 3] + hessian[4, 4] + hessian[5, 5]) / weight)
    if not radius > 0.0:
        radius = 1.0
    scale, matrix = np.empty(6), np.empty((6, 6))
    for i in range(6):
        scale[i] = 1.0 if i < 3 else radius
    for i in range(6):
        for j in range(6):
            matrix[i, j] = hessian[i, j] / (weight * scale[i] * scale[j])
    diagonalise(matrix, vectors)
    sort_eigenvalues(matrix, values, vectors)
    for i in range(6):
        if values[i] < least:
            continue
        along = 0.0
        for j in range(6):
            along += vectors[i, j] * gradient[j] / (weight * scale[j])
        for j in range(6):
            step[j] -= along / values[i] * vectors[i, j] / scale[j]
    return radius


@inlined(error_model='numpy')
def sort_eigenvalues(matrix, values, vectors):
    """Write the diagonal (N,) of a matrix in ascending order; sort the rows of vectors alike."""
    for i in range(len(values)):
        values[i] = matrix[i, i]
        k = i
        while k > 0 and values[k - 1] > values[k]:
            values[k - 1], values[k] = values[k], values[k - 1]
            for j in range(len(values)):
                vectors[k - 1, j], vectors[k, j] = vectors[k, j], vectors[k - 1, j]
            k -= 1


@inlined(error_model='numpy')
def diagonalise(matrix, vectors):
    """
    Rotate a symmetric matrix until it is diagonal, in place (Jacobi 1846).

    matrix   (N, N) float64, in and out
    vectors  (N, N) float64, in: the identity; out: a row for each entry of the diagonal
    """
    size = len(matrix)
    trace = 0.0
    for i in range(size):
        trace += abs(matrix[i, i])
    for _ in range(SWEEPS):
        beside = 0.0
        for i in range(size):
            for j in range(i):
                beside += matrix[i, j] * matrix[i, j]
        if not beside > SMALL * trace * trace:
            break
        for i in range(size - 1):
            for j in range(i + 1, size):
                if matrix[i, j] != 0.0:
                    rotate(matrix, vectors, i, j)


@inlined(error_model='numpy')
def rotate(matrix, vectors, i, j):
    """Rotate a symmetric matrix (N, N) so that its entry i, j is 0, and the rows of vectors."""
    cotangent = (matrix[j, j] - matrix[i, i]) / (2.0 * matrix[i, j])
    tangent = 1.0 / (abs(cotangent) + math.sqrt(cotangent * cotangent + 1.0))
    if cotangent < 0.0:
        tangent = -tangent
    cosine = 1.0 / math.sqrt(tangent * tangent + 1.0)
    sine = tangent * cosine
    for k in range(len(matrix)):
        a, b = matrix[k, i], matrix[k, j]
        matrix[k, i], matrix[k, j] = cosine * a - sine * b, sine * a + cosine * b
    for k in range(len(matrix)):
        a, b = matrix[i, k], matrix[j, k]
        matrix[i, k], matrix[j, k] = cosine * a - sine * b, sine * a + cosine * b
        a, b = vectors[i, k], vectors[j, k]
        vectors[i, k], vectors[j, k] = cosine * a - sine * b, sine * a + cosine * b
    matrix[i, j] = matrix[j, i] = 0.0
