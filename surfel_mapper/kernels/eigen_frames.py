# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Moments of a range of points, and all eigenvectors of their scatter by Jacobi's rotations.

Clusters are split along the largest eigenvector, which eigen3.py does not give; they are few,
so that one at a time and exact to rounding is what counts, at 0.5 us each.

Source: Golub and Van Loan, Matrix Computations, section 8.5.
"""

import math

from numba import njit
import numpy as np

SWEEPS = 12
"""Quadratic convergence needs six; the rest costs nothing where all is done."""


@njit(cache=True, nogil=True, error_model='numpy')
def range_moments(points, low, high, mean, scatter):
    """
    Sum the points of rows low to high - 1, at least one, in one pass about the first of them.

    points   (N, 3) float64
    mean     (3,) float64, out
    scatter  (3, 3) float64, out: sum of outer products of deviations
    """
    number = high - low
    x0, y0, z0 = points[low, 0], points[low, 1], points[low, 2]
    sx = sy = sz = 0.0
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(low, high):
        x, y, z = points[i, 0] - x0, points[i, 1] - y0, points[i, 2] - z0
        sx += x
        sy += y
        sz += z
        xx += x * x
        xy += x * y
        xz += x * z
        yy += y * y
        yz += y * z
        zz += z * z
    mx, my, mz = sx / number, sy / number, sz / number
    xx, yy, zz = max(xx - sx * mx, 0.0), max(yy - sy * my, 0.0), max(zz - sz * mz, 0.0)
    xy, xz, yz = xy - sx * my, xz - sx * mz, yz - sy * mz
    mx, my, mz = x0 + mx, y0 + my, z0 + mz
    mean[0], mean[1], mean[2] = mx, my, mz
    scatter[0, 0], scatter[1, 1], scatter[2, 2] = xx, yy, zz
    scatter[0, 1] = scatter[1, 0] = xy
    scatter[0, 2] = scatter[2, 0] = xz
    scatter[1, 2] = scatter[2, 1] = yz


@njit(cache=True, nogil=True, error_model='numpy')
def eigen_frame(matrix, values, vectors):
    """
    Decompose a symmetric matrix.

    matrix   (3, 3) float64, positive semidefinite; is used up
    values   (3,) float64, out: ascending, none negative
    vectors  (3, 3) float64, out: row k is the unit eigenvector of values[k]
    """
    for i in range(3):
        for j in range(3):
            vectors[i, j] = 1.0 if i == j else 0.0
    size = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    for _ in range(SWEEPS):
        off = abs(matrix[0, 1]) + abs(matrix[0, 2]) + abs(matrix[1, 2])
        if off <= 1e-18 * size:
            break
        for p in range(2):
            for q in range(p + 1, 3):
                rotate(matrix, vectors, p, q)
    for k in range(3):
        values[k] = max(matrix[k, k], 0.0)
    for first, second in ((0, 1), (1, 2), (0, 1)):
        if values[first] > values[second]:
            values[first], values[second] = values[second], values[first]
            for j in range(3):
                kept = vectors[first, j]
                vectors[first, j] = vectors[second, j]
                vectors[second, j] = kept


@njit(cache=True, nogil=True, error_model='numpy')
def rotate(matrix, vectors, p, q):
    """Turn axes p and q so that their product vanishes."""
    product = matrix[p, q]
    if product == 0.0:
        return
    theta = (matrix[q, q] - matrix[p, p]) / (2.0 * product)
    t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
    t = t if theta >= 0.0 else -t
    c = 1.0 / math.sqrt(t * t + 1.0)
    s = t * c
    r = 3 - p - q
    matrix[p, p] -= t * product
    matrix[q, q] += t * product
    matrix[p, q] = matrix[q, p] = 0.0
    rp, rq = matrix[r, p], matrix[r, q]
    matrix[r, p] = matrix[p, r] = c * rp - s * rq
    matrix[r, q] = matrix[q, r] = s * rp + c * rq
    for j in range(3):
        vp, vq = vectors[p, j], vectors[q, j]
        vectors[p, j] = c * vp - s * vq
        vectors[q, j] = s * vp + c * vq


@njit(cache=True, nogil=True, error_model='numpy')
def orient(vectors, mean, viewpoint):
    """
    Make eigenvectors a right-handed frame of which the normal faces the viewpoint.

    vectors  (3, 3) float64, rows ascending by eigenvalue; becomes rows x, y, z of the frame,
             x along the largest with its largest component positive, z the normal
    """
    normal, x = np.empty(3), np.empty(3)
    towards, most = 0.0, 0
    for j in range(3):
        normal[j], x[j] = vectors[0, j], vectors[2, j]
        towards += normal[j] * (viewpoint[j] - mean[j])
        if abs(x[j]) > abs(x[most]):
            most = j
    turn = -1.0 if towards < 0.0 else 1.0
    flip = -1.0 if x[most] < 0.0 else 1.0
    for j in range(3):
        vectors[2, j] = turn * normal[j]
        vectors[0, j] = flip * x[j]
    for j in range(3):
        k, m = (j + 1) % 3, (j + 2) % 3
        vectors[1, j] = vectors[2, k] * vectors[0, m] - vectors[2, m] * vectors[0, k]
