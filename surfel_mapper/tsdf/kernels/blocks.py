# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Find, place and remove the blocks of a TSDF in the hash table of hashing.py.

Every block has a row in slabs, the first of which is its head: key, version, stamp. Rows that are
not in use form a chain through their keys, as those of surfels do.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.hashing import (
    DEPTH,
    find_row,
    FREE_ROW,
    hash_key,
    insert_row,
    is_full,
    remove_row,
    ROWS_USED,
    split_segment,
    VOXELS,
)
from surfel_mapper.kernels.layout import KEY

# Columns of a head beside KEY.
VERSION = 1
"""Version of the map when the block last changed; NEW or FREE where there is none."""
STAMP = 2
"""Stamp of the measurement that changed it last, ns."""
HEAD = 4
"""Columns of a head; the last is unused: a slab has rows that divide a page."""

NEW = -1
"""Version of a block that was placed and has never been changed."""
FREE = -2
"""Version of a row that is not in use."""


@njit(cache=True, nogil=True)
def find_blocks(keys, head, table, state, rows):
    """
    Look up the row of every block.

    keys  (K,) int64; negative ones are nowhere
    rows  (K,) int64, out: row, -1 where the map has no such block
    """
    depth = state[DEPTH]
    for place in range(len(keys)):
        rows[place] = find_row(keys[place], head, table, depth) if keys[place] >= 0 else -1


@njit(cache=True, nogil=True)
def place_blocks(keys, head, table, state, limit, start, rows):
    """
    Look up the row of every block from start on, placing those that are missing.

    keys   (K,) int64
    limit  no block is placed beyond so many
    rows   (K,) int64, out: row, -1 where there was no place

    Returns how many are done; fewer than K where rows, segments or the directory are too small:
    make room and go on from there.
    """
    depth = state[DEPTH]
    for place in range(start, len(keys)):
        key = keys[place]
        row = find_row(key, head, table, depth)
        if row < 0 and state[VOXELS] < limit:
            hashed = hash_key(key)
            while is_full(hashed, table, depth):
                if not split_segment(hashed, table, state):
                    return place
            row = state[FREE_ROW]
            if row >= 0:
                state[FREE_ROW] = head[row, KEY]
            elif state[ROWS_USED] < len(head):
                row = state[ROWS_USED]
                state[ROWS_USED] = row + 1
            else:
                return place
            head[row, KEY] = key
            head[row, VERSION] = NEW
            head[row, STAMP] = 0
            insert_row(hashed, row, table, depth)
            state[VOXELS] += 1
        rows[place] = row
    return len(keys)


@njit(cache=True, nogil=True)
def remove_blocks(rows, head, table, state):
    """Take blocks out of the table and put their rows, (K,) int64, into the chain of free ones."""
    for place in range(len(rows)):
        row = np.int64(rows[place])
        remove_row(head[row, KEY], row, table, state[DEPTH])
        head[row, KEY] = state[FREE_ROW]
        head[row, VERSION] = FREE
        state[FREE_ROW] = row
        state[VOXELS] -= 1
