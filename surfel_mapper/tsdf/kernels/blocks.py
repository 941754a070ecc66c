# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Find, place and remove the blocks of a TSDF in the hash table of kernels/hashing.py.

Every block has one row in each slab; the slab of heads holds key, version and stamp. Free rows
form a linked list through their keys, as those of surfels do.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.hashing import (
    DEPTH,
    find_row,
    FREE_ROW,
    hash_key,
    insert_entry,
    makes_room,
    NEXT_ROW,
    remove_entry,
    SEGMENT,
    VOXELS,
)
from surfel_mapper.kernels.layout import KEY

# Columns of a head beside KEY.
VERSION = 1
"""Version of the map at the last change of the block; NEW or FREE otherwise."""
STAMP = 2
"""Stamp of the measurement that changed it last, ns."""
SURFACE = 3
"""Version of the map at the last change that moved or changed triangles."""
DRIFT = 4
"""Sum of the largest changes of a distance since then, micrometres."""
FREE_VISITS = 5
"""Measurements in a row after which all observed voxels were free."""
INSIDE = 6
"""Number of observed voxels behind a surface."""
HEAD = 8
"""Columns of a head; the last is unused, because rows of a slab divide a page."""

NEW = -1
"""Version of a block that was placed but never changed."""
FREE = -2
"""Version of a free row."""


@njit(cache=True, nogil=True)
def find_blocks(keys, head, table, state, rows):
    """
    Look up the row of every block.

    keys  (K,) int64; negative keys are never found
    rows  (K,) int64, out: row, -1 for blocks not in the map
    """
    depth = state[DEPTH]
    for i in range(len(keys)):
        rows[i] = find_row(keys[i], head, table, depth) if keys[i] >= 0 else -1


@njit(cache=True, nogil=True)
def place_blocks(keys, head, table, state, start, rows):
    """
    Look up the row of every block from start on; place missing blocks.

    keys  (K,) int64
    rows  (K,) int64, out

    Returns the number of blocks done; fewer than K if rows, segments or the directory are full:
    make room and continue from there.
    """
    depth, (directory, buckets, counts, _) = state[DEPTH], table
    entries = np.empty(SEGMENT, np.int64)
    for i in range(start, len(keys)):
        key = keys[i]
        row = find_row(key, head, table, depth)
        if row < 0:
            hashed = hash_key(key)
            if not makes_room(hashed, table, state, entries):
                return i
            row = state[FREE_ROW]
            if row >= 0:
                state[FREE_ROW] = head[row, KEY]
            elif state[NEXT_ROW] < len(head):
                row = state[NEXT_ROW]
                state[NEXT_ROW] = row + 1
            else:
                return i
            head[row, KEY] = key
            head[row, VERSION] = NEW
            head[row, STAMP:] = 0
            insert_entry(hashed, row, directory, buckets, counts, depth)
            state[VOXELS] += 1
        rows[i] = row
    return len(keys)


@njit(cache=True, nogil=True)
def remove_blocks(rows, head, table, state):
    """Remove the blocks of rows, (K,) int64, from the table and free the rows."""
    directory, buckets, counts, _ = table
    for i in range(len(rows)):
        row = np.int64(rows[i])
        remove_entry(hash_key(head[row, KEY]), row, directory, buckets, counts, state[DEPTH])
        head[row, KEY] = state[FREE_ROW]
        head[row, VERSION] = FREE
        state[FREE_ROW] = row
        state[VOXELS] -= 1
