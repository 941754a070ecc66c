# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Points by voxel: keys to be sorted, then rows, starts and means of the voxels.

In numpy the same takes five times as long, half of the fit of a table. A key and the row of its
point share a number, so that one sort of integers brings the points of a voxel together in order.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import kernel


@kernel()
def finite_ends(points, ends):
    """
    Find the box of the finite points; return their number.

    points  (N, 3) float32 or float64, m
    ends    (2, 3) float64, out: least and greatest coordinates
    """
    number = 0
    for axis in range(3):
        ends[0, axis], ends[1, axis] = math.inf, -math.inf
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if math.isfinite(x) and math.isfinite(y) and math.isfinite(z):
            number += 1
            ends[0, 0], ends[1, 0] = min(ends[0, 0], x), max(ends[1, 0], x)
            ends[0, 1], ends[1, 1] = min(ends[0, 1], y), max(ends[1, 1], y)
            ends[0, 2], ends[1, 2] = min(ends[0, 2], z), max(ends[1, 2], z)
    return number


@kernel(error_model='numpy')
def voxel_keys(points, grid, parts, keys, rows):
    """
    Compute the keys of the finite points: of their voxels, times parts^3, plus the part of these.

    points  (N, 3) float32 or float64, m
    grid    size, shift and base of each axis (3, 3) float64, and its bits in a key (3,) int64
    parts   into which a voxel is divided along each axis
    keys    (P,) int64, out: x of the voxel in the lowest bits, then y and z; of parts alike
    rows    (P,) int64, out: rows of these points
    """
    axes, bits = grid
    number = 0
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if math.isfinite(x) and math.isfinite(y) and math.isfinite(z):
            x, y, z = x / axes[0, 0], y / axes[0, 1], z / axes[0, 2]
            x, y, z = x - axes[1, 0], y - axes[1, 1], z - axes[1, 2]
            kx = np.int64(math.floor(x) - axes[2, 0])
            ky = np.int64(math.floor(y) - axes[2, 1])
            kz = np.int64(math.floor(z) - axes[2, 2])
            key = kx | (ky | kz << bits[1]) << bits[0]
            for along in (z, y, x):
                key = key * parts + min(np.int64((along - math.floor(along)) * parts), parts - 1)
            keys[number] = key
            rows[number] = i
            number += 1


@kernel(error_model='numpy')
def average_voxels(points, ordered, to_key, rows, starts, keys, means):
    """
    Average the points of each voxel; return the number of voxels.

    points   (N, 3) float32 or float64, m
    ordered  (P,) int64, ascending: key << to_key | row of each point
    to_key   bits of a row
    rows     (P,) int32, out: rows of the points, voxel by voxel
    starts   (V + 1,) int64, out: first row of each voxel, and P; V is at most P
    keys     (V,) int64, out
    means    (V, 3) float64, out
    """
    number = -1
    for i in range(len(ordered)):
        key, row = ordered[i] >> to_key, ordered[i] & ((1 << to_key) - 1)
        if number < 0 or keys[number] != key:
            number += 1
            keys[number], starts[number] = key, i
            means[number, 0] = means[number, 1] = means[number, 2] = 0.0
        rows[i] = row
        for axis in range(3):
            means[number, axis] += np.float64(points[row, axis])
    number += 1
    starts[number] = len(ordered)
    for voxel in range(number):
        count = starts[voxel + 1] - starts[voxel]
        for axis in range(3):
            means[voxel, axis] /= count
    return number
