# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Moments of points, and the frames of clusters, facets and surfels from their eigenvectors.

On its own because bisection, patches, growth and the surfels of a map share it.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.symmetric3 import eigen_frame

LEAST_WIDTH = 0.04
"""A surfel with a smaller ratio of the tangential variances is a line: no reliable normal."""


@njit(cache=True, nogil=True, error_model='numpy')
def plane_of(sums, divisor, scatter, value, axes):
    """
    Compute the covariance (3, 3) of moments, its eigenvalues (3,), ascending, and axes (3, 3).

    sums     (10,) float64: number, sums of x y z, xx xy xz yy yz zz
    divisor  of the sums of squared deviations: the number, or one less
    scatter  (3, 3), value (3,), axes (3, 3) float64, out; axes are rows
    """
    n, k = sums[0], 4
    for a in range(3):
        for b in range(a, 3):
            moment = sums[k] - sums[1 + a] * sums[1 + b] / n
            scatter[a, b] = scatter[b, a] = (max(moment, 0.0) if a == b else moment) / divisor
            k += 1
    eigen_frame(scatter, value, axes)


@njit(cache=True, nogil=True, error_model='numpy')
def range_moments(points, low, high, mean, scatter):
    """
    Compute mean and scatter of the points of rows low to high - 1, at least one.

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
def orient(vectors, mean, viewpoint):
    """
    Turn eigenvectors into a right-handed frame whose normal faces the viewpoint.

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
