# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Moments of groups of points and of neighbours.

One loop takes a tenth of the time of numpy, which needs the coordinates of all neighbours in
memory and a pass for each of two dozen products.
"""

import math

from numba import njit
import numpy as np


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
def neighbour_moments(xs, ys, zs, near, count, mean, covariance, radius):
    """
    Compute the moments of the neighbours of points.

    xs, ys, zs  (N,) float64, m
    near        (M, K) int32, indices of the neighbours in these, padded by N at the end
    count       (M,) int64, out: number of neighbours
    mean        (M, 3) float64, out, m
    covariance  (6, M) float64, out: xx xy xz yy yz zz of scatter / (count - 1), m^2
    radius      (M,) float64, out: from the mean to the farthest, m
    """
    for i in range(np.uint64(len(near))):
        number = np.uint64(near.shape[1])
        while number > np.uint64(0) and near[i, number - np.uint64(1)] == len(xs):
            number -= np.uint64(1)
        sx, sy, sz = 0.0, 0.0, 0.0
        for k in range(number):
            index = np.uint64(near[i, k])
            sx += xs[index]
            sy += ys[index]
            sz += zs[index]
        num = np.float64(number)
        mx, my, mz = sx / num, sy / num, sz / num
        xx, xy, xz, yy, yz, zz, far_sq = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(number):
            index = np.uint64(near[i, k])
            x, y, z = xs[index] - mx, ys[index] - my, zs[index] - mz
            xx += x * x
            xy += x * y
            xz += x * z
            yy += y * y
            yz += y * z
            zz += z * z
            far_sq = max(far_sq, (x * x + y * y) + z * z)
        share = 1.0 / max(num - 1.0, 1.0)
        count[i] = np.int64(number)
        mean[i, 0], mean[i, 1], mean[i, 2] = mx, my, mz
        covariance[0, i], covariance[1, i] = xx * share, xy * share
        covariance[2, i], covariance[3, i] = xz * share, yy * share
        covariance[4, i], covariance[5, i] = yz * share, zz * share
        radius[i] = math.sqrt(far_sq)
