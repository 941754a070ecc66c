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

from surfel_mapper.kernels.compiling import inlined, U
from surfel_mapper.kernels.grouping import AHEAD, CHUNK, enlarged_table, find_runs, number_runs

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
    keys   (N + 2,) int64, out: voxel keys in the order of first appearance, from keys[1] on; x is
           lowest
    sums   (N + 1, 4) float64, out: sum of x, y, z and number of points, by voxel
    first  (N + 1,) int64, out: first point of each voxel
    rows   (N,) or (0,) int32, out if N long: voxel of each point

    One more row than there may be voxels, because the next one is prepared before it is needed.
    """
    table = np.full(4 * ROWS, -1, np.int32)
    chunk_keys = np.zeros(CHUNK + 1, np.int64)
    starts = np.zeros(CHUNK + AHEAD, np.int32)
    run_rows = np.empty(CHUNK, np.int32)
    num_rows = np.int64(0)
    all_x, all_y, all_z = xyz[0], xyz[1], xyz[2]
    flat = sums.ravel()
    for start in range(0, len(all_x), CHUNK):
        chunk = slice(start, start + CHUNK)
        x, y, z = all_x[chunk], all_y[chunk], all_z[chunk]
        find_keys(x, y, z, size, shift, base, bits, chunk_keys)
        num_runs = find_runs(chunk_keys, len(x), starts)
        if 4 * (num_rows + num_runs) > len(table):
            table = enlarged_table(table, keys[1:], num_rows)
        new_row = num_rows
        num_rows = number_runs(chunk_keys, starts, num_runs, table, keys, num_rows, run_rows)
        sums[new_row:num_rows] = 0.0
        for run in range(U(num_runs)):
            # rows are numbered as they appear; a branch would be mispredicted at new voxels
            first[new_row] = start + np.int64(starts[run])
            new_row += run_rows[run] == new_row
        add_points(x, y, z, chunk_keys, run_rows, flat)
        if len(rows) > 0:
            spread_rows(chunk_keys, run_rows, rows[chunk])
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


@inlined()
def add_points(x, y, z, chunk_keys, run_rows, flat):
    """Add the points of a chunk to the sums of their voxels; branches would be mispredicted."""
    run, previous = U(0), chunk_keys[0]
    for i in range(U(len(x))):
        run += U(chunk_keys[i] != previous)
        previous = chunk_keys[i]
        at = U(4) * U(np.uint32(run_rows[run]))
        sx, sy, sz, count = flat[at], flat[at + U(1)], flat[at + U(2)], flat[at + U(3)]
        sx += np.float64(x[i])
        sy += np.float64(y[i])
        sz += np.float64(z[i])
        count += 1.0
        flat[at], flat[at + U(1)], flat[at + U(2)], flat[at + U(3)] = sx, sy, sz, count


@inlined()
def spread_rows(chunk_keys, run_rows, rows):
    """Write the row of each point of a chunk, (P,) int32, from those of the runs."""
    run, previous = U(0), chunk_keys[0]
    for i in range(U(len(rows))):
        run += U(chunk_keys[i] != previous)
        previous = chunk_keys[i]
        rows[i] = run_rows[run]
