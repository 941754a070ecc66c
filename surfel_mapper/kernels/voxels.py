# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Add the moments of a scan to a map and subtract them again.

Both are integer sums by voxel, so that the second undoes the first to the bit, in any order.
Rows of the slab are visited in the order of the scan; the bucket and then the row of voxels
further on are asked for ahead, which hides most of the cache misses.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.hashing import (
    CHANGED,
    DEPTH,
    find_row,
    first_bucket,
    FREE_ROW,
    FULL,
    hash_key,
    insert_row,
    POINTS,
    remove_row,
    ROWS_USED,
    split_segment,
    VOXELS,
)
from surfel_mapper.kernels.layout import COUNT, KEY, PRODUCT, ROW, SUM, VERSION, VIEW
from surfel_mapper.kernels.prefetch import prefetch

AHEAD = 16
"""So many voxels ahead the bucket is asked for, and half as many ahead the row."""


@njit(cache=True, nogil=True, inline='always')
def ask_ahead(keys, place, flat, directory, buckets, depth):
    """Ask for the bucket of the voxel AHEAD of place and for the row of one half as far."""
    if place + AHEAD < len(keys):
        hashed = hash_key(keys[place + AHEAD])
        prefetch(buckets, first_bucket(hashed, directory, depth))
    if place + AHEAD // 2 < len(keys):
        hashed = hash_key(keys[place + AHEAD // 2])
        row = (buckets[first_bucket(hashed, directory, depth)] & 0xFFFFFFFF) - 1
        if row >= 0:  # a guess: the voxel may be in a later bucket
            prefetch(flat, row * ROW)
            prefetch(flat, row * ROW + ROW // 2)


@njit(cache=True, nogil=True)
def find_rows(keys, rows, table, state, found):
    """
    Look up the row of every voxel.

    keys   (K,) int64
    found  (K,) int32, out: row, -1 where the map has no such voxel
    """
    directory, buckets, _, _ = table
    flat = rows.ravel()
    depth = state[DEPTH]
    for place in range(len(keys)):
        ask_ahead(keys, place, flat, directory, buckets, depth)
        found[place] = find_row(keys[place], rows, table, depth)


@njit(cache=True, nogil=True)
def add_moments(moments, view_weight, rows, table, state, version, start, changed):
    """
    Add the moments of a scan from row start on; return how many rows are done.

    moments      keys (K,) int64, count (K,), total (K, 3), product (K, 6), view (K, 3)
    view_weight  0: the view is multiplied by the count; 1: it is a sum already
    version      int64, marks the rows as changed
    changed      (K,) int32, out: rows changed, each once; state says how many

    Fewer than K are done when rows, segments or the directory are too small for a new voxel:
    make room and go on from there.
    """
    keys, count, total, product, view = moments
    directory, buckets, held, _ = table
    flat = rows.ravel()
    depth = state[DEPTH]
    for place in range(start, len(keys)):
        ask_ahead(keys, place, flat, directory, buckets, depth)
        key = keys[place]
        row = find_row(key, rows, table, depth)
        if row < 0:
            hashed = hash_key(key)
            while held[directory[hashed >> (32 - depth)]] >= FULL:
                if not split_segment(hashed, table, state):
                    return place
            row = state[FREE_ROW]
            if row >= 0:
                state[FREE_ROW] = rows[row, KEY]
            elif state[ROWS_USED] < len(rows):
                row = state[ROWS_USED]
                state[ROWS_USED] = row + 1
            else:
                return place
            rows[row, :] = 0
            rows[row, KEY] = key
            insert_row(hashed, row, table, depth)
            state[VOXELS] += 1
        n = np.int64(count[place])
        weight = n if view_weight == 0 else np.int64(1)
        state[POINTS] += n
        rows[row, COUNT] += n
        for axis in range(3):
            rows[row, SUM + axis] += total[place, axis]
            rows[row, VIEW + axis] += weight * view[place, axis]
        for pair in range(6):
            rows[row, PRODUCT + pair] += product[place, pair]
        if rows[row, VERSION] != version:
            rows[row, VERSION] = version
            changed[state[CHANGED]] = row
            state[CHANGED] += 1
    return len(keys)


@njit(cache=True, nogil=True)
def first_missing(moments, view_weight, rows, found):
    """
    Return the first voxel whose moments cannot be subtracted, or -1 if all can.

    found  (K,) int32, row of each voxel

    A voxel must hold at least the points subtracted, and exactly their sums where it holds no
    others.
    """
    keys, count, total, product, view = moments
    for place in range(len(keys)):
        row = found[place]
        if row < 0 or rows[row, COUNT] < count[place]:
            return place
        if rows[row, COUNT] == count[place]:
            weight = np.int64(count[place]) if view_weight == 0 else np.int64(1)
            for axis in range(3):
                if rows[row, SUM + axis] != total[place, axis]:
                    return place
                if rows[row, VIEW + axis] != weight * view[place, axis]:
                    return place
            for pair in range(6):
                if rows[row, PRODUCT + pair] != product[place, pair]:
                    return place
    return -1


@njit(cache=True, nogil=True)
def subtract_moments(
    moments, view_weight, rows, table, state, version, found, min_points, fallen
):
    """
    Subtract moments that the map holds, and free the rows that become empty.

    found       (K,) int32, row of each voxel
    min_points  from how many points on a voxel counts, at least 1
    fallen      (K,) int64, out: keys of the voxels that counted before and do not any more

    Returns how many voxels have fallen.
    """
    keys, count, total, product, view = moments
    depth = state[DEPTH]
    flat = rows.ravel()
    num_fallen = 0
    for place in range(len(keys)):
        if place + AHEAD < len(keys):
            prefetch(flat, np.int64(found[place + AHEAD]) * ROW)
            prefetch(flat, np.int64(found[place + AHEAD]) * ROW + ROW // 2)
        row = np.int64(found[place])
        n = np.int64(count[place])
        state[POINTS] -= n
        rows[row, VERSION] = version
        key = keys[place]
        if rows[row, COUNT] >= min_points > rows[row, COUNT] - n:
            fallen[num_fallen] = key
            num_fallen += 1
        if rows[row, COUNT] == n:
            remove_row(key, row, table, depth)
            state[VOXELS] -= 1
            rows[row, COUNT] = 0
            rows[row, KEY] = state[FREE_ROW]
            state[FREE_ROW] = row
            continue
        weight = n if view_weight == 0 else np.int64(1)
        rows[row, COUNT] -= n
        for axis in range(3):
            rows[row, SUM + axis] -= total[place, axis]
            rows[row, VIEW + axis] -= weight * view[place, axis]
        for pair in range(6):
            rows[row, PRODUCT + pair] -= product[place, pair]
    return num_fallen
