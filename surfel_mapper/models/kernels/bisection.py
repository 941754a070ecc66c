# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Recursive bisection of a cloud until every cluster is flat or too small to split.

Rows are copied between two buffers, so that a cluster is a range of rows and its children are the
two parts of that range. Large clusters are split by 2-means, small ones by a mixture of two
Gaussians. Both start from the two halves along the largest eigenvector, so nothing is random. The
smaller child is split first, which bounds the stack by the logarithm of the number of points.

Coordinates are three arrays, and sums may be taken in any order (reassoc), so that the compiler
vectorises over four points: 0.5 ns a point for the moments.

Source: Gao and Dong 2025 (A Real-Time Multi-Model Parametric Representation of Point Clouds)
for the tests; the correction of the density test by direction is our own.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel
from surfel_mapper.models.kernels.frames import eigen_frame, orient
from surfel_mapper.models.kernels.gaussian_mixture import split_mixture

MEANS_ITERATIONS = 10
MEANS_SAMPLE = 2048
"""2-means of more points than this uses every n-th of them, with n the least that fits."""

SETTLED_SHARE = 0.002
"""2-means stops if fewer points than this share change sides."""

THREE_SIGMA_SQ = 9.0


@kernel(error_model='numpy', fastmath={'reassoc'})
def cluster_moments(x, y, z, mean, scatter):
    """
    Compute mean and scatter of at least one point, in one pass about the first of them.

    x, y, z  (n,) float64, m
    mean     (3,) float64, out
    scatter  (3, 3) float64, out: sum of outer products of deviations, m^2
    """
    number = len(x)
    x0, y0, z0 = x[0], y[0], z[0]
    sx = sy = sz = 0.0
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(number):
        u, v, w = x[i] - x0, y[i] - y0, z[i] - z0
        sx += u
        sy += v
        sz += w
        xx += u * u
        xy += u * v
        xz += u * w
        yy += v * v
        yz += v * w
        zz += w * w
    mx, my, mz = sx / number, sy / number, sz / number
    mean[0], mean[1], mean[2] = x0 + mx, y0 + my, z0 + mz
    scatter[0, 0] = max(xx - sx * mx, 0.0)
    scatter[1, 1] = max(yy - sy * my, 0.0)
    scatter[2, 2] = max(zz - sz * mz, 0.0)
    scatter[0, 1] = scatter[1, 0] = xy - sx * my
    scatter[0, 2] = scatter[2, 0] = xz - sx * mz
    scatter[1, 2] = scatter[2, 1] = yz - sy * mz


@kernel(error_model='numpy', fastmath={'reassoc'})
def num_outliers(x, y, z, mean, value, frame):
    """Return how many points lie beyond three sigma; rounding on an exact plane is ignored."""
    mx, my, mz = mean[0], mean[1], mean[2]
    ux, uy, uz = frame[0, 0], frame[0, 1], frame[0, 2]
    vx, vy, vz = frame[1, 0], frame[1, 1], frame[1, 2]
    wx, wy, wz = frame[2, 0], frame[2, 1], frame[2, 2]
    a, b, c = 1.0 / value[2], 1.0 / value[1], 1.0 / max(value[0], 1e-12 * value[2])
    num = 0.0
    for i in range(len(x)):
        dx, dy, dz = x[i] - mx, y[i] - my, z[i] - mz
        u = (ux * dx + uy * dy) + uz * dz
        v = (vx * dx + vy * dy) + vz * dz
        w = (wx * dx + wy * dy) + wz * dz
        num += 1.0 if (u * u * a + v * v * b) + w * w * c >= THREE_SIGMA_SQ else 0.0
    return num


@inlined(error_model='numpy')
def split_two_means(x, y, z, mean, value, frame, share, scratch):
    """
    Assign each point to the nearer of two means; return how many are assigned to the second.

    The means start along the largest eigenvector. For many points they follow from a subsample.

    x, y, z  (n,) float64, m
    share    (n,) float64, out: 1 if nearer to the second mean, else 0
    scratch  (4, MEANS_SAMPLE) float64
    """
    stride = 1 + len(x) // MEANS_SAMPLE
    number = 1 + (len(x) - 1) // stride
    sample, side = scratch[:3, :number], scratch[3, :number]
    total, centre = np.empty(3), np.empty((2, 3))
    subsample(x, y, z, mean, stride, sample, total)
    reach = math.sqrt(2.0 * value[2] / math.pi)
    for j in range(3):
        centre[1, j] = reach * frame[0, j]
        centre[0, j] = -centre[1, j]
    plane, sums = np.empty(4), np.empty(5)
    side[:] = 0.0
    for iteration in range(MEANS_ITERATIONS):
        bisecting_plane(centre, plane)
        sum_side(sample[0], sample[1], sample[2], plane, side, sums)
        second, changed = sums[3], sums[4]
        settled = iteration > 0 and changed < SETTLED_SHARE * number
        if second == 0.0 or second == number or settled:
            break
        for j in range(3):
            centre[1, j] = sums[j] / second
            centre[0, j] = (total[j] - sums[j]) / (number - second)
    bisecting_plane(centre, plane)
    return assign_sides(x, y, z, plane, mean, share)


@inlined(error_model='numpy')
def subsample(x, y, z, mean, stride, sample, total):
    """Copy every stride-th point, relative to the mean, and sum the copies."""
    total[0] = total[1] = total[2] = 0.0
    for i in range(sample.shape[1]):
        at = i * stride
        u, v, w = x[at] - mean[0], y[at] - mean[1], z[at] - mean[2]
        sample[0, i], sample[1, i], sample[2, i] = u, v, w
        total[0] += u
        total[1] += v
        total[2] += w


@kernel(error_model='numpy', fastmath={'reassoc'})
def sum_side(x, y, z, plane, side, sums):
    """
    Sum the points beyond a plane.

    side  (n,) float64, out: 1 beyond the plane, else 0
    sums  (5,) float64, out: sums of x, y, z; number of points; number of changed sides
    """
    px, py, pz, offset = plane[0], plane[1], plane[2], plane[3]
    sx = sy = sz = second = changed = 0.0
    for i in range(len(x)):
        u, v, w = x[i], y[i], z[i]
        beyond = 1.0 if (u * px + v * py) + w * pz > offset else 0.0
        sx += beyond * u
        sy += beyond * v
        sz += beyond * w
        second += beyond
        changed += abs(beyond - side[i])
        side[i] = beyond
    sums[0], sums[1], sums[2], sums[3], sums[4] = sx, sy, sz, second, changed


@inlined(error_model='numpy')
def bisecting_plane(centre, plane):
    """Compute the bisecting plane of two means: direction to the second one, and offset."""
    plane[3] = 0.0
    for j in range(3):
        plane[j] = centre[1, j] - centre[0, j]
        plane[3] += 0.5 * (centre[1, j] ** 2 - centre[0, j] ** 2)


@kernel(error_model='numpy', fastmath={'reassoc'})
def assign_sides(x, y, z, plane, mean, share):
    """Write 1 for points beyond a plane, relative to the mean, else 0; return how many."""
    px, py, pz, offset = plane[0], plane[1], plane[2], plane[3]
    mx, my, mz = mean[0], mean[1], mean[2]
    number = 0.0
    for i in range(len(x)):
        u, v, w = x[i] - mx, y[i] - my, z[i] - mz
        beyond = 1.0 if (u * px + v * py) + w * pz > offset else 0.0
        share[i] = beyond
        number += beyond
    return np.int64(number)


@inlined(error_model='numpy')
def partition(points, order, low, middle, high, share, to_points, to_order):
    """
    Partition a range of rows stably into the two children.

    points, order            (3, N) float64, (N,) int32: rows low to high - 1
    middle                   first row of the second child: points whose share is above a half
    share                    (N,) float64
    to_points, to_order      (3, N) float64, (N,) int32, out: the same range
    """
    x, y, z = points[0], points[1], points[2]
    to_x, to_y, to_z = to_points[0], to_points[1], to_points[2]
    first, second = np.uint64(low), np.uint64(middle)
    for i in range(np.uint64(low), np.uint64(high)):
        beyond = share[i] > 0.5
        target = second if beyond else first
        to_x[target], to_y[target], to_z[target] = x[i], y[i], z[i]
        to_order[target] = order[i]
        first += np.uint64(not beyond)
        second += np.uint64(beyond)


@inlined(error_model='numpy')
def count_beyond(share):
    """Return how many shares are above a half."""
    number = 0
    for i in range(len(share)):
        number += share[i] > 0.5
    return number


MAX_DEPTH = 66
"""Rows of the stack; the smaller child is split first, so 2^64 points fit."""

NOISE_SPREAD = 1.5
"""
Factor on the noise of the sensor: thinning keeps the tails of a noisy wall as densely as its
middle, so it gets thicker. With 1 a wall at 4.5 m of a Kinect falls into a hundred clusters at
3 cm.
"""

MEAN_CROSSED = 1.5
"""|n_x| + |n_y| + |n_z| of a unit normal, averaged over all directions."""


@kernel(error_model='numpy')
def bisect_cloud(points, viewpoint, rules, moved, order, rows, flat, means, values, frames):
    """
    Cluster points; return how many clusters there are.

    points     (N, 3) float64, m
    viewpoint  (3,) float64, m
    rules      (a, r_min, most_em, least, outliers, n0, n2, oriented): see is_flat_cluster
    moved      (N, 3) float64, out: the points by cluster
    order      (N,) int64, out: the row that each point had
    rows       (N, 2) int64, out: first row of each cluster and the one after its last, unordered
    flat       (N,) bool, out
    means      (N, 3) float64, out
    values     (N, 3) float64, out: eigenvalues of the covariance, ascending
    frames     (N, 3, 3) float64, out: rows x, y, normal

    (Longer than other kernels: the loop over the stack shares its buffers.)
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
        is_flat = is_flat_cluster(x, y, z, mean, value, frame, viewpoint, rules)
        middle = high
        if not is_flat and high - low >= max(rules[3], 4.0):
            own_share = share[low:high]
            middle = high - split_two_means(x, y, z, mean, value, frame, own_share, scratch)
            if high - low <= rules[2]:
                split_mixture(x, y, z, mean, own_share)
                middle = high - count_beyond(own_share)
        if middle - low < 2 or high - middle < 2:
            for i in range(low, high):
                for j in range(3):
                    moved[i, j] = buffers[own, j, i]
                order[i] = orders[own, i]
            rows[num, 0], rows[num, 1] = low, high
            flat[num] = is_flat
            for i in range(3):
                means[num, i], values[num, i] = mean[i], value[i]
                for j in range(3):
                    frames[num, i, j] = frame[i, j]
            num += 1
            continue
        spare = 1 - own
        partition(
            buffers[own], orders[own], low, middle, high, share, buffers[spare], orders[spare]
        )
        smaller_last = middle - low > high - middle
        for child in range(2):
            is_low = (child == 0) == smaller_last
            stack[depth, 0] = low if is_low else middle
            stack[depth, 1] = middle if is_low else high
            stack[depth, 2] = spare
            depth += 1
    return num


@inlined(error_model='numpy')
def is_flat_cluster(x, y, z, mean, value, frame, viewpoint, rules):
    """
    Return whether a cluster is thin, dense and without outliers, so a piece of a plane.

    rules  a         voxel size, m
           r_min     least density: 2 is a full sheet
           most_em, least
           outliers  share of points allowed beyond three sigma
           n0, n2    sigma of the sensor is n0 + n2 range^2, m
           oriented  whether density is normalised by the voxels that a plane of this direction
                     crosses, and a cluster narrower than a plane is thick counts as a line
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
