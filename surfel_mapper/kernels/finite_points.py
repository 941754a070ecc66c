# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Take the points of a cloud that are finite, each axis in a row of its own, and label them later.

In one pass: an organised cloud of a depth camera is up to a half nan, and asking numpy for what
is finite and then for those rows takes four times as long.
"""

import math

from numba import njit


@njit(cache=True, nogil=True, error_model='numpy')
def take_finite(points, taken, rows):
    """
    Copy finite points; return how many there are.

    points  (N, 3) float32 or float64
    taken   (3, N) of the same type, out
    rows    (N,) int32, out: row of each in points
    """
    number = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if math.isfinite(x) and math.isfinite(y) and math.isfinite(z):
            taken[0, number], taken[1, number], taken[2, number] = x, y, z
            rows[number] = i
            number += 1
    return number


@njit(cache=True, nogil=True)
def give_labels(rows, voxels, labels, found):
    """
    Give every point the label of its voxel.

    rows    (n,) int32, rows of the points that were taken
    voxels  (n,) int32, their voxels
    labels  (M,) int32, of the voxels
    found   (N,) int32, out at those rows
    """
    for i in range(len(rows)):
        found[rows[i]] = labels[voxels[i]]
