# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The smallest of the squared distances that a search holds, and their order.

A search holds some dozens of squares and the indices of their points, and keeps the k smallest
each time it holds too many. To avoid mispredicted branches, up to 32 are selected by their ranks,
and more are split by a limit that k of them are below. Equal ones are partitioned.

Source: interpolation search, Peterson 1957; selection by partitions, Hoare 1961.
"""

import math

import numpy as np

from surfel_mapper.filters.kernels.search_tree import move_below, move_up_to
from surfel_mapper.kernels.compiling import inlined, kernel, U
from surfel_mapper.kernels.lanes import FLOATS, num_below

VECTORS = 32
"""Squares are counted in steps of this number: four vectors of 512 bits."""

TRIALS = 8
"""Maximum number of limits tried; three or four are usual."""


@kernel(error_model='numpy', fastmath={'nnan'})
def keep_least(squares, indices, count, k, high, floats):
    """
    Move the k smallest of the first count squares to the front; return the largest of them.

    squares  (C,) float64, in and out; C a multiple of VECTORS, those past count are overwritten
    indices  (C,) int32, in and out: indices of the points, moved with the squares
    high     float64: none of the squares is larger
    floats   (FLOATS,) float32, overwritten

    On a surface the number of points within a distance grows with its square, so a limit with k
    of many squares below it is found by a few interpolations, counted with vector instructions.
    """
    if count <= U(FLOATS):
        count = U(keep_ranked(squares, indices, count, k, floats))
        return largest(squares, k) if count == k else select(squares, indices, count, k)
    if high == math.inf:
        return select(squares, indices, count, k)
    end = (count + U(VECTORS - 1)) & ~U(VECTORS - 1)
    for i in range(count, end):
        squares[i] = math.inf
    low, num_low, num_high, wanted = 0.0, np.int64(0), np.int64(count), np.int64(k)
    for _ in range(TRIALS):
        share = (np.float64(wanted - num_low) + 0.5) / np.float64(num_high - num_low + 1)
        limit = low + (high - low) * share
        below = np.int64(0)
        for i in range(end):
            below += np.int64(squares[i] < limit)
        if below == wanted:
            kept = U(0)
            for i in range(count):  # the others are not needed: no swaps, as move_below has them
                value, index = squares[i], indices[i]
                squares[kept], indices[kept] = value, index
                kept += U(value < limit)
            return largest(squares, k)
        if below < wanted:
            low, num_low = limit, below
        else:
            high, num_high = limit, below
    return select(squares, indices, count, k)


@inlined()
def keep_ranked(squares, indices, count, k, floats):
    """
    Move the squares of rank below k, as float32, to the front; return their number.

    The k smallest are among them. There are more if the next one is rounded to the same number.
    """
    for i in range(U(FLOATS)):
        floats[i] = np.float32(squares[i]) if i < count else np.float32(math.inf)
    kept = U(0)
    for i in range(count):
        squares[kept], indices[kept] = squares[i], indices[i]
        kept += U(num_below(floats, floats[i]) < np.int64(k))
    return kept


@kernel(error_model='numpy', fastmath={'nnan'})
def select(squares, indices, count, k):
    """Partition the first count squares: the k smallest first; return the largest of these."""
    low, high = U(0), count
    while True:
        a, b, c = squares[low], squares[(low + high) >> U(1)], squares[high - U(1)]
        pivot = max(min(a, b), min(max(a, b), c))
        less = move_below(squares, indices, low, high, pivot)
        if less == k:
            return largest(squares, k)
        if less > k:
            high = less
            continue
        equal = move_up_to(squares, indices, less, high, pivot)
        if equal >= k:
            return pivot
        low = equal


@inlined()
def largest(squares, count):
    """
    Return the largest of the first squares.

    With one maximum instead of four each comparison waits for the one before it, and the search
    for 30 neighbours takes 1.08 times as long.
    """
    first = second = third = fourth = 0.0
    i = U(0)
    while i + U(4) <= count:
        first, second = max(first, squares[i]), max(second, squares[i + U(1)])
        third, fourth = max(third, squares[i + U(2)]), max(fourth, squares[i + U(3)])
        i += U(4)
    while i < count:
        first = max(first, squares[i])
        i += U(1)
    return max(max(first, second), max(third, fourth))


@kernel()
def sort(squares, indices, order, count):
    """Sort the neighbours by distance, equally near ones by row."""
    for i in range(U(1), count):
        value, index, later = squares[i], indices[i], i
        while later > U(0):
            earlier = later - U(1)
            farther = squares[earlier] > value
            if squares[earlier] == value:
                farther = order[U(indices[earlier])] > order[U(index)]
            if not farther:
                break
            squares[later], indices[later] = squares[earlier], indices[earlier]
            later = earlier
        squares[later], indices[later] = value, index
