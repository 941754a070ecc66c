# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Points by voxel: keys to be sorted, then rows, starts and means of the voxels.

In numpy the same takes five times as long, half of the fit of a table. A key and the row of its
point share a number, so that one sort of integers brings the points of a voxel together in order.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import kernel, U


@kernel()
def finite_ends(points, ends):
    """
    Find the box of the finite points; return their number.

    points  (N, 3) float32 or float64, m
    ends    (2, 3) float64, out: least and greatest coordinates
    """
    number = 0
    low_x = low_y = low_z = math.inf
    high_x = high_y = high_z = -math.inf
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if (x - x) + (y - y) + (z - z) == 0.0:  # else one is not finite
            number += 1
            low_x, low_y, low_z = min(low_x, x), min(low_y, y), min(low_z, z)
            high_x, high_y, high_z = max(high_x, x), max(high_y, y), max(high_z, z)
    ends[0, 0], ends[0, 1], ends[0, 2] = low_x, low_y, low_z
    ends[1, 0], ends[1, 1], ends[1, 2] = high_x, high_y, high_z
    return number


@kernel(error_model='numpy')
def voxel_keys(points, grid, divisions, to_key, keys):
    """
    Compute keys of finite points: the key of the voxel times divisions^3, plus its part's number.

    points     (N, 3) float32 or float64, m
    grid       size, shift and base of each axis (3, 3) float64, and its bits in a key (3,) int64
    divisions  number of parts of a voxel along each axis
    to_key     bits of a row; 0 for keys alone
    keys       (P,) int64, out: key << to_key | row; x of the voxel in the lowest bits, then y and
               z; the same order for parts
    """
    (size, shift, base), (bits_x, bits_y, _) = grid
    number, last = 0, divisions - 1
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if (x - x) + (y - y) + (z - z) == 0.0:  # else one is not finite
            x, y, z = x / size[0] - shift[0], y / size[1] - shift[1], z / size[2] - shift[2]
            i_x, i_y, i_z = np.floor(x), np.floor(y), np.floor(z)
            key = np.int64(i_y - base[1]) | np.int64(i_z - base[2]) << bits_y
            key = np.int64(i_x - base[0]) | key << bits_x
            key = key * divisions + min(np.int64((z - i_z) * divisions), last)
            key = key * divisions + min(np.int64((y - i_y) * divisions), last)
            key = key * divisions + min(np.int64((x - i_x) * divisions), last)
            keys[number] = key << to_key | i if to_key else key
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
    number, i = 0, 0
    while i < len(ordered):
        begin, key, x, y, z = i, ordered[i] >> to_key, 0.0, 0.0, 0.0
        while i < len(ordered) and ordered[i] >> to_key == key:
            row = U(ordered[i] & ((1 << to_key) - 1))
            x, y, z = x + points[row, 0], y + points[row, 1], z + points[row, 2]
            rows[i] = row
            i += 1
        keys[number], starts[number], count = key, begin, i - begin
        means[number, 0], means[number, 1], means[number, 2] = x / count, y / count, z / count
        number += 1
    starts[number] = len(ordered)
    return number


@kernel()
def spread_labels(labels, starts, rows, of_points):
    """Write the label of each voxel to its points, (N,) int32; starts and rows: see above."""
    for v in range(len(labels)):
        for i in range(starts[v], starts[v + 1]):
            of_points[rows[i]] = labels[v]
