# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Bisection of surfaces that are no height field, by their normals or by their heights.

A surface has a few dozen surfels, for which numpy calls take ten times as long.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.models.kernels.frames import eigen_frame

MEANS_ITERATIONS = 20
"""Most iterations of 2-means on normals."""

STEADY_SHARE = 0.5
"""
2-means begins with the first axis of the map with this share of the largest variance. The normals
of a ball vary alike in two directions, and their principal axis turns with every scan.
"""

FOLD_PERCENTILE, MOST_FOLDED = 98.0, 20
"""
A surface is folded unless this percentage of normals is near the mean, and at most this number is
not: a cup on a table has less than 2 % of the voxels of both.
"""

STACKED_SHARE = 0.05
"""A chart overlaps itself if more than this share of its columns is too high."""


LEAST_CURVED_VOXELS, LEAST_CURVED_POINTS = 15, 1000
"""
A curved chart has at least this number of voxels, or of points: round objects close to a camera.
Others are mostly parts of tree crowns, of which one in nine merges within a metre of a drive. With
12 voxels or 500 points fewer ids stay; with 18 voxels more objects on a table are no patches.
"""


@njit(cache=True, nogil=True, error_model='numpy')
def find_small_curved(rows, starts, count, normal, limit, found):
    """
    Find curved charts that are too small.

    rows    (M,) int32; chart k has those from starts[k] to starts[k + 1] - 1
    count   (R,) int64
    normal  (R, 3) float64, of either sign
    limit   least cosine between two normals of a flat chart
    found   (K,) bool, out

    Pairs of normals are compared, so the result does not depend on the order of the rows.
    """
    for k in range(len(starts) - 1):
        first, end = starts[k], starts[k + 1]
        found[k] = False
        if end - first >= LEAST_CURVED_VOXELS:
            continue
        num_points, least = 0, 1.0
        for i in range(first, end):
            num_points += count[rows[i]]
            n = normal[rows[i]]
            for j in range(first, i):
                m = normal[rows[j]]
                least = min(least, abs(n[0] * m[0] + n[1] * m[1] + n[2] * m[2]))
        found[k] = least < limit and num_points < LEAST_CURVED_POINTS


@njit(cache=True, nogil=True, error_model='numpy')
def bisect_normals(normals, side):
    """
    Bisect normals by 2-means; return whether both halves hold some.

    normals  (n, 3) float64
    side     (n,) bool, out
    """
    number = len(normals)
    mean, spread = np.zeros(3), np.zeros(3)
    for i in range(number):
        for j in range(3):
            mean[j] += normals[i, j] / number
    for i in range(number):
        for j in range(3):
            spread[j] += (normals[i, j] - mean[j]) ** 2
    axis = 0
    while spread[axis] < STEADY_SHARE * spread.max():
        axis += 1
    plane = np.zeros(4)
    plane[axis], plane[3] = 1.0, mean[axis]
    sums, counts = np.empty((2, 3)), np.empty(2)
    for iteration in range(MEANS_ITERATIONS + 1):
        sums[:] = 0.0
        counts[:] = 0.0
        changed = False
        for i in range(number):
            dot_products = 0.0
            for j in range(3):
                dot_products += normals[i, j] * plane[j]
            beyond = dot_products > plane[3]
            changed = changed or beyond != side[i]
            side[i] = beyond
            half = 1 if beyond else 0
            counts[half] += 1.0
            for j in range(3):
                sums[half, j] += normals[i, j]
        if counts[0] == 0.0 or counts[1] == 0.0:
            return False
        if iteration > 0 and not changed:
            break
        plane[3] = 0.0
        for j in range(3):
            first, second = sums[1, j] / counts[1], sums[0, j] / counts[0]
            plane[j] = first - second
            plane[3] += 0.5 * (first * first - second * second)
    return True


@njit(cache=True, nogil=True, error_model='numpy')
def bisect_chart(normals, points, limit, height, size, side):
    """
    Bisect a chart that has several heights over one plane; return whether it has.

    normals  (n, 3) float64, unit
    points   (n, 3) float64, m
    limit    least cosine to the mean normal for nearly all normals
    height   m, of a column that overlaps itself
    size     m, width of a column
    side     (n,) bool, out: one half
    """
    mean = np.zeros(3)
    for i in range(len(normals)):
        for j in range(3):
            mean[j] += normals[i, j]
    length = math.sqrt(mean[0] * mean[0] + mean[1] * mean[1] + mean[2] * mean[2])
    if length > 0.0:
        mean /= length
    if bisect_folded(normals, mean, limit, side):
        axis = dominant_axis(normals)
        cosines = dot_products(normals, axis)
        if is_folded(np.abs(cosines), limit):
            return True
        mean = axis  # equal up to sign: the voxels have no common viewpoint
    return bisect_stacked(points, mean, height, size, side)


@njit(cache=True, nogil=True, error_model='numpy')
def bisect_folded(normals, mean, limit, side):
    """
    Bisect a surface whose normals deviate too far from their mean; return whether they do.

    normals  (n, 3) float64, unit
    mean     (3,) float64
    limit    least cosine to the mean normal for nearly all normals
    side     (n,) bool, out: one half
    """
    cosines = dot_products(normals, mean)
    if len(normals) < 2 or cosines.min() >= limit:
        return False
    return is_folded(cosines, limit) and bisect_normals(normals, side)


@njit(cache=True, nogil=True, error_model='numpy')
def is_folded(cosines, limit):
    """Return whether too many cosines (n,) to the mean normal are below the limit."""
    if (cosines < limit).sum() > MOST_FOLDED:
        return True
    return percentile(cosines, 100.0 - FOLD_PERCENTILE) < limit


@njit(cache=True, nogil=True, error_model='numpy')
def bisect_stacked(points, normal, height, size, side):
    """
    Find the upper half of a surface that overlaps itself; return whether it does.

    points, height, size, side  of bisect_chart
    normal                      (3,) float64, unit or 0
    """
    heights = dot_products(points, normal)
    low, high = heights.min(), heights.max()
    if high - low <= height:
        return False
    least = np.abs(normal).argmin()
    x, y = np.zeros(3), np.empty(3)
    j, k = (least + 1) % 3, (least + 2) % 3
    length = math.hypot(normal[j], normal[k])
    x[j], x[k] = -normal[k] / length, normal[j] / length
    for axis in range(3):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        y[axis] = normal[j] * x[k] - normal[k] * x[j]
    # voxel indices have 21 bits, so column numbers are unique
    row, place = dot_products(points, x) / size, dot_products(points, y) / size
    column = np.floor(row) * 2.0**26 + np.floor(place)
    order = np.argsort(column, kind='mergesort')
    columns = stacked = begin = 0
    for end in range(1, len(order) + 1):
        if end < len(order) and column[order[end]] == column[order[begin]]:
            continue
        inside = heights[order[begin:end]]
        columns += 1
        stacked += inside.max() - inside.min() > height
        begin = end
    for i in range(len(heights)):
        side[i] = heights[i] > 0.5 * (low + high)
    return stacked > STACKED_SHARE * columns


@njit(cache=True, nogil=True, error_model='numpy')
def dot_products(vectors, direction):
    """Return the products of vectors (n, 3) with a direction (3,)."""
    found = np.empty(len(vectors))
    for i in range(len(vectors)):
        found[i] = (
            vectors[i, 0] * direction[0]
            + vectors[i, 1] * direction[1]
            + vectors[i, 2] * direction[2]
        )
    return found


@njit(cache=True, nogil=True, error_model='numpy')
def dominant_axis(normals):
    """Return the axis (3,) that normals (n, 3) are nearest to, regardless of their sign."""
    products, values, axes = np.zeros((3, 3)), np.empty(3), np.empty((3, 3))
    for i in range(len(normals)):
        for j in range(3):
            for k in range(3):
                products[j, k] += normals[i, j] * normals[i, k]
    eigen_frame(products, values, axes)
    return axes[2].copy()


@njit(cache=True, nogil=True, error_model='numpy')
def percentile(values, share):
    """Return a percentile with linear interpolation, as numpy does."""
    ordered, place = np.sort(values), 0.01 * share * (len(values) - 1)
    low = int(place)
    high = min(low + 1, len(values) - 1)
    return ordered[low] + (place - low) * (ordered[high] - ordered[low])
