# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Cut the space of points into boxes of few points each.

A box is cut at the median of its points across its longest edge, found by partial sorting: 14
levels for 131,072 points and boxes of 10, and every level touches each point two or three times.
Points of equal coordinate are ordered by their rows, so that the boxes do not depend on the
order of work.

Source: Hoare 1961 (Algorithm 65: find) for the partial sorting.
"""

from numba import njit
import numpy as np

DEPTH = 64
"""Depth of the stack of boxes to be cut; each cut pushes one and halves the next."""


@njit(cache=True, nogil=True)
def cut(points, max_points, order, rows):
    """
    Cut until no box has more than max_points; return the number of boxes.

    points  (N, 3) float64, finite
    order   (N,) int64, in: 0 to N - 1, out: the points box by box
    rows    (N,) int64, out: box of every point
    """
    spans = np.empty((DEPTH, 2), np.int64)
    lows, highs = np.empty((DEPTH, 3)), np.empty((DEPTH, 3))
    spans[0, 0], spans[0, 1] = 0, len(points)
    for axis in range(3):
        lows[0, axis], highs[0, axis] = points[:, axis].min(), points[:, axis].max()
    waiting, number = 1, 0
    while waiting > 0:
        box = waiting - 1
        first, last = spans[box, 0], spans[box, 1]
        if last - first <= max_points:
            for i in range(first, last):
                rows[order[i]] = number
            number += 1
            waiting -= 1
            continue
        axis = (highs[box] - lows[box]).argmax()
        rank = last - (last - first) // 2
        split(points, axis, order, first, last, rank)
        # the upper part replaces the box on the stack, the lower one is cut next
        lower = waiting
        lows[lower], highs[lower] = lows[box], highs[box]
        spans[lower, 0], spans[lower, 1] = first, rank
        spans[box, 0] = rank
        highs[lower, axis] = lows[box, axis] = points[order[rank], axis]
        waiting += 1
    return number


@njit(cache=True, nogil=True)
def split(points, axis, order, first, last, rank):
    """Partition order[first:last] at rank."""
    low, high = first, last - 1
    chance = np.uint32(last - first)  # pseudo-random pivots: no input order is slow
    while low < high:
        chance = chance * np.uint32(1664525) + np.uint32(1013904223)
        pivot = order[low + np.int64(chance >> np.uint32(8)) % (high - low + 1)]
        at = points[pivot, axis]
        i, j = low, high
        while i <= j:
            while comes_before(points[order[i], axis], order[i], at, pivot):
                i += 1
            while comes_before(at, pivot, points[order[j], axis], order[j]):
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            return


@njit(cache=True, nogil=True, inline='always')
def comes_before(value, row, other_value, other_row):
    """Return whether a point comes before another along an axis."""
    return value < other_value or (value == other_value and row < other_row)
