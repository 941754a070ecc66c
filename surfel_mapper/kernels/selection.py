# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Copy selected points: by a mask, or by ranges of rows.

With a mask every value is written and the write position advances only after a kept one, which
avoids a branch that a random mask would mispredict. Masks of filters are rarely random: blocks of
points that all stay are copied with vector instructions, those that all go are skipped.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.compiling import U

BLOCK = 64
"""Points whose x are copied, then their y, then their z: stores to one array after another take
three quarters of the time of stores to three arrays in turns."""


@njit(cache=True, nogil=True)
def compact(xyz, keep, out):
    """
    Copy the selected points, in order.

    xyz   (3, N) any type
    keep  (N,) bool
    out   (3, K) of the same type, K the number of points kept
    """
    num, num_out, i, k = U(xyz.shape[1]), U(out.shape[1]), U(0), U(0)
    while i + U(BLOCK) <= num and k < num_out:
        kept = 0
        for j in range(U(BLOCK)):
            kept += np.int64(keep[i + j])
        if kept > 0 and k + U(BLOCK) > num_out:
            break  # the block would be written past the end of out
        for axis in range(3):
            values, to, cursor = xyz[axis], out[axis], k
            if kept == BLOCK:
                for j in range(U(BLOCK)):
                    to[k + j] = values[i + j]
            elif kept > 0:
                for j in range(U(BLOCK)):
                    to[cursor] = values[i + j]
                    cursor += U(keep[i + j])
        i += U(BLOCK)
        k += U(kept)
    while k < num_out:
        for axis in range(3):
            out[axis, k] = xyz[axis, i]
        k += U(keep[i])
        i += U(1)


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
