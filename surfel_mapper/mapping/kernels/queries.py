# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Keys of the voxels in a box, and the newest stamps of voxels."""

import numpy as np

from surfel_mapper.kernels.compiling import kernel, U
from surfel_mapper.kernels.grouping import find_key, hash_shift
from surfel_mapper.kernels.layout import KEY
from surfel_mapper.kernels.quantisation import unpack
from surfel_mapper.mapping.kernels.rows import count_of, first_word


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
