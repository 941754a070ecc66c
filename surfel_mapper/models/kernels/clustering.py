# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Bisect a cloud until every cluster is flat, or too small to go on.

Rows are dealt from one buffer to another, so that a cluster is a range of rows and its children
are the two parts of it. Large clusters are split by 2-means, small ones by a mixture of two
Gaussians: both begin with the halves across the largest eigenvector, so nothing is random. The
smaller child is worked on first, which bounds the stack by the logarithm of the number of points.

Source: Gao and Dong 2025 (A Real-Time Multi-Model Parametric Representation of Point Clouds)
for the tests; the density test divides by how many voxels a plane of that direction crosses.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.symmetric3 import eigen_frame
from surfel_mapper.models.kernels.frames import orient
from surfel_mapper.models.kernels.halving import (
    cluster_moments,
    count_beyond,
    deal,
    MEANS_SAMPLE,
    num_outliers,
    split_means,
)
from surfel_mapper.models.kernels.mixture import split_mixture

MAX_DEPTH = 66

NOISE_SPREAD = 1.5
"""
A noisy wall is so much thicker after thinning, which leaves as much in its tails as in its middle:
with 1 a wall at 4.5 m of a Kinect falls into a hundred blobs of any direction at 3 cm.
"""

MEAN_CROSSED = 1.5
"""|n_x| + |n_y| + |n_z| of a normal, on average over all directions."""


@njit(cache=True, nogil=True, error_model='numpy')
def bisect(points, viewpoint, rules, moved, order, rows, flat, means, values, frames):
    """
    Cluster points; return how many clusters there are.

    points     (N, 3) float64, m
    viewpoint  (3,) float64
    rules      (a, r_min, most_em, least, outliers, n0, n2, oriented): see flatness
    moved      (N, 3) float64, out: the points by cluster
    order      (N,) int64, out: the row that each had
    rows       (N, 2) int64, out: first row of each cluster, and the one after its last; the
               clusters are in no order
    flat       (N,) bool, out
    means      (N, 3) float64, out
    values     (N, 3) float64, out: eigenvalues of the covariance, ascending
    frames     (N, 3, 3) float64, out: rows x, y, normal
    """
    total = len(points)
    stack = np.empty((MAX_DEPTH, 3), np.int64)
    buffers, orders = np.empty((2, 3, total)), np.empty((2, total), np.int32)
    share, scratch = np.empty(total), np.empty((4, MEANS_SAMPLE))
    mean, value = np.empty(3), np.empty(3)
    scatter, frame = np.empty((3, 3)), np.empty((3, 3))
    depth, num = 0, 0
    for i in range(total):
        for j in range(3):
            buffers[0, j, i] = points[i, j]
        orders[0, i] = i
    if total > 0:
        stack[0, 0], stack[0, 1], stack[0, 2] = 0, total, 0
        depth = 1
    while depth > 0:
        depth -= 1
        low, high, own = stack[depth, 0], stack[depth, 1], stack[depth, 2]
        x, y, z = buffers[own, 0, low:high], buffers[own, 1, low:high], buffers[own, 2, low:high]
        cluster_moments(x, y, z, mean, scatter)
        divisor = max(high - low - 1, 1)
        for i in range(3):
            for j in range(3):
                scatter[i, j] /= divisor
        eigen_frame(scatter, value, frame)
        orient(frame, mean, viewpoint)
        is_flat = flatness(x, y, z, mean, value, frame, viewpoint, rules)
        middle = high
        if not is_flat and high - low >= max(rules[3], 4.0):
            parts = share[low:high]
            middle = high - split_means(x, y, z, mean, value, frame, parts, scratch)
            if high - low <= rules[2]:
                split_mixture(x, y, z, mean, parts)
                middle = high - count_beyond(parts)
        if middle - low < 2 or high - middle < 2:
            for i in range(low, high):
                for j in range(3):
                    moved[i, j] = buffers[own, j, i]
                order[i] = orders[own, i]
            rows[num, 0], rows[num, 1] = low, high
            flat[num] = is_flat
            means[num] = mean
            values[num] = value
            frames[num] = frame
            num += 1
            continue
        other = 1 - own
        deal(buffers[own], orders[own], low, middle, high, share, buffers[other], orders[other])
        smaller_last = middle - low > high - middle
        for part in range(2):
            left = (part == 0) == smaller_last
            stack[depth, 0] = low if left else middle
            stack[depth, 1] = middle if left else high
            stack[depth, 2] = other
            depth += 1
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def flatness(x, y, z, mean, value, frame, viewpoint, rules):
    """
    Return whether a cluster is thin, dense and without outliers, and so a piece of a plane.

    rules  a         voxel size, m
           r_min     least density: 2 is a full sheet
           most_em, least
           outliers  share of points allowed beyond three sigma
           n0, n2    sigma of the sensor is n0 + n2 range^2, m
           oriented  whether density is by the voxels that a plane of this direction crosses,
                     and what is no wider than a plane is thick counts as a line
    """
    a, r_min, _, _, outliers, n0, n2, oriented = rules
    number = len(x)
    e0, e1, e2 = value[0], value[1], value[2]
    range_sq = 0.0
    for j in range(3):
        range_sq += (mean[j] - viewpoint[j]) ** 2
    noise = NOISE_SPREAD * (n0 + n2 * range_sq)
    thick_sq = a * a + 36.0 * noise * noise
    if number < 4 or e1 <= 1e-12 * e2 or (oriented and 36.0 * e1 < thick_sq):
        return False
    if not 36.0 * e0 < thick_sq:
        return False
    crossed = 1.0
    if oriented:
        crossed = (abs(frame[2, 0]) + abs(frame[2, 1]) + abs(frame[2, 2])) / MEAN_CROSSED
    if not number * a * a > math.pi * r_min * r_min * math.sqrt(e1 * e2) * crossed:
        return False
    return num_outliers(x, y, z, mean, value, frame) <= outliers * number
