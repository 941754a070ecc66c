# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Group the points of a scan by voxel and sum their coordinates.

As the moments of the map: points are worked on in chunks, each cut into runs of one voxel, and a
run is one look-up and one sum in registers. Unlike there, coordinates are divided by the edge
instead of multiplied by its inverse, because a point on a face of a voxel belongs where
libpointmatcher puts it, and the table grows while it fills, because a filter keeps no memory
between scans.

Indices are relative to the lowest voxel, so that the key of a voxel needs only as many bits as
the extent of the scan, not its place; there is no dense grid.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.moments import AHEAD, CHUNK, find_runs, hash_shift, home
from surfel_mapper.kernels.prefetch import prefetch

ROWS = 4096
"""The table is made for so many voxels at first."""


@njit(cache=True, nogil=True, error_model='numpy')
def group_points(xyz, size, shift, base, bits, keys, sums, first, rows):
    """
    Group points by voxel; return how many voxels hold any.

    xyz    (3, N) float32 or float64, finite, m
    size   (3,) float64, edges of a voxel, m
    shift  (3,) float64, voxels by which the grid is moved: index = floor(x / size - shift)
    base   (3,) float64, index of the lowest voxel
    bits   (3,) int64, bits that the index of an axis needs, at most 31 each and 62 together
    keys   (N,) int64, out: of the voxels, in the order of first appearance; x is lowest
    sums   (N, 4) float64, out: sum of x, y, z and number of points, by voxel
    first  (N,) int64, out: first point of each voxel
    rows   (N,) or (0,) int32, out where N long: voxel of each point
    """
    table = np.full(2 * ROWS, -1, np.int32)
    chunk_keys = np.empty(CHUNK, np.int64)
    starts = np.empty(CHUNK + 1, np.int32)
    run_rows = np.empty(CHUNK, np.int32)
    num_rows = 0
    all_x, all_y, all_z = xyz[0], xyz[1], xyz[2]
    for start in range(0, len(all_x), CHUNK):
        chunk = slice(start, start + CHUNK)
        x, y, z = all_x[chunk], all_y[chunk], all_z[chunk]
        find_keys(x, y, z, size, shift, base, bits, chunk_keys)
        num_runs = find_runs(chunk_keys, len(x), starts)
        if 2 * (num_rows + num_runs) > len(table):
            table = grown(table, keys, num_rows)
        num_rows = find_rows(chunk_keys, starts, num_runs, table, keys, sums, num_rows, run_rows)
        add_runs(x, y, z, starts, num_runs, run_rows, start, sums, first)
        if len(rows) > 0:
            for run in range(num_runs):
                rows[start + starts[run] : start + starts[run + 1]] = run_rows[run]
    return num_rows


@njit(cache=True, nogil=True, error_model='numpy')
def find_keys(x, y, z, size, shift, base, bits, keys):
    """Find the voxel key of every point of a chunk; without branches, several at once."""
    sx, sy, sz = size[0], size[1], size[2]
    tx, ty, tz = shift[0], shift[1], shift[2]
    bx, by, bz = base[0], base[1], base[2]
    to_y, to_z = bits[0], bits[0] + bits[1]
    for i in range(len(x)):
        ix = np.int64(np.int32(np.floor(np.float64(x[i]) / sx - tx) - bx))
        iy = np.int64(np.int32(np.floor(np.float64(y[i]) / sy - ty) - by))
        iz = np.int64(np.int32(np.floor(np.float64(z[i]) / sz - tz) - bz))
        keys[i] = ix | (iy << to_y) | (iz << to_z)


@njit(cache=True, nogil=True)
def find_rows(chunk_keys, starts, num_runs, table, keys, sums, num_rows, run_rows):
    """
    Look up the row of each run's voxel, adding rows of zeros for new ones; return their number.

    table     (B,) int32, B a power of two: row of the voxel hashed there, -1 where there is none
    run_rows  (CHUNK,) int32, out: row in keys and sums
    """
    flat = sums.ravel()
    shift = hash_shift(len(table))
    mask = np.uint64(len(table) - 1)
    for run in range(num_runs):
        if run + AHEAD < num_runs:
            prefetch(table, home(chunk_keys[np.uint32(starts[run + AHEAD])], shift))
        key = chunk_keys[np.uint32(starts[run])]
        place = np.uint64(home(key, shift))
        row = table[place]
        while row >= 0 and keys[np.uint32(row)] != key:
            place = (place + np.uint64(1)) & mask
            row = table[place]
        if row < 0:
            row = np.int32(num_rows)
            num_rows += 1
            table[place] = row
            keys[np.uint32(row)] = key
            for column in range(4):
                sums[np.uint32(row), column] = 0.0
        else:
            prefetch(flat, np.int64(row) * 4)
        run_rows[run] = row
    return num_rows


@njit(cache=True, nogil=True)
def grown(table, keys, num_rows):
    """Return a table four times as large with the same rows."""
    larger = np.full(4 * len(table), -1, np.int32)
    shift = hash_shift(len(larger))
    mask = len(larger) - 1
    for row in range(num_rows):
        place = home(keys[row], shift)
        while larger[place] >= 0:
            place = (place + 1) & mask
        larger[place] = row
    return larger


@njit(cache=True, nogil=True)
def add_runs(x, y, z, starts, num_runs, run_rows, start, sums, first):
    """
    Add the runs of a chunk, each to the sums of its voxel, point by point in order.

    All runs in one call: a call for each takes four times as long as the work itself, as do
    indices that might be negative.
    """
    for run in range(num_runs):
        row = np.uint32(run_rows[run])
        begin, end = np.uint32(starts[run]), np.uint32(starts[run + 1])
        sx, sy, sz, count = sums[row, 0], sums[row, 1], sums[row, 2], sums[row, 3]
        if count == 0.0:
            first[row] = start + begin
        for i in range(begin, end):
            sx += np.float64(x[i])
            sy += np.float64(y[i])
            sz += np.float64(z[i])
        sums[row, 0] = sx
        sums[row, 1] = sy
        sums[row, 2] = sz
        sums[row, 3] = count + np.float64(end - begin)
