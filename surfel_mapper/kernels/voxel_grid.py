# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Group the points of a scan by voxel and sum their coordinates, as libpointmatcher's VoxelGrid.

Runs and table are those of kernels/grouping.py. Two things differ from the reduction of the map:
coordinates are divided by the edge, not multiplied by its inverse, so that a point on a face goes
to the same voxel as in libpointmatcher; and the table grows while it fills, because a filter keeps
no memory between scans.

Indices are relative to the lowest voxel, so that a key needs only as many bits as the extent of
the scan. There is no dense grid.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.grouping import CHUNK, enlarged_table, find_run_rows, find_runs

ROWS = 4096
"""Initial number of voxels that the table has room for."""


@njit(cache=True, nogil=True, error_model='numpy')
def group_points(xyz, size, shift, base, bits, keys, sums, first, rows):
    """
    Group points by voxel; return the number of occupied voxels.

    xyz    (3, N) float32 or float64, finite, m
    size   (3,) float64, edges of a voxel, m
    shift  (3,) float64, voxels by which the grid is moved: index = floor(x / size - shift)
    base   (3,) float64, index of the lowest voxel
    bits   (3,) int64, bits that the index of an axis needs, at most 31 each and 62 together
    keys   (N,) int64, out: voxel keys in the order of first appearance; x is lowest
    sums   (N, 4) float64, out: sum of x, y, z and number of points, by voxel
    first  (N,) int64, out: first point of each voxel
    rows   (N,) or (0,) int32, out if N long: voxel of each point
    """
    table = np.full(4 * ROWS, -1, np.int32)
    chunk_keys = np.empty(CHUNK, np.int64)
    starts = np.empty(CHUNK + 1, np.int32)
    run_rows = np.empty(CHUNK, np.int32)
    num_rows = num_first = 0
    all_x, all_y, all_z = xyz[0], xyz[1], xyz[2]
    for start in range(0, len(all_x), CHUNK):
        chunk = slice(start, start + CHUNK)
        x, y, z = all_x[chunk], all_y[chunk], all_z[chunk]
        find_keys(x, y, z, size, shift, base, bits, chunk_keys)
        num_runs = find_runs(chunk_keys, len(x), starts)
        if 4 * (num_rows + num_runs) > len(table):
            table = enlarged_table(table, keys, num_rows)
        num_rows = find_run_rows(
            chunk_keys, starts, num_runs, table, keys, sums, num_rows, run_rows
        )
        add_runs(x, y, z, starts, num_runs, run_rows, sums)
        for run in range(num_runs):
            # rows are numbered as they appear; a branch would be mispredicted at new voxels
            first[num_first] = start + starts[run]
            num_first += run_rows[run] == num_first
        if len(rows) > 0:
            for run in range(num_runs):
                rows[start + starts[run] : start + starts[run + 1]] = run_rows[run]
    return num_rows


@njit(cache=True, nogil=True, error_model='numpy')
def find_keys(x, y, z, size, shift, base, bits, keys):
    """Compute the voxel key of every point of a chunk, with vector instructions."""
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
def add_runs(x, y, z, starts, num_runs, run_rows, sums):
    """
    Add the runs of a chunk to the sums of their voxels, point by point in order.

    One call for all runs, with unsigned indices: a call for each run takes four times as long.
    """
    for run in range(num_runs):
        row = np.uint32(run_rows[run])
        begin, end = np.uint32(starts[run]), np.uint32(starts[run + 1])
        sx, sy, sz, count = sums[row, 0], sums[row, 1], sums[row, 2], sums[row, 3]
        for i in range(begin, end):
            sx += np.float64(x[i])
            sy += np.float64(y[i])
            sz += np.float64(z[i])
        sums[row, 0] = sx
        sums[row, 1] = sy
        sums[row, 2] = sz
        sums[row, 3] = count + np.float64(end - begin)
