# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Look up the surfel of each point of a scan; apart from the kernels that draw markers."""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.grouping import CHUNK, find_key, hash_shift
from surfel_mapper.kernels.quantisation import quantise


@njit(cache=True, nogil=True)
def attach_surfels(xyz, quantisation, surfels, keys, table, floats, counts):
    """
    Write normal, planarity and number of points of the surfel in whose voxel each point lies.

    xyz           (3, N) float32 or float64, m, sensor frame
    quantisation  pose (3, 4), scale and range_sq (2,) as ``reduce_points`` takes them
    surfels       normal (K, 3), planarity (K,) float64, number of points (K,) int64
    keys          (K,) int64, their voxel keys
    table         (B,) int32, hash table of the keys, as build_table makes it
    floats        (N, 5) float32, out: normal x y z and planarity in the first four columns
    counts        (N, 5) uint32, out: the same memory, number of points in the last column

    Points without a surfel get nan and 0.
    """
    pose, scale, range_sq = quantisation
    normal, planarity, number = surfels
    x, y, z = xyz
    shift = hash_shift(len(table))
    chunk_keys = np.empty(CHUNK, np.int64)
    packed = np.empty(CHUNK, np.int64)
    for start in range(0, len(x), CHUNK):
        end = min(start + CHUNK, len(x))
        quantise(
            x[start:end],
            y[start:end],
            z[start:end],
            pose,
            scale,
            range_sq,
            chunk_keys,
            packed,
        )
        key, row = np.int64(-1), np.int64(-1)
        for i in range(start, end):
            if chunk_keys[i - start] != key:  # neighbours mostly share their voxel
                key = chunk_keys[i - start]
                row = find_key(key, keys, table, shift) if key >= 0 else np.int64(-1)
            if row >= 0:
                for axis in range(3):
                    floats[i, axis] = normal[row, axis]
                floats[i, 3] = planarity[row]
                counts[i, 4] = number[row]
            else:
                floats[i, :4] = math.nan
                counts[i, 4] = 0
