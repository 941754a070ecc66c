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
    hash_key,
    insert_row,
    is_full,
    likely_row,
    POINTS,
    remove_row,
    ROWS_USED,
    split_segment,
    VOXELS,
)
from surfel_mapper.kernels.layout import COUNT, KEY, PRODUCT, ROW, SUM, VERSION, VIEW
from surfel_mapper.kernels.prefetch import prefetch

AHEAD = 16
"""Rows known beforehand are asked for so many voxels ahead."""

BLOCK = 32
"""Voxels looked up together: all buckets are asked for, then all rows, then the rows used."""


@njit(cache=True, nogil=True, inline='always')
def look_up(keys, start, num, flat, directory, buckets, depth, hashes, likely):
    """
    Find the rows of num voxels from start on, and ask for them.

    flat    (R * 16,) int64, the rows
    hashes  (BLOCK,) int64, out
    likely  (BLOCK,) int64, out: a row with the hash of the voxel, and almost surely its key;
            -1 where the map has none
    """
    for i in range(num):
        hashed = hash_key(keys[start + i])
        hashes[i] = hashed
        prefetch(buckets, first_bucket(hashed, directory, depth))
    for i in range(num):
        row = likely_row(hashes[i], directory, buckets, depth)
        likely[i] = row
        if row >= 0:
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
    hashes, likely = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64)
    for start in range(0, len(keys), BLOCK):
        num = min(BLOCK, len(keys) - start)
        look_up(keys, start, num, flat, directory, buckets, depth, hashes, likely)
        for i in range(num):
            row = likely[i]
            if row >= 0 and rows[row, KEY] != keys[start + i]:
                row = find_row(keys[start + i], rows, table, depth)
            found[start + i] = row


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
    directory, buckets, _, _ = table
    flat = rows.ravel()
    depth = state[DEPTH]
    hashes, likely = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64)
    num_changed, num_points = state[CHANGED], np.int64(0)
    done = start
    while done < len(keys):
        num = min(BLOCK, len(keys) - done)
        look_up(keys, done, num, flat, directory, buckets, depth, hashes, likely)
        for i in range(num):
            place = done + i
            key = keys[place]
            row = likely[i]
            if row >= 0 and rows[row, KEY] != key:
                row = find_row(key, rows, table, depth)
            if row < 0:
                row = new_row(key, hashes[i], rows, table, state)
                if row < 0:
                    state[CHANGED], state[POINTS] = num_changed, state[POINTS] + num_points
                    return place
            n = np.int64(count[place])
            weight = n if view_weight == 0 else np.int64(1)
            num_points += n
            rows[row, COUNT] += n
            for axis in range(3):
                rows[row, SUM + axis] += total[place, axis]
                rows[row, VIEW + axis] += weight * view[place, axis]
            for pair in range(6):
                rows[row, PRODUCT + pair] += product[place, pair]
            if rows[row, VERSION] != version:
                rows[row, VERSION] = version
                changed[num_changed] = row
                num_changed += 1
        done += num
    state[CHANGED], state[POINTS] = num_changed, state[POINTS] + num_points
    return done


@njit(cache=True, nogil=True)
def new_row(key, hashed, rows, table, state):
    """Return a row of zeros for a voxel that the map has not, or -1 where there is no room."""
    depth = state[DEPTH]
    while is_full(hashed, table, depth):
        if not split_segment(hashed, table, state):
            return np.int64(-1)
    row = state[FREE_ROW]
    if row >= 0:
        state[FREE_ROW] = rows[row, KEY]
        prefetch(rows.ravel(), state[FREE_ROW] * ROW)  # the next new voxel's
    elif state[ROWS_USED] < len(rows):
        row = state[ROWS_USED]
        state[ROWS_USED] = row + 1
    else:
        return np.int64(-1)
    rows[row, :] = 0
    rows[row, KEY] = key
    insert_row(hashed, row, table, depth)
    state[VOXELS] += 1
    return row


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
def subtract_moments(moments, view_weight, rows, table, state, version, found, min_points, fallen):
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
