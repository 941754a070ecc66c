# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Bisect a cloud until every cluster is flat, or too small to go on.

Rows are partitioned in place, so that a cluster is a range of rows and its children are the two
parts of it. Large clusters are split by 2-means, small ones by a mixture of two Gaussians: both
begin with the halves across the largest eigenvector, so nothing is random. The smaller child
is worked on first, which bounds the stack by the logarithm of the number of points.

Source: Gao and Dong 2025 (A Real-Time Multi-Model Parametric Representation of Point Clouds)
for the tests; the density test divides by how many voxels a plane of that direction crosses.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.eigen_frames import eigen_frame, orient, range_moments
from surfel_mapper.kernels.mixture import split_mixture

MAX_DEPTH = 66
MEANS_ITERATIONS = 10
MEANS_SAMPLE = 2048
"""The means of more points are those of every so many of them that about so many are left."""

SETTLED_SHARE = 0.002
"""2-means ends when fewer points than this change sides."""

THREE_SIGMA_SQ = 9.0
NOISE_SPREAD = 1.5
"""
A noisy wall is so much thicker after thinning, which leaves as much in its tails as in its middle:
with 1 a wall at 4.5 m of a Kinect falls into a hundred blobs of any direction at 3 cm.
"""

MEAN_CROSSED = 1.5
"""|n_x| + |n_y| + |n_z| of a normal, on average over all directions."""


@njit(cache=True, nogil=True, error_model='numpy')
def bisect(points, order, viewpoint, rules, rows, flat, means, values, frames):
    """
    Cluster points; return how many clusters there are.

    points     (N, 3) float64, m; rows are reordered
    order      (N,) int64, reordered likewise
    viewpoint  (3,) float64
    rules      (a, r_min, most_em, least, outliers, n0, n2, oriented): see flatness
    rows       (N, 2) int64, out: first row of each cluster, and the one after its last; the
               clusters are in no order
    flat       (N,) bool, out
    means      (N, 3) float64, out
    values     (N, 3) float64, out: eigenvalues of the covariance, ascending
    frames     (N, 3, 3) float64, out: rows x, y, normal
    """
    total = len(points)
    stack = np.empty((MAX_DEPTH, 2), np.int64)
    side, spare = np.empty(total, np.uint8), np.empty((total, 4))
    share = np.empty(total)
    mean, value = np.empty(3), np.empty(3)
    scatter, frame = np.empty((3, 3)), np.empty((3, 3))
    depth, num = 0, 0
    if total > 0:
        stack[0, 0], stack[0, 1] = 0, total
        depth = 1
    while depth > 0:
        depth -= 1
        low, high = stack[depth, 0], stack[depth, 1]
        range_moments(points, low, high, mean, scatter)
        divisor = max(high - low - 1, 1)
        for i in range(3):
            for j in range(3):
                scatter[i, j] /= divisor
        eigen_frame(scatter, value, frame)
        orient(frame, mean, viewpoint)
        is_flat = flatness(points, low, high, mean, value, frame, viewpoint, rules)
        middle = low
        if not is_flat and high - low >= max(rules[3], 4.0):
            split_means(points, low, high, mean, value, frame, side)
            if high - low <= rules[2]:
                split_mixture(points, low, high, mean, side, share)
            middle = partition(points, order, low, high, side, spare)
        if middle - low < 2 or high - middle < 2:
            rows[num, 0], rows[num, 1] = low, high
            flat[num] = is_flat
            means[num] = mean
            values[num] = value
            frames[num] = frame
            num += 1
            continue
        smaller_last = middle - low > high - middle
        for part in range(2):
            left = (part == 0) == smaller_last
            stack[depth, 0] = low if left else middle
            stack[depth, 1] = middle if left else high
            depth += 1
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def flatness(points, low, high, mean, value, frame, viewpoint, rules):
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
    number = high - low
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
    return num_outliers(points, low, high, mean, value, frame) <= outliers * number


@njit(cache=True, nogil=True, error_model='numpy')
def num_outliers(points, low, high, mean, value, frame):
    """Return how many points are beyond three sigma; rounding across an exact plane is none."""
    e0 = max(value[0], 1e-12 * value[2])
    mx, my, mz = mean[0], mean[1], mean[2]
    found = 0
    for i in range(low, high):
        x, y, z = points[i, 0] - mx, points[i, 1] - my, points[i, 2] - mz
        u = frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z
        v = frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z
        w = frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z
        found += (u * u / value[2] + v * v / value[1] + w * w / e0) >= THREE_SIGMA_SQ
    return found


@njit(cache=True, nogil=True, error_model='numpy')
def partition(points, order, low, high, side, spare):
    """Bring the rows of side 0 before those of side 1, each in order; return the first of 1."""
    place, kept = low, 0
    for i in range(low, high):
        if side[i] == 0:
            for j in range(3):
                points[place, j] = points[i, j]
            order[place] = order[i]
            place += 1
        else:
            for j in range(3):
                spare[kept, j] = points[i, j]
            spare[kept, 3] = order[i]
            kept += 1
    for i in range(kept):
        for j in range(3):
            points[place + i, j] = spare[i, j]
        order[place + i] = np.int64(spare[i, 3])
    return place


@njit(cache=True, nogil=True, error_model='numpy')
def split_means(points, low, high, mean, value, frame, side):
    """
    Put each point on the side of the nearer of two means, which begin on the long axis.

    The means of many points follow from every so many of them.
    """
    reach = math.sqrt(2.0 * value[2] / math.pi)
    ax, ay, az = reach * frame[0, 0], reach * frame[0, 1], reach * frame[0, 2]
    centre = np.empty((2, 3))
    for k in range(2):
        sign = 1.0 if k == 1 else -1.0
        centre[k, 0], centre[k, 1], centre[k, 2] = sign * ax, sign * ay, sign * az
    mx, my, mz = mean[0], mean[1], mean[2]
    stride = 1 + (high - low) // MEANS_SAMPLE
    number = 1 + (high - 1 - low) // stride
    plane = np.empty(4)
    for iteration in range(MEANS_ITERATIONS):
        between(centre, plane)
        sx = sy = sz = 0.0
        tx = ty = tz = 0.0
        second, changed = 0, 0
        for i in range(low, high, stride):
            x, y, z = points[i, 0] - mx, points[i, 1] - my, points[i, 2] - mz
            is_second = x * plane[0] + y * plane[1] + z * plane[2] > plane[3]
            weight = 1.0 if is_second else 0.0
            sx += weight * x
            sy += weight * y
            sz += weight * z
            tx += x
            ty += y
            tz += z
            second += is_second
            changed += side[i] != is_second
            side[i] = is_second
        first = number - second
        settled = iteration > 0 and changed < SETTLED_SHARE * number
        if first == 0 or second == 0 or settled:
            break
        centre[1, 0], centre[1, 1], centre[1, 2] = sx / second, sy / second, sz / second
        centre[0, 0] = (tx - sx) / first
        centre[0, 1] = (ty - sy) / first
        centre[0, 2] = (tz - sz) / first
    between(centre, plane)
    for i in range(low, high):
        x, y, z = points[i, 0] - mx, points[i, 1] - my, points[i, 2] - mz
        side[i] = x * plane[0] + y * plane[1] + z * plane[2] > plane[3]


@njit(cache=True, nogil=True, error_model='numpy')
def between(centre, plane):
    """Find the plane half way between two places: direction to the second, and offset."""
    plane[3] = 0.0
    for j in range(3):
        plane[j] = centre[1, j] - centre[0, j]
        plane[3] += 0.5 * (centre[1, j] ** 2 - centre[0, j] ** 2)
