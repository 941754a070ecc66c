# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Moments of points, and the frames of clusters, facets and surfels from their eigenvectors.

Source: Golub and Van Loan, Matrix Computations, section 8.5 (Jacobi's method).
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel

NOISE = 1e-15
"""Eigenvalues below this share of the trace are rounding errors, and become 0."""

MOST_SWEEPS = 8
"""Jacobi rotations of each pair of axes; the error is squared with each, so five suffice."""

LEAST_WIDTH = 0.04
"""A surfel with a smaller ratio of the tangential variances is a line: no reliable normal."""


@inlined(error_model='numpy')
def rotate_axes(matrix, vectors, p, q):
    """Turn two axes so that element p, q of a matrix becomes 0; vectors are turned alike."""
    theta = 0.5 * (matrix[q, q] - matrix[p, p]) / matrix[p, q]
    tangent = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
    tangent = -tangent if theta < 0.0 else tangent
    cosine = 1.0 / math.sqrt(tangent * tangent + 1.0)
    sine = tangent * cosine
    matrix[p, p] -= tangent * matrix[p, q]
    matrix[q, q] += tangent * matrix[p, q]
    r = 3 - p - q
    a, b = matrix[r, p], matrix[r, q]
    matrix[p, q] = matrix[q, p] = 0.0
    matrix[r, p] = matrix[p, r] = cosine * a - sine * b
    matrix[r, q] = matrix[q, r] = sine * a + cosine * b
    for j in range(3):
        a, b = vectors[p, j], vectors[q, j]
        vectors[p, j], vectors[q, j] = cosine * a - sine * b, sine * a + cosine * b


@kernel(error_model='numpy')
def eigen_frame(matrix, values, vectors):
    """
    Decompose one matrix by Jacobi rotations.

    matrix   (3, 3) float64, symmetric, positive semidefinite; is overwritten
    values   (3,) float64, out: ascending, none negative
    vectors  (3, 3) float64, out: row k is the unit eigenvector of values[k], its component of
             largest magnitude positive; the identity if all values are 0

    kernels/symmetric3.py is faster for many matrices, but compiles five times as long, and each
    kernel that calls this compiles it.
    """
    for i in range(3):
        for j in range(3):
            vectors[i, j] = 1.0 if i == j else 0.0
    noise = NOISE * (matrix[0, 0] + matrix[1, 1] + matrix[2, 2])
    zeros = 0
    for turn in range(3 * MOST_SWEEPS):
        p, q = turn % 3, (turn + 1) % 3
        if abs(matrix[p, q]) > 1e-3 * noise:
            rotate_axes(matrix, vectors, p, q)
            zeros = 0
        zeros += 1
        if zeros == 3:
            break
    for i in range(3):
        values[i] = matrix[i, i] if matrix[i, i] >= noise else 0.0
    for turn in range(3):
        i = turn % 2
        if values[i] > values[i + 1]:
            values[i], values[i + 1] = values[i + 1], values[i]
            for j in range(3):
                vectors[i, j], vectors[i + 1, j] = vectors[i + 1, j], vectors[i, j]
    for i in range(3):
        leading = 0.0
        for j in range(3):
            leading = vectors[i, j] if abs(vectors[i, j]) > abs(leading) else leading
        for j in range(3):
            vectors[i, j] = -vectors[i, j] if leading < 0.0 else vectors[i, j]


@kernel(error_model='numpy')
def eigen_frames(matrices, values, vectors):
    """Decompose matrices (K, 3, 3) into values (K, 3) and vectors (K, 3, 3) by eigen_frame."""
    for k in range(len(matrices)):
        eigen_frame(matrices[k], values[k], vectors[k])


@kernel(error_model='numpy')
def plane_of(sums, divisor, value, axes):
    """
    Compute the eigenvalues (3,) of the covariance of moments, ascending, and axes (3, 3) as rows.

    sums     (10,) float64: number, sums of x y z, xx xy xz yy yz zz
    divisor  of the sums of squared deviations: the number, or one less
    value    (3,), axes (3, 3) float64, out
    """
    scatter, n, k = np.empty((3, 3)), sums[0], 4
    for a in range(3):
        for b in range(a, 3):
            moment = sums[k] - sums[1 + a] * sums[1 + b] / n
            moment = max(moment, 0.0) if a == b else moment
            scatter[a, b] = scatter[b, a] = moment / divisor
            k += 1
    eigen_frame(scatter, value, axes)


@kernel(error_model='numpy')
def group_scatters(points, weights, starts, totals, means, scatters):
    """
    Sum the moments of groups of points, each about its first point, and move them to the mean.

    points    (N, 3) float64; group k has the rows starts[k] to starts[k + 1] - 1
    weights   (N,) float64
    starts    (K + 1,) int64
    totals    (K,) float64, out: weights
    means     (K, 3) float64, out: 0 without weight
    scatters  (K, 3, 3) float64, out: weighted sums of outer products of deviations
    """
    for k in range(len(starts) - 1):
        low = starts[k]
        s = sx = sy = sz = 0.0
        xx = xy = xz = yy = yz = zz = 0.0
        for i in range(low, starts[k + 1]):
            x, y, z = (
                points[i, 0] - points[low, 0],
                points[i, 1] - points[low, 1],
                points[i, 2] - points[low, 2],
            )
            w = weights[i]
            u, v, t = w * x, w * y, w * z
            s += w
            sx += u
            sy += v
            sz += t
            xx += u * x
            xy += u * y
            xz += u * z
            yy += v * y
            yz += v * z
            zz += t * z
        totals[k], means[k], scatters[k] = s, 0.0, 0.0
        if s > 0.0:
            x, y, z = sx / s, sy / s, sz / s
            means[k, 0], means[k, 1] = points[low, 0] + x, points[low, 1] + y
            means[k, 2] = points[low, 2] + z
            scatters[k, 0, 0] = max(xx - sx * x, 0.0)
            scatters[k, 1, 1] = max(yy - sy * y, 0.0)
            scatters[k, 2, 2] = max(zz - sz * z, 0.0)
            scatters[k, 0, 1] = scatters[k, 1, 0] = xy - sx * y
            scatters[k, 0, 2] = scatters[k, 2, 0] = xz - sx * z
            scatters[k, 1, 2] = scatters[k, 2, 1] = yz - sy * z
