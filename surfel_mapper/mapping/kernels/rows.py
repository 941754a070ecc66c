# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Read and write the row of a voxel, in the layout of kernels/layout.py.

With a word for each of key, count, sums, products and views a row would have 14. The count and
the third view sum are kept in pieces instead, in bits that other sums never reach: that takes less
time than a third cache line.

The functions take the slab as one array of words, flat (R * 12,) int64, and the place ``at`` of
the first word of a row, uint64. With a row and a column every access multiplies by the width and
tests for negative indices: adding a scan took 1.1 times as long.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.compiling import kernel, U
from surfel_mapper.kernels.layout import KEY, PIECE, PRODUCT, ROW, SUM, VIEW
from surfel_mapper.kernels.prefetch import prefetch, prefetch_early

LOW = (1 << PIECE) - 1
"""Mask of a piece."""


@njit(cache=True, nogil=True, inline='always')
def prefetch_row(flat, row):
    """Prefetch both cache lines of a row; flat (R * 12,) int64."""
    prefetch(flat, row * ROW)
    prefetch(flat, row * ROW + ROW - 1)


@njit(cache=True, nogil=True, inline='always')
def prefetch_row_early(flat, row):
    """Prefetch a row as ``prefetch_row`` does, but early."""
    prefetch_early(flat, row * ROW)
    prefetch_early(flat, row * ROW + ROW - 1)


@njit(cache=True, nogil=True, inline='always')
def first_word(row):
    """Return the place of the first word of a row, not negative, in the flat slab; uint64."""
    return U(row) * U(ROW)


@njit(cache=True, nogil=True, inline='always')
def count_of(flat, at):
    """Return the number of points of the voxel whose row begins at a word."""
    return (flat[at + U(VIEW)] & LOW) | ((flat[at + U(VIEW + 1)] & LOW) << PIECE)


@njit(cache=True, nogil=True, inline='always')
def sum_of(flat, at, axis):
    """Return the sum of the positions of a voxel along an axis."""
    return flat[at + U(SUM) + U(axis)] >> PIECE


@njit(cache=True, nogil=True, inline='always')
def view_of(flat, at):
    """Return the sum of the views of a voxel, x y z."""
    highest = (flat[at + U(SUM + 2)] << (64 - PIECE)) >> (64 - 3 * PIECE)
    medium = (flat[at + U(SUM + 1)] & LOW) << PIECE
    z = highest | medium | (flat[at + U(SUM)] & LOW)
    return flat[at + U(VIEW)] >> PIECE, flat[at + U(VIEW + 1)] >> PIECE, z


@njit(cache=True, nogil=True, inline='always')
def add_to_row(flat, at, n, total, view):
    """
    Add to count, sum and view of a row.

    n            int64
    total, view  x, y, z, int64 each
    """
    count = count_of(flat, at) + n
    x, y, z = view_of(flat, at)
    z += view[2]
    flat[at + U(VIEW)] = ((x + view[0]) << PIECE) | (count & LOW)
    flat[at + U(VIEW + 1)] = ((y + view[1]) << PIECE) | (count >> PIECE)
    for axis in range(3):
        piece = (z >> (axis * PIECE)) & LOW
        moved = sum_of(flat, at, axis) + total[axis]
        flat[at + U(SUM) + U(axis)] = (moved << PIECE) | piece


@kernel()
def read_rows(rows, chosen, moments):
    """
    Read the moments of some rows.

    rows     (R, 12) int64, the slab
    chosen   (K,) int32 or int64
    moments  out: keys (K,) int64, count (K,), total (K, 3), product (K, 6), view (K, 3)
    """
    keys, count, total, product, view = moments
    flat = rows.ravel()
    for i in range(len(chosen)):
        at = first_word(chosen[i])
        keys[i] = flat[at + U(KEY)]
        count[i] = count_of(flat, at)
        view[i, 0], view[i, 1], view[i, 2] = view_of(flat, at)
        for axis in range(3):
            total[i, axis] = sum_of(flat, at, axis)
        for pair in range(6):
            product[i, pair] = flat[at + U(PRODUCT) + U(pair)]


@kernel()
def write_rows(moments, rows):
    """
    Write the moments of voxels, keys to views as of read_rows, to rows (K, 12) int64.

    A view is a sum over the points of its voxel.
    """
    keys, count, total, product, view = moments
    flat = rows.ravel()
    for row in range(len(keys)):
        rows[row, :] = 0
        rows[row, KEY] = keys[row]
        sums = np.int64(total[row, 0]), np.int64(total[row, 1]), np.int64(total[row, 2])
        views = np.int64(view[row, 0]), np.int64(view[row, 1]), np.int64(view[row, 2])
        add_to_row(flat, first_word(row), np.int64(count[row]), sums, views)
        for pair in range(6):
            rows[row, PRODUCT + pair] = product[row, pair]


@kernel()
def read_counts(rows, chosen, counts):
    """Read the counts of some rows (K,) int32 or int64 into (K,) int64, 0 for rows of -1."""
    flat = rows.ravel()
    for i in range(len(chosen)):
        counts[i] = count_of(flat, first_word(chosen[i])) if chosen[i] >= 0 else 0
