# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A Gauss-Newton step from its normal equations, and the pose it leads to.

A search takes 35 steps a scan, each on a few numbers: in numpy a step took 120 us, most of it the
overhead of calls, here 10. Eigenvalues come from Jacobi's rotations, whose bits do not depend on
the linear algebra of the machine.
"""

import math

from numba import njit
import numpy as np

SWEEPS = 30
"""Limit of the sweeps of Jacobi's rotations; six are usual."""

SMALL = 1e-30
"""Squared sum of the entries beside the diagonal, relative to the trace, that counts as 0."""


@njit(cache=True, nogil=True)
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
    step[:] = 0.0
    values[:] = 0.0
    vectors[:] = np.eye(6)
    weight = hessian[0, 0] + hessian[1, 1] + hessian[2, 2]
    if not weight > 0.0:
        return 1.0
    radius = math.sqrt((hessian[3, 3] + hessian[4, 4] + hessian[5, 5]) / weight)
    if not radius > 0.0:
        radius = 1.0
    scale = np.array([1.0, 1.0, 1.0, radius, radius, radius])
    matrix = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            matrix[i, j] = hessian[i, j] / (weight * scale[i] * scale[j])
    diagonalise(matrix, vectors)
    order = np.argsort(np.diag(matrix))
    rows = vectors.copy()
    for i in range(6):
        values[i] = matrix[order[i], order[i]]
        vectors[i] = rows[order[i]]
        if values[i] < least:
            continue
        along = 0.0
        for j in range(6):
            along += vectors[i, j] * gradient[j] / (weight * scale[j])
        for j in range(6):
            step[j] -= along / values[i] * vectors[i, j] / scale[j]
    return radius


@njit(cache=True, nogil=True)
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
            return
        for i in range(size - 1):
            for j in range(i + 1, size):
                rotate(matrix, vectors, i, j)


@njit(cache=True, nogil=True)
def rotate(matrix, vectors, i, j):
    """Rotate a symmetric matrix (N, N) so that its entry i, j is 0, and the rows of vectors."""
    if matrix[i, j] == 0.0:
        return
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


@njit(cache=True, nogil=True)
def move_pose(pose, step, moved):
    """
    Move a pose by step[:3] and turn it in place by the rotation vector step[3:].

    pose   (4, 4) float64
    step   (6,) float64, m and rad
    moved  (4, 4) float64, out; its rotation is orthonormal to rounding
    """
    x, y, z = step[3], step[4], step[5]
    angle = math.sqrt(x * x + y * y + z * z)
    a, b = 1.0, 0.5  # sin(angle) / angle, (1 - cos(angle)) / angle^2
    if angle > 1e-8:
        half = math.sin(0.5 * angle) / angle
        a, b = math.sin(angle) / angle, 2.0 * half * half
    turn = np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )
    for i in range(3):
        for j in range(3):
            moved[i, j] = (
                turn[i, 0] * pose[0, j] + turn[i, 1] * pose[1, j] + turn[i, 2] * pose[2, j]
            )
        moved[i, 3] = pose[i, 3] + step[i]
        moved[3, i] = 0.0
    moved[3, 3] = 1.0
    orthonormalise(moved)


@njit(cache=True, nogil=True)
def orthonormalise(pose):
    """Make the rotation of a pose (4, 4), which is off by rounding, orthonormal, in place."""
    for i in range(2):
        for k in range(i):
            along = 0.0
            for j in range(3):
                along += pose[i, j] * pose[k, j]
            for j in range(3):
                pose[i, j] -= along * pose[k, j]
        norm = math.sqrt(pose[i, 0] ** 2 + pose[i, 1] ** 2 + pose[i, 2] ** 2)
        for j in range(3):
            pose[i, j] /= norm
    pose[2, 0] = pose[0, 1] * pose[1, 2] - pose[0, 2] * pose[1, 1]
    pose[2, 1] = pose[0, 2] * pose[1, 0] - pose[0, 0] * pose[1, 2]
    pose[2, 2] = pose[0, 0] * pose[1, 1] - pose[0, 1] * pose[1, 0]
