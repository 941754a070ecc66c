# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Moments of groups and of neighbours, and eigenvectors.

One loop takes a tenth of the time of numpy, which needs the coordinates of all neighbours in
memory and a pass for each of two dozen products.
"""

import math

from numba import njit


@njit(cache=True, nogil=True, error_model='numpy')
def group_moments(points, rows, count, mean, covariance, radius):
    """
    Compute the moments of groups of points.

    points      (N, 3) float64, m
    rows        (N,) int32 or int64, group of every point; no group is empty
    count       (M,) int64, in: 0, out: points in each
    mean        (M, 3) float64, in: 0, out, m
    covariance  (6, M) float64, in: 0, out: xx xy xz yy yz zz of scatter / (count - 1), m^2
    radius      (M,) float64, in: 0, out: from the mean to the farthest, m
    """
    for i in range(len(points)):
        row = rows[i]
        count[row] += 1
        for axis in range(3):
            mean[row, axis] += points[i, axis]
    for row in range(len(count)):
        for axis in range(3):
            mean[row, axis] /= count[row]
    for i in range(len(points)):
        row = rows[i]
        x, y = points[i, 0] - mean[row, 0], points[i, 1] - mean[row, 1]
        z = points[i, 2] - mean[row, 2]
        covariance[0, row] += x * x
        covariance[1, row] += x * y
        covariance[2, row] += x * z
        covariance[3, row] += y * y
        covariance[4, row] += y * z
        covariance[5, row] += z * z
        radius[row] = max(radius[row], (x * x + y * y) + z * z)
    for row in range(len(count)):
        radius[row] = math.sqrt(radius[row])
        free = float(max(count[row] - 1, 1))
        for k in range(6):
            covariance[k, row] /= free


@njit(cache=True, nogil=True, error_model='numpy')
def neighbour_moments(points, ids, count, mean, covariance, radius):
    """
    Compute the moments of the neighbours of points.

    points      (N, 3) float64, m
    ids         (P, K) int64, rows of the neighbours, padded by N at the end
    count       (P,) int64, out: number of neighbours
    mean        (P, 3) float64, out, m
    covariance  (6, P) float64, out: xx xy xz yy yz zz of scatter / (count - 1), m^2
    radius      (P,) float64, out: from the mean to the farthest, m
    """
    for i in range(len(ids)):
        number = 0
        sx, sy, sz = 0.0, 0.0, 0.0
        while number < ids.shape[1] and ids[i, number] < len(points):
            row = ids[i, number]
            sx += points[row, 0]
            sy += points[row, 1]
            sz += points[row, 2]
            number += 1
        mx, my, mz = sx / number, sy / number, sz / number
        xx, xy, xz, yy, yz, zz, far_sq = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(number):
            row = ids[i, k]
            x, y, z = points[row, 0] - mx, points[row, 1] - my, points[row, 2] - mz
            xx += x * x
            xy += x * y
            xz += x * z
            yy += y * y
            yz += y * z
            zz += z * z
            far_sq = max(far_sq, (x * x + y * y) + z * z)
        free = float(max(number - 1, 1))
        count[i] = number
        mean[i, 0], mean[i, 1], mean[i, 2] = mx, my, mz
        covariance[0, i], covariance[1, i], covariance[2, i] = xx / free, xy / free, xz / free
        covariance[3, i], covariance[4, i], covariance[5, i] = yy / free, yz / free, zz / free
        radius[i] = math.sqrt(far_sq)


@njit(cache=True, nogil=True, error_model='numpy')
def eigenvectors(matrices, values, smallest, vectors):
    """
    Compute all eigenvectors from those of the smallest eigenvalues.

    matrices  (6, M) float64, symmetric, xx xy xz yy yz zz
    values    (3, M) float64, their eigenvalues, ascending
    smallest  (3, M) float64, unit eigenvectors of values[0]
    vectors   (M, 3, 3) float64, out: vectors[:, k] belong to values[k], are of unit length, and
              their component of largest magnitude is positive; nan if all values are 0

    In the plane orthogonal to the smallest one the matrix is 2 by 2, and its larger eigenvector
    follows from a square root; the third is orthogonal to both.
    """
    for i in range(matrices.shape[1]):
        if not values[2, i] > 0.0:
            vectors[i, :, :] = math.nan
            continue
        xx, xy, xz = matrices[0, i], matrices[1, i], matrices[2, i]
        yy, yz, zz = matrices[3, i], matrices[4, i], matrices[5, i]
        nx, ny, nz = smallest[0, i], smallest[1, i], smallest[2, i]
        # u and w: a basis across n (Duff et al. 2017)
        sign = 1.0 if nz >= 0.0 else -1.0
        a = -1.0 / (sign + nz)
        b = nx * ny * a
        ux, uy, uz = 1.0 + sign * nx * nx * a, sign * b, -sign * nx
        wx, wy, wz = b, sign + ny * ny * a, -ny
        pux, puy = (xx * ux + xy * uy) + xz * uz, (xy * ux + yy * uy) + yz * uz
        puz = (xz * ux + yz * uy) + zz * uz
        pwx, pwy = (xx * wx + xy * wy) + xz * wz, (xy * wx + yy * wy) + yz * wz
        pwz = (xz * wx + yz * wy) + zz * wz
        uu, uw = (ux * pux + uy * puy) + uz * puz, (wx * pux + wy * puy) + wz * puz
        ww = (wx * pwx + wy * pwy) + wz * pwz
        half = 0.5 * (uu - ww)
        scale = max(abs(half), abs(uw))  # squares of tiny numbers underflow
        equal = scale == 0.0  # any direction
        half, uw = (1.0, 0.0) if equal else (half / scale, uw / scale)
        spread = math.sqrt(half * half + uw * uw)
        cosine, sine = half / spread, uw / spread
        # half-angle formulas, scaled
        first = 1.0 + cosine if cosine >= 0.0 else sine
        second = sine if cosine >= 0.0 else 1.0 - cosine
        length = math.sqrt(first * first + second * second)
        first, second = first / length, second / length
        lx, ly, lz = first * ux + second * wx, first * uy + second * wy, first * uz + second * wz
        store(vectors, i, 0, nx, ny, nz)
        store(vectors, i, 1, ny * lz - nz * ly, nz * lx - nx * lz, nx * ly - ny * lx)
        store(vectors, i, 2, lx, ly, lz)


@njit(cache=True, nogil=True, inline='always')
def store(vectors, i, k, x, y, z):
    """Store a vector, turned so that its component of largest magnitude, the first such, > 0."""
    leading = x
    if abs(y) > abs(leading):
        leading = y
    if abs(z) > abs(leading):
        leading = z
    side = -1.0 if leading < 0.0 else 1.0
    vectors[i, k, 0], vectors[i, k, 1], vectors[i, k, 2] = side * x, side * y, side * z
