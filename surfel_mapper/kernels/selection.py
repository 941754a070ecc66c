# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Move the points that stay, or that belong together.

By a mask every value is written, and the place to write to moves on only past those that stay:
without a branch that a mask of noise would mispredict.
"""

from numba import njit


@njit(cache=True, nogil=True)
def compact(values, keep, out):
    """
    Copy the items of each row that stay, in order.

    values  (R, N) any type
    keep    (N,) bool
    out     (R, K) of the same type, K the number of items that stay
    """
    num_out = out.shape[1]
    for r in range(values.shape[0]):
        row, out_row = values[r], out[r]
        k = 0
        i = 0
        while k < num_out:
            out_row[k] = row[i]
            k += keep[i]
            i += 1


@njit(cache=True, nogil=True)
def copy_ranges(points, ranges, out):
    """
    Copy ranges of rows, one after the other.

    points  (N, 3) float64
    ranges  (K, 2) int64, first row of each, and the one after its last
    out     (M, 3) float64, M the number of their rows
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
    Give every item the number of its range, where it was before they were put in order.

    ranges   (K, 2) int64, first place of each, and the one after its last
    numbers  (K,) int64
    order    (M,) int64, where each was
    out      (M,) int32, out
    """
    for k in range(len(ranges)):
        for i in range(ranges[k, 0], ranges[k, 1]):
            out[order[i]] = numbers[k]
