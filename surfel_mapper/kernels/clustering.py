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

MAX_DEPTH = 66
MEANS_ITERATIONS = 10
MIXTURE_ITERATIONS = 10
SETTLED_SHARE = 0.002
"""2-means ends when fewer points than this change sides."""

SETTLED_RESPONSIBILITY = 1e-2
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
    """Put each point on the side of the nearer of two means, which begin on the long axis."""
    reach = math.sqrt(2.0 * value[2] / math.pi)
    ax, ay, az = reach * frame[0, 0], reach * frame[0, 1], reach * frame[0, 2]
    centre = np.empty((2, 3))
    for k in range(2):
        sign = 1.0 if k == 1 else -1.0
        centre[k, 0], centre[k, 1], centre[k, 2] = sign * ax, sign * ay, sign * az
    mx, my, mz = mean[0], mean[1], mean[2]
    for iteration in range(MEANS_ITERATIONS):
        dx, dy = centre[1, 0] - centre[0, 0], centre[1, 1] - centre[0, 1]
        dz = centre[1, 2] - centre[0, 2]
        offset = 0.0
        for j in range(3):
            offset += 0.5 * (centre[1, j] ** 2 - centre[0, j] ** 2)
        sx = sy = sz = 0.0
        tx = ty = tz = 0.0
        second, changed = 0, 0
        for i in range(low, high):
            x, y, z = points[i, 0] - mx, points[i, 1] - my, points[i, 2] - mz
            is_second = x * dx + y * dy + z * dz > offset
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
        first = (high - low) - second
        if first == 0 or second == 0:
            return
        if iteration > 0 and changed < SETTLED_SHARE * (high - low):
            return
        centre[1, 0], centre[1, 1], centre[1, 2] = sx / second, sy / second, sz / second
        centre[0, 0] = (tx - sx) / first
        centre[0, 1] = (ty - sy) / first
        centre[0, 2] = (tz - sz) / first


@njit(cache=True, nogil=True, error_model='numpy')
def split_mixture(points, low, high, mean, side, share):
    """Put each point on the side of the likelier of two Gaussians that begin with the sides."""
    gaussian = np.empty((2, 10))
    for i in range(low, high):
        share[i] = side[i]
    for _ in range(MIXTURE_ITERATIONS):
        if not fit_gaussians(points, low, high, mean, share, gaussian):
            break
        largest = 0.0
        for i in range(low, high):
            x, y, z = points[i, 0] - mean[0], points[i, 1] - mean[1], points[i, 2] - mean[2]
            against = score(gaussian[0], x, y, z) - score(gaussian[1], x, y, z)
            new = 1.0 / (1.0 + math.exp(min(against, 700.0)))
            largest = max(largest, abs(new - share[i]))
            share[i] = new
        if largest < SETTLED_RESPONSIBILITY:
            break
    for i in range(low, high):
        side[i] = share[i] > 0.5


@njit(cache=True, nogil=True, error_model='numpy')
def fit_gaussians(points, low, high, mean, share, gaussian):
    """
    Fit two Gaussians to points that belong to the second by their share; False where one is empty.

    gaussian  (2, 10) float64, out: mean about the given one, lower Cholesky factor's inverse
              11 21 22 31 32 33, and the logarithm of weight over root of determinant
    """
    for k in range(2):
        weight = sx = sy = sz = 0.0
        xx = xy = xz = yy = yz = zz = 0.0
        for i in range(low, high):
            w = share[i] if k == 1 else 1.0 - share[i]
            x, y, z = points[i, 0] - mean[0], points[i, 1] - mean[1], points[i, 2] - mean[2]
            weight += w
            sx += w * x
            sy += w * y
            sz += w * z
            xx += w * x * x
            xy += w * x * y
            xz += w * x * z
            yy += w * y * y
            yz += w * y * z
            zz += w * z * z
        if weight < 1e-6:
            return False
        sx, sy, sz = sx / weight, sy / weight, sz / weight
        xx, yy, zz = xx / weight - sx * sx, yy / weight - sy * sy, zz / weight - sz * sz
        xy, xz, yz = xy / weight - sx * sy, xz / weight - sx * sz, yz / weight - sy * sz
        add = 1e-8 + 1e-4 * max(xx + yy + zz, 0.0) / 3.0
        l11 = math.sqrt(max(xx, 0.0) + add)
        l21, l31 = xy / l11, xz / l11
        l22 = math.sqrt(max(yy + add - l21 * l21, 0.5 * add))
        l32 = (yz - l31 * l21) / l22
        l33 = math.sqrt(max(zz + add - l31 * l31 - l32 * l32, 0.5 * add))
        g = gaussian[k]
        g[0], g[1], g[2] = sx, sy, sz
        g[3], g[5], g[8] = 1.0 / l11, 1.0 / l22, 1.0 / l33
        g[4] = -l21 * g[3] * g[5]
        g[7] = -l32 * g[5] * g[8]
        g[6] = -(l31 * g[3] + l32 * g[4]) * g[8]
        g[9] = math.log(weight / (high - low)) + math.log(g[3] * g[5] * g[8])
    return True


@njit(cache=True, nogil=True, error_model='numpy')
def score(g, x, y, z):
    """Return the logarithm of the weighted density at a point, up to a constant."""
    x, y, z = x - g[0], y - g[1], z - g[2]
    u = g[3] * x
    v = g[4] * x + g[5] * y
    w = g[6] * x + g[7] * y + g[8] * z
    return g[9] - 0.5 * (u * u + v * v + w * w)
