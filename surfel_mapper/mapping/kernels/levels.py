# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Sum the moments of fine voxels by the coarse voxel that they lie in."""

from numba import njit
import numpy as np

from surfel_mapper.kernels.layout import BITS, INDEX_BITS, INDEX_MASK, INDEX_OFFSET
from surfel_mapper.kernels.moments import hash_shift, home


@njit(cache=True, nogil=True)
def coarsen(moments, fine_level, level, table, keys, sums, rows):
    """
    Move moments to the centres of voxels 2^level times larger, and add them up there.

    moments     keys (K,) int64, count (K,), total (K, 3), product (K, 6), view (K, 3)
    fine_level  level of these moments
    table       (B,) int32, B a power of two and at least 2 K, all -1
    keys        (K,) int64, out: voxel keys in the order of first appearance
    sums        (K, 13) int64, zeros, out: count, total, product, view
    rows        (K,) int64, out: the coarse voxel of each fine one, as a row of keys

    Returns how many coarse voxels there are.
    """
    fine_keys, count, total, product, view = moments
    shift = hash_shift(len(table))
    mask = len(table) - 1
    fine = np.int64(1) << (BITS + fine_level)
    middle = fine // 2 - (fine << level) // 2
    below = (np.int64(1) << level) - 1
    num = 0
    for i in range(len(fine_keys)):
        key = fine_keys[i]
        x = (key >> (2 * INDEX_BITS)) - INDEX_OFFSET
        y = ((key >> INDEX_BITS) & INDEX_MASK) - INDEX_OFFSET
        z = (key & INDEX_MASK) - INDEX_OFFSET
        coarse = ((x >> level) + INDEX_OFFSET) << (2 * INDEX_BITS)
        coarse |= (((y >> level) + INDEX_OFFSET) << INDEX_BITS) | ((z >> level) + INDEX_OFFSET)
        place = home(coarse, shift)
        row = np.int64(table[place])
        while row >= 0 and keys[row] != coarse:
            place = (place + 1) & mask
            row = np.int64(table[place])
        if row < 0:
            row = np.int64(num)
            num += 1
            table[place] = row
            keys[row] = coarse
        rows[i] = row
        # a place q about the fine centre is q + d about the coarse one
        n = np.int64(count[i])
        dx = (x & below) * fine + middle
        dy = (y & below) * fine + middle
        dz = (z & below) * fine + middle
        sx, sy, sz = np.int64(total[i, 0]), np.int64(total[i, 1]), np.int64(total[i, 2])
        sums[row, 0] += n
        sums[row, 1] += sx + n * dx
        sums[row, 2] += sy + n * dy
        sums[row, 3] += sz + n * dz
        sums[row, 4] += product[i, 0] + dx * sx + dx * sx + n * dx * dx
        sums[row, 5] += product[i, 1] + dx * sy + dy * sx + n * dx * dy
        sums[row, 6] += product[i, 2] + dx * sz + dz * sx + n * dx * dz
        sums[row, 7] += product[i, 3] + dy * sy + dy * sy + n * dy * dy
        sums[row, 8] += product[i, 4] + dy * sz + dz * sy + n * dy * dz
        sums[row, 9] += product[i, 5] + dz * sz + dz * sz + n * dz * dz
        for axis in range(3):
            sums[row, 10 + axis] += np.int64(view[i, axis])
    return num
