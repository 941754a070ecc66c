# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Sum what else points carry, by voxel: intensity, colour.

A pass of its own, made only where a map asks for it, so that the usual path pays nothing. It
quantises the points again, by the same kernel, and meets the same runs in the same voxels.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.moments import CHUNK, find_runs, hash_shift, quantise
from surfel_mapper.kernels.queries import find_key


@njit(cache=True, nogil=True, error_model='numpy')
def sum_channels(xyz, pose, scale, range_sq, keys, table, values, sums):
    """
    Sum the values of the points of each voxel.

    xyz, pose, scale, range_sq  as for reduce_points
    keys    (K,) int64, voxel keys of the scan
    table   (B,) int32, their hash table as build_table makes it
    values  (N, C) int32, a row a point
    sums    (K, C) int64, out
    """
    chunk_keys = np.empty(CHUNK, np.int64)
    places = np.empty((3, CHUNK))
    starts = np.empty(CHUNK + 1, np.int32)
    shift = hash_shift(len(table))
    sums[:, :] = 0
    all_x, all_y, all_z = xyz[0], xyz[1], xyz[2]
    for start in range(0, len(all_x), CHUNK):
        chunk = slice(start, start + CHUNK)
        x, y, z = all_x[chunk], all_y[chunk], all_z[chunk]
        quantise(x, y, z, pose, scale, range_sq, chunk_keys, places)
        num_runs = find_runs(chunk_keys, len(x), starts)
        for run in range(num_runs):
            key = chunk_keys[starts[run]]
            if key < 0:
                continue
            row = find_key(key, keys, table, shift)
            for i in range(start + starts[run], start + starts[run + 1]):
                for channel in range(values.shape[1]):
                    sums[row, channel] += values[i, channel]
