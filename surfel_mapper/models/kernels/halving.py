# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What is done to all points of a cluster: moments, outliers, two means, dealing out to the halves.

Coordinates are three arrays and sums may be taken in any order (reassoc), so that the compiler
works on four points at once: 0.5 ns a point for the moments.
"""

from numba import njit
import numpy as np

MEANS_ITERATIONS = 10
MEANS_SAMPLE = 2048
"""The means of more points are those of every so many of them that about so many are left."""

SETTLED_SHARE = 0.002
"""2-means ends when fewer points than this change sides."""

THREE_SIGMA_SQ = 9.0


@njit(cache=True, nogil=True, error_model='numpy', fastmath={'reassoc'})
def cluster_moments(x, y, z, mean, scatter):
    """
    Sum points, at least one, in one pass about the first of them.

    x, y, z  (n,) float64
    mean     (3,) float64, out
    scatter  (3, 3) float64, out: sum of outer products of deviations
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


@njit(cache=True, nogil=True, error_model='numpy', fastmath={'reassoc'})
def num_outliers(x, y, z, mean, value, frame):
    """Return how many points are beyond three sigma; rounding across an exact plane is none."""
    mx, my, mz = mean[0], mean[1], mean[2]
    ux, uy, uz = frame[0, 0], frame[0, 1], frame[0, 2]
    vx, vy, vz = frame[1, 0], frame[1, 1], frame[1, 2]
    wx, wy, wz = frame[2, 0], frame[2, 1], frame[2, 2]
    a, b, c = 1.0 / value[2], 1.0 / value[1], 1.0 / max(value[0], 1e-12 * value[2])
    found = 0.0
    for i in range(len(x)):
        dx, dy, dz = x[i] - mx, y[i] - my, z[i] - mz
        u = (ux * dx + uy * dy) + uz * dz
        v = (vx * dx + vy * dy) + vz * dz
        w = (wx * dx + wy * dy) + wz * dz
        found += 1.0 if (u * u * a + v * v * b) + w * w * c >= THREE_SIGMA_SQ else 0.0
    return found


@njit(cache=True, nogil=True, error_model='numpy')
def split_means(x, y, z, mean, value, frame, share, scratch):
    """
    Put each point on the side of the nearer of two means; return how many on that of the second.

    They begin on the long axis. The means of many points follow from every so many of them.

    x, y, z  (n,) float64
    share    (n,) float64, out: 1 on the side of the second mean, else 0
    scratch  (4, MEANS_SAMPLE) float64
    """
    stride = 1 + len(x) // MEANS_SAMPLE
    number = 1 + (len(x) - 1) // stride
    sample, side = scratch[:3, :number], scratch[3, :number]
    total, centre = np.empty(3), np.empty((2, 3))
    take_sample(x, y, z, mean, stride, sample, total)
    reach = np.sqrt(2.0 * value[2] / np.pi)
    for j in range(3):
        centre[1, j] = reach * frame[0, j]
        centre[0, j] = -centre[1, j]
    plane, sums = np.empty(4), np.empty(5)
    side[:] = 0.0
    for iteration in range(MEANS_ITERATIONS):
        between(centre, plane)
        sum_side(sample[0], sample[1], sample[2], plane, side, sums)
        second, changed = sums[3], sums[4]
        settled = iteration > 0 and changed < SETTLED_SHARE * number
        if second == 0.0 or second == number or settled:
            break
        for j in range(3):
            centre[1, j] = sums[j] / second
            centre[0, j] = (total[j] - sums[j]) / (number - second)
    between(centre, plane)
    return take_sides(x, y, z, plane, mean, share)


@njit(cache=True, nogil=True, error_model='numpy')
def take_sample(x, y, z, mean, stride, sample, total):
    """Copy every so many of the points, from their mean on, and sum these."""
    for j, values in enumerate((x, y, z)):
        sample_sum = 0.0
        for i in range(sample.shape[1]):
            away = values[i * stride] - mean[j]
            sample[j, i] = away
            sample_sum += away
        total[j] = sample_sum


@njit(cache=True, nogil=True, error_model='numpy', fastmath={'reassoc'})
def sum_side(x, y, z, plane, side, sums):
    """
    Sum the points beyond a plane.

    side  (n,) float64, out: 1 beyond the plane, else 0
    sums  (5,) float64, out: of x, y, z; number of points; how many sides are new
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


@njit(cache=True, nogil=True, error_model='numpy')
def between(centre, plane):
    """Find the plane half way between two places: direction to the second, and offset."""
    plane[3] = 0.0
    for j in range(3):
        plane[j] = centre[1, j] - centre[0, j]
        plane[3] += 0.5 * (centre[1, j] ** 2 - centre[0, j] ** 2)


@njit(cache=True, nogil=True, error_model='numpy', fastmath={'reassoc'})
def take_sides(x, y, z, plane, mean, share):
    """Write 1 for points beyond a plane in coordinates about a mean, else 0; return how many."""
    px, py, pz, offset = plane[0], plane[1], plane[2], plane[3]
    mx, my, mz = mean[0], mean[1], mean[2]
    number = 0.0
    for i in range(len(x)):
        u, v, w = x[i] - mx, y[i] - my, z[i] - mz
        beyond = 1.0 if (u * px + v * py) + w * pz > offset else 0.0
        share[i] = beyond
        number += beyond
    return np.int64(number)


@njit(cache=True, nogil=True, error_model='numpy')
def deal(points, order, low, middle, high, share, dealt, dealt_order):
    """
    Copy rows to the two parts of their range, each in its order.

    points, order  (3, N) float64, (N,) int32: rows low to high - 1
    middle         first row of the second part, which is of those whose share is above a half
    share          (N,) float64
    dealt          (3, N) float64, dealt_order (N,) int32: out, the same rows
    """
    x, y, z = points[0], points[1], points[2]
    to_x, to_y, to_z = dealt[0], dealt[1], dealt[2]
    first, second = np.uint64(low), np.uint64(middle)
    for i in range(np.uint64(low), np.uint64(high)):
        beyond = share[i] > 0.5
        place = second if beyond else first
        to_x[place], to_y[place], to_z[place] = x[i], y[i], z[i]
        dealt_order[place] = order[i]
        first += np.uint64(not beyond)
        second += np.uint64(beyond)


@njit(cache=True, nogil=True, error_model='numpy', fastmath={'reassoc'})
def count_beyond(share):
    """Return how many shares are above a half."""
    number = 0.0
    for i in range(len(share)):
        number += 1.0 if share[i] > 0.5 else 0.0
    return np.int64(number)
