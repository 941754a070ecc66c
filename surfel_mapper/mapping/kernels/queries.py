# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Select rows of the slab: by box, and by the hash of the voxel key.

By hash: a thinned selection holds the voxels whose mixed keys are below a limit, and no others. So
the key alone tells whether a voxel may be selected, without a look-up.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.compiling import kernel, U
from surfel_mapper.kernels.grouping import find_key, hash_shift
from surfel_mapper.kernels.layout import KEY
from surfel_mapper.kernels.quantisation import unpack
from surfel_mapper.mapping.kernels.rows import count_of, first_word

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio, odd."""


@kernel()
def keys_in_box(rows, used, low, high):
    """Return the keys of occupied voxels with indices from low to high, (3,) int64 each."""
    kept = np.empty(used, np.int64)
    flat = rows.ravel()
    num = 0
    for row in range(used):
        key = flat[first_word(row) + U(KEY)]
        kx, ky, kz = unpack(key)
        inside = low[0] <= kx <= high[0] and low[1] <= ky <= high[1] and low[2] <= kz <= high[2]
        if inside and count_of(flat, first_word(row)) > 0:
            kept[num] = key
            num += 1
    return kept[:num].copy()


@njit(cache=True, nogil=True, inline='always')
def mix(key):
    """Return the mixed key of a voxel, uint64; neighbouring voxels differ in all bits."""
    mixed = np.uint64(key) * _GOLDEN
    mixed ^= mixed >> np.uint64(29)
    mixed *= _GOLDEN
    mixed ^= mixed >> np.uint64(29)
    return mixed * _GOLDEN


@kernel()
def rows_held(rows, used, min_points, chosen, mixed):
    """
    List the rows of at least min_points points with their mixed keys; return their number.

    rows    (R, 12) int64, the slab
    used    number of rows ever used
    chosen  (R,) int32, out
    mixed   (R,) uint64, out
    """
    flat = rows.ravel()
    num = 0
    for row in range(used):
        at = first_word(row)
        if count_of(flat, at) >= min_points:
            chosen[num] = row
            mixed[num] = mix(flat[at + U(KEY)])
            num += 1
    return num


@kernel()
def mark_observed(observed, keys, table, stamp, stamps):
    """
    Raise the stamps of the surfels in voxels that a scan observed to that of the scan.

    observed  (S,) int64, voxel keys of the scan
    keys      (K,) int64, of the surfels
    table     (B,) int32, hash table of the keys, as build_table makes it
    stamp     int64
    stamps    (K,) int64, in and out
    """
    shift = hash_shift(len(table))
    for key in observed:
        row = find_key(key, keys, table, shift)
        if row >= 0:
            stamps[row] = max(stamps[row], stamp)
