# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Bisection of surfaces that are no height field by their normals, and small curved surfaces.

A surface has a few dozen surfels, for which numpy calls take ten times as long.
"""

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel

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

LEAST_CURVED_VOXELS, LEAST_CURVED_POINTS = 15, 1000
"""
A curved chart has at least this number of voxels, or of points: round objects close to a camera.
Others are mostly parts of tree crowns, of which one in nine merges within a metre of a drive. With
12 voxels or 500 points fewer ids stay; with 18 voxels more objects on a table are no patches.
"""


@kernel(error_model='numpy')
def find_small_curved(rows, starts, count, normal, limit, is_small):
    """
    Find curved charts that are too small.

    rows      (M,) int32; chart k has those from starts[k] to starts[k + 1] - 1
    count     (R,) int64
    normal    (R, 3) float64, of either sign
    limit     least cosine between two normals of a flat chart
    is_small  (K,) bool, out

    Pairs of normals are compared, so the result does not depend on the order of the rows.
    """
    for k in range(len(starts) - 1):
        first, end = starts[k], starts[k + 1]
        is_small[k] = False
        if end - first >= LEAST_CURVED_VOXELS:
            continue
        num_points, least = 0, 1.0
        for i in range(first, end):
            num_points += count[rows[i]]
            n = normal[rows[i]]
            for j in range(first, i):
                m = normal[rows[j]]
                least = min(least, abs(n[0] * m[0] + n[1] * m[1] + n[2] * m[2]))
        is_small[k] = least < limit and num_points < LEAST_CURVED_POINTS


@inlined(error_model='numpy')
def bisect_normals(normals, side):
    """
    Bisect normals by 2-means; return whether both halves hold some.

    normals  (n, 3) float64
    side     (n,) bool, out
    """
    number = len(normals)
    mean, spread, plane = np.zeros(3), np.zeros(3), np.zeros(4)
    for j in range(3):
        for i in range(number):
            mean[j] += normals[i, j] / number
        for i in range(number):
            spread[j] += (normals[i, j] - mean[j]) ** 2
    axis = 0
    while spread[axis] < STEADY_SHARE * max(spread[0], spread[1], spread[2]):
        axis += 1
    plane[axis], plane[3] = 1.0, mean[axis]
    sums = np.empty((2, 4))
    for iteration in range(MEANS_ITERATIONS + 1):
        sums[:] = 0.0
        changed = False
        for i in range(number):
            beyond = dot(normals[i], plane) > plane[3]
            changed = changed or beyond != side[i]
            side[i] = beyond
            half = 1 if beyond else 0
            sums[half, 3] += 1.0
            for j in range(3):
                sums[half, j] += normals[i, j]
        if sums[0, 3] == 0.0 or sums[1, 3] == 0.0:
            return False
        if iteration > 0 and not changed:
            break
        plane[3] = 0.0
        for j in range(3):
            first, second = sums[1, j] / sums[1, 3], sums[0, j] / sums[0, 3]
            plane[j] = first - second
            plane[3] += 0.5 * (first * first - second * second)
    return True


@inlined(error_model='numpy')
def dot(a, b):
    """Return the scalar product of the first three elements."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel(error_model='numpy')
def bisect_folded(normals, mean, limit, side):
    """
    Bisect a surface whose normals deviate too far from their mean; return whether they do.

    normals  (n, 3) float64, unit
    mean     (3,) float64
    limit    least cosine to the mean normal for nearly all normals
    side     (n,) bool, out: one half
    """
    return is_folded(normals, mean, limit) and bisect_normals(normals, side)


@inlined(error_model='numpy')
def is_folded(normals, mean, limit):
    """
    Return whether too many cosines of normals (n, 3) to their mean are below a limit.

    They are if a percentile of the cosines, with linear interpolation as numpy's, is below it.
    """
    below, highest, lowest = 0, -2.0, 2.0
    for i in range(len(normals)):
        cosine = dot(normals[i], mean)
        if cosine < limit:
            below += 1
            highest = max(highest, cosine)
        else:
            lowest = min(lowest, cosine)
    if len(normals) < 2 or below == 0 or below > MOST_FOLDED:
        return len(normals) >= 2 and below > 0
    rank = 0.01 * (100.0 - FOLD_PERCENTILE) * (len(normals) - 1)
    low = int(rank)
    if below != low + 1:
        return below > low
    return highest + (rank - low) * (lowest - highest) < limit
