# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Squared distances of voxels to the nearest occupied voxel, updated where occupancy has changed.

A voxel p that becomes occupied lowers the distances in the ball about it. One that becomes free
makes those voxels of the ball stale whose distance was that to p; each looks for its nearest
voxel from its old distance on, because the others cannot be nearer. If the neighbour of p in a
direction is occupied, all voxels on that side are nearer to the neighbour: in a wall the ball is
a column. The distances are exact, and integers: the result does not depend on the order of changes.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.hashing import DEPTH
from surfel_mapper.kernels.layout import KEY
from surfel_mapper.tsdf.kernels.queries import block_row

OLD = np.uint8(1)
"""Occupied after the last update."""
NEW = np.uint8(2)
"""Occupied now."""
STALE = np.uint8(4)
"""The distance was that to a voxel that is free now."""

FAR = np.uint16(65535)
"""Squared distance of voxels without an occupied voxel in reach."""

_UNREAD = -2


@njit(cache=True, nogil=True)
def mark_occupied(rows, field, least, occupied, marks, counts):
    """
    Set NEW where voxels are occupied, elsewhere unset it.

    rows      (K,) int64
    field     (R, 2, N) float32, distance and weight
    least     float32, positive, least weight of an observed voxel
    occupied  float32 m, largest distance of an occupied voxel
    marks     (R, N) uint8, in and out: only NEW changes
    counts    (K, 3) int64, out: voxels that became free, became occupied, are occupied
    """
    for b in range(len(rows)):
        mark, distance, weight = marks[rows[b]], field[rows[b], 0], field[rows[b], 1]
        lost, gained, total = 0, 0, 0
        for n in range(len(mark)):
            is_occupied = (weight[n] >= least) & (distance[n] <= occupied)
            was = mark[n] & OLD
            mark[n] = mark[n] & ~NEW | (NEW if is_occupied else np.uint8(0))
            lost += (was != 0) & (not is_occupied)
            gained += (was == 0) & is_occupied
            total += is_occupied
        counts[b, 0], counts[b, 1], counts[b, 2] = lost, gained, total


@njit(cache=True, nogil=True)
def settle(rows, marks):
    """Set OLD where NEW is set, elsewhere unset it; marks as in mark_occupied."""
    for b in range(len(rows)):
        mark = marks[rows[b]]
        for n in range(len(mark)):
            mark[n] = OLD | NEW if mark[n] & NEW else np.uint8(0)


@njit(cache=True, nogil=True)
def row_beside(cube, i, j, k, index, width, keys, find):
    """
    Return the row of a block of the cube about another, -1 if its distances are not kept.

    cube   (width^3,) int64, in and out: rows found so far, or _UNREAD
    i j k  place in the cube
    index  (3,) int64, of the block in the middle
    keys   (R,) int64, key of the block whose distances are in each row, or -1
    find   (head, table, state), see kernels/hashing.py
    """
    place = i + width * (j + width * k)
    if cube[place] == _UNREAD:
        head, table, state = find
        half = width // 2
        a, b, c = index[0] + i - half, index[1] + j - half, index[2] + k - half
        row = block_row(a, b, c, head, table, state[DEPTH])
        cube[place] = row if row >= 0 and keys[row] == head[row, KEY] else -1
    return cube[place]


@njit(cache=True, nogil=True)
def is_marked(cube, x, y, z, bit, index, width, bits, keys, find, marks):
    """Return whether a voxel, counted from the block in the middle of a cube, has a mark."""
    half, low = width // 2, (1 << bits) - 1
    i, j, k = (x >> bits) + half, (y >> bits) + half, (z >> bits) + half
    row = row_beside(cube, i, j, k, index, width, keys, find)
    place = (x & low) | (y & low) << bits | (z & low) << 2 * bits
    return row >= 0 and marks[row, place] & bit != 0


@njit(cache=True, nogil=True)
def spread(rows, index, source, most, lowers, targets, bits, keys, find, marks, squared, touched):
    """
    Lower the distances in the balls about voxels, or mark those that were distances to them.

    rows     (K,) int64, blocks of the sources
    index    (K, 3) int64, their block indices
    source   (mask, value, bit) uint8: voxels with marks & mask == value are sources; neighbours
             with the bit shield what is behind them
    most     int64, largest squared distance, voxels
    lowers   lower distances (True) or set STALE (False)
    targets  (R,) bool, blocks that may change
    bits     a block has 2^bits voxels a side
    keys     (R,) int64, see row_beside
    marks    (R, N) uint8, in; out if not lowers
    squared  (R, N) uint16, in; out if lowers
    touched  (R,) bool, out: set for blocks with new STALE voxels
    """
    mask, value, bit = source
    low, reach = (1 << bits) - 1, np.int64(np.sqrt(most))
    half = (reach + low) >> bits
    width = 2 * half + 1
    cube = np.empty(width * width * width, np.int64)
    for b in range(len(rows)):
        cube[:] = _UNREAD
        cube[half + width * (half + width * half)] = rows[b]
        for n in range(marks.shape[1]):
            if marks[rows[b], n] & mask != value:
                continue
            x, y, z = n & low, n >> bits & low, n >> 2 * bits
            near = (bit, index[b], width, bits, keys, find, marks)
            west = 0 if is_marked(cube, x - 1, y, z, *near) else -reach
            east = 0 if is_marked(cube, x + 1, y, z, *near) else reach
            south = 0 if is_marked(cube, x, y - 1, z, *near) else -reach
            north = 0 if is_marked(cube, x, y + 1, z, *near) else reach
            bottom = 0 if is_marked(cube, x, y, z - 1, *near) else -reach
            top = 0 if is_marked(cube, x, y, z + 1, *near) else reach
            for dz in range(bottom, top + 1):
                for dy in range(south, north + 1):
                    fixed = dy * dy + dz * dz
                    if fixed > most:
                        continue
                    span = np.int64(np.sqrt(most - fixed))
                    first, last = x + max(west, -span), x + min(east, span)
                    line = ((y + dy) & low) << bits | ((z + dz) & low) << 2 * bits
                    j, k = ((y + dy) >> bits) + half, ((z + dz) >> bits) + half
                    for i in range(first >> bits, (last >> bits) + 1):
                        row = row_beside(cube, i + half, j, k, index[b], width, keys, find)
                        if row < 0 or not targets[row]:
                            continue
                        begin = max(first - (i << bits), 0)
                        end = min(last - (i << bits), low) + 1
                        away = (i << bits) - x
                        if lowers:
                            lower(squared[row], line, begin, end, away, fixed)
                        elif mark_stale(squared[row], line, begin, end, away, fixed, marks[row]):
                            touched[row] = True


@njit(cache=True, nogil=True)
def lower(squared, line, begin, end, away, fixed):
    """Lower the squared distances of voxels begin to end of a line to fixed + (away + i)^2."""
    for i in range(begin, end):
        found = np.uint16(fixed + (away + i) * (away + i))
        squared[line + i] = min(squared[line + i], found)


@njit(cache=True, nogil=True)
def mark_stale(squared, line, begin, end, away, fixed, marks):
    """Mark the voxels of a line whose squared distance is as in lower; return whether any is."""
    found = False
    for i in range(begin, end):
        if squared[line + i] == fixed + (away + i) * (away + i):
            marks[line + i] |= STALE
            found = True
    return found


@njit(cache=True, nogil=True)
def repair(rows, index, ball, limit, bits, keys, find, marks, squared, unfinished):
    """
    Find the new distances of stale voxels, from the old ones on.

    rows        (K,) int64, blocks with stale voxels
    index       (K, 3) int64, their block indices
    ball        (offsets, lengths, first): (O, 3) int64 by ascending length; (O,) uint16, their
                squared lengths; (most + 1,) int64, the first of at least each squared length
    limit       offsets tried for a voxel
    marks       (R, N) uint8, in and out: STALE is unset
    squared     (R, N) uint16, in and out: FAR if no occupied voxel was found
    unfinished  (R,) bool, out: set for blocks with voxels that had more offsets to try
    """
    offsets, lengths, first = ball
    low = (1 << bits) - 1
    width = 2 * ((np.abs(offsets).max() + low) >> bits) + 1
    cube = np.empty(width * width * width, np.int64)
    for b in range(len(rows)):
        row = rows[b]
        cube[:] = _UNREAD
        for n in range(marks.shape[1]):
            if marks[row, n] & STALE == 0:
                continue
            marks[row, n] &= ~STALE
            x, y, z = n & low, n >> bits & low, n >> 2 * bits
            begin = first[squared[row, n]]
            end = min(begin + limit, len(offsets))
            squared[row, n] = FAR
            for o in range(begin, end):
                u, v, w = x + offsets[o, 0], y + offsets[o, 1], z + offsets[o, 2]
                if is_marked(cube, u, v, w, NEW, index[b], width, bits, keys, find, marks):
                    squared[row, n] = lengths[o]
                    break
            else:
                unfinished[row] |= end < len(offsets)
