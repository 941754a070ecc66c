# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Choose some of many voxels by a hash of their keys.

Whatever is chosen has a hash below some bound, and nothing else has. So whether a voxel may be
among those chosen is known from its key alone, without looking it up.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.layout import COUNT, KEY
from surfel_mapper.kernels.moments import hash_shift
from surfel_mapper.kernels.queries import find_key

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio, odd."""


@njit(cache=True, nogil=True, inline='always')
def mix(key):
    """Return the hash of a voxel key, uint64: neighbours are far apart in all of its bits."""
    mixed = np.uint64(key) * _GOLDEN
    mixed ^= mixed >> np.uint64(29)
    mixed *= _GOLDEN
    mixed ^= mixed >> np.uint64(29)
    return mixed * _GOLDEN


@njit(cache=True, nogil=True)
def mix_keys(keys, mixed):
    """Write the hash of every key, (K,) int64 to (K,) uint64."""
    for i in range(len(keys)):
        mixed[i] = mix(keys[i])


@njit(cache=True, nogil=True)
def rows_held(rows, used, min_points, chosen, mixed):
    """
    List the rows of a slab with at least so many points and the hashes of their voxels.

    rows    (R, 16) int64, of which so many are in use
    chosen  (R,) int32, out
    mixed   (R,) uint64, out

    Returns how many.
    """
    num = 0
    for row in range(used):
        if rows[row, COUNT] >= min_points:
            chosen[num] = row
            mixed[num] = mix(rows[row, KEY])
            num += 1
    return num


@njit(cache=True, nogil=True)
def mark_seen(seen, limit, keys, table, marks, mark, left):
    """
    Mark the surfels whose voxels a scan saw, unless they are marked already.

    seen    (S,) int64, voxel keys of the scan
    limit   uint64, no hash of a surfel's voxel is larger
    keys    (K,) int64, of the surfels
    table   (B,) int32, hash table of the keys, as build_table makes it
    marks   (K,) int64, in and out: -1 where there is no mark yet
    mark    int64
    left    (S,) int64, out: the keys seen but for those of surfels that were marked already

    Returns how many surfels were marked, and how many keys are left.
    """
    shift = hash_shift(len(table))
    num = num_left = 0
    for key in seen:
        if mix(key) <= limit:
            row = find_key(key, keys, table, shift)
            if row >= 0:
                if marks[row] >= 0:
                    continue
                marks[row] = mark
                num += 1
        left[num_left] = key
        num_left += 1
    return num, num_left


@njit(cache=True, nogil=True)
def keys_within(keys, limit, within):
    """
    List the keys whose hashes are at most a limit; return how many.

    keys    (S,) int64
    limit   uint64
    within  (S,) int64, out
    """
    num = 0
    for key in keys:
        within[num] = key
        num += mix(key) <= limit
    return num
