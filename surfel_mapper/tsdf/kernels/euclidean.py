# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Squared distances of voxels to the nearest occupied voxel, made again where occupancy has changed.

A voxel p that becomes occupied changes the voxels of the ball about it that are nearer to p than
their distance; one that becomes free, those whose distance was that to p. If the neighbour of p in
a direction is occupied, all voxels on that side are nearer to the neighbour: in a wall the ball is
a column. ``touch`` finds the blocks with such voxels, and ``transform`` makes their distances from
the occupied voxels in reach, in one pass along each axis (Felzenszwalb and Huttenlocher 2012, with
a window instead of an envelope of parabolas: reaches are short, and plain loops compile to vector
instructions).

Distances are integers and exact: the result does not depend on the order of changes.

One module: both halves share the marks of voxels and the look-up of blocks.
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
FAR = np.uint16(65535)
"""Squared distance of voxels without an occupied voxel in reach."""
MAX_REACH = 127
"""Largest reach, voxels: BEYOND and two of its squares fit 16 bits."""
BEYOND = np.uint16(1 << 15)
"""Squared distance while it is computed, if farther along the axis than the reach."""

TILE = 2
"""Blocks a side that are computed together: their windows overlap."""

UNREAD = -2
"""Row of a block that was not looked up yet."""


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
def look_up(place, index, width, half, keys, find, cube):
    """
    Find the row of a block of the cube about another, -1 if its distances are not kept.

    place  number of the block in the cube, x fastest
    index  (3,) int64, of the block at half, half, half
    keys   (R,) int64, key of the block whose distances are in each row, or -1
    find   (head, table, state), see kernels/hashing.py
    cube   (width^3,) int64, in and out: rows found so far, or UNREAD
    """
    head, table, state = find
    a = index[0] + place % width - half
    b = index[1] + place // width % width - half
    c = index[2] + place // (width * width) - half
    row = block_row(a, b, c, head, table, state[DEPTH])
    cube[place] = row if row >= 0 and keys[row] == head[row, KEY] else -1


@njit(cache=True, nogil=True)
def is_marked(x, y, z, bit, index, width, bits, keys, find, marks, cube):
    """Return whether a voxel, counted from the block in the middle of a cube, has a mark."""
    half, low = width // 2, (1 << bits) - 1
    place = (x >> bits) + half + width * ((y >> bits) + half + width * ((z >> bits) + half))
    if cube[place] == UNREAD:
        look_up(place, index, width, width // 2, keys, find, cube)
    number = (x & low) | (y & low) << bits | (z & low) << 2 * bits
    return cube[place] >= 0 and marks[cube[place], number] & bit != 0


@njit(cache=True, nogil=True)
def touch(rows, index, flips, most, targets, bits, keys, find, marks, squared, touched):
    """
    Find the blocks whose distances change because of voxels that became occupied, or free.

    rows     (K,) int64, blocks of these voxels
    index    (K, 3) int64, their block indices
    flips    NEW: voxels that became occupied; OLD: voxels that became free
    most     int64, largest squared distance, voxels
    targets  (R,) bool, blocks to look at
    bits     a block has 2^bits voxels a side
    keys     (R,) int64, see look_up
    marks    (R, N) uint8
    squared  (R, N) uint16, distances before the changes
    touched  (R,) bool, in and out; blocks that are touched already are not looked at
    """
    low, reach = (1 << bits) - 1, np.int64(np.sqrt(most))
    half = (reach + low) >> bits
    width = 2 * half + 1
    cube = np.empty(width * width * width, np.int64)
    least, largest = np.empty(3, np.int64), np.empty(3, np.int64)
    middle, voxel = half * (1 + width * (1 + width)), np.empty(3, np.int64)
    for b in range(len(rows)):
        cube[:] = UNREAD
        cube[middle] = rows[b]
        for n in range(marks.shape[1]):
            if marks[rows[b], n] & (OLD | NEW) != flips:
                continue
            x, y, z = n & low, n >> bits & low, n >> 2 * bits
            near = (flips, index[b], width, bits, keys, find, marks, cube)
            voxel[0], voxel[1], voxel[2] = x, y, z
            least[0] = x if is_marked(x - 1, y, z, *near) else x - reach
            largest[0] = x if is_marked(x + 1, y, z, *near) else x + reach
            least[1] = y if is_marked(x, y - 1, z, *near) else y - reach
            largest[1] = y if is_marked(x, y + 1, z, *near) else y + reach
            least[2] = z if is_marked(x, y, z - 1, *near) else z - reach
            largest[2] = z if is_marked(x, y, z + 1, *near) else z + reach
            for k in range(least[2] >> bits, (largest[2] >> bits) + 1):
                for j in range(least[1] >> bits, (largest[1] >> bits) + 1):
                    for i in range(least[0] >> bits, (largest[0] >> bits) + 1):
                        place = middle + i + width * (j + width * k)
                        if cube[place] == UNREAD:
                            look_up(place, index[b], width, half, keys, find, cube)
                        row = cube[place]
                        if row >= 0 and targets[row] and not touched[row]:
                            bounds = (i << bits, j << bits, k << bits, low, most)
                            touched[row] = is_hit(
                                voxel, least, largest, bounds, bits, squared[row], flips == NEW
                            )


@njit(cache=True, nogil=True)
def is_hit(voxel, least, largest, bounds, bits, squared, lowers):
    """
    Return whether a voxel comes nearer to those of a block, or was the nearest to any of them.

    voxel           (3,) int64, counted from its own block
    least, largest  (3,) int64, of the box to look at, in the same way
    bounds          x, y, z of the block's first voxel, voxels a side less 1, and most
    squared         (N,) uint16, distances before
    lowers          whether it comes nearer
    """
    x, y, z, low, most = bounds
    for w in range(max(least[2], z), min(largest[2], z + low) + 1):
        for v in range(max(least[1], y), min(largest[1], y + low) + 1):
            fixed = (w - voxel[2]) ** 2 + (v - voxel[1]) ** 2
            if fixed > most:
                continue
            line = ((v - y) << bits | (w - z) << 2 * bits) - x
            for u in range(max(least[0], x), min(largest[0], x + low) + 1):
                length = fixed + (u - voxel[0]) ** 2
                before = squared[line + u]
                if length <= most and (length < before if lowers else length == before):
                    return True
    return False


@njit(cache=True, nogil=True)
def transform(tiles, most, bits, keys, find, marks, occupied, squared):
    """
    Compute the distances of all voxels in tiles of TILE^3 blocks.

    tiles     (K, 3) int64, index of the first block of each
    most, bits, keys, find  as in touch
    marks     (R, N) uint8, NEW for occupied voxels
    occupied  (R,) int64, number of occupied voxels of each block
    squared   (R, N) uint16, out; FAR if no voxel in reach is occupied
    """
    side, reach = TILE << bits, np.int64(np.sqrt(most))
    half = (reach + (1 << bits) - 1) >> bits
    width, span = 2 * half + TILE, side + 2 * reach
    cube = np.empty(width * width * width, np.int64)
    free = np.empty((span, span * span), np.uint8)
    run = np.empty(span * span, np.uint16)
    along_z = np.empty((side, span * span), np.uint16)
    along_y = np.empty(side * span, np.uint16)
    turned = np.empty(span * side * side, np.uint16)
    found = np.empty(side * side * side, np.uint16)
    for b in range(len(tiles)):
        follow(tiles, b, width, half, keys, find, cube)
        if fill(free.ravel(), cube, width, half, bits, reach, marks, occupied):
            transform_z(free, reach, side, run, along_z)
            for z in range(side):
                slide(along_z[z], span, reach, along_y)
                for y in range(side):
                    for x in range(span):
                        turned[(x * side + z) * side + y] = along_y[y * span + x]
            slide(turned, side * side, reach, found)
        else:
            found[:] = FAR
        write(found, most, cube, width, half, bits, squared)


@njit(cache=True, nogil=True)
def follow(tiles, number, width, half, keys, find, cube):
    """Look up the blocks about a tile; those that the tile before it has too are known."""
    before, tile = tiles[max(number - 1, 0)], tiles[number]
    step = tile[2] - before[2]
    is_near = number > 0 and before[0] == tile[0] and before[1] == tile[1]
    shift = width * width * min(step, width) if is_near else len(cube)
    for place in range(len(cube)):
        if place + shift < len(cube):
            cube[place] = cube[place + shift]
        else:
            look_up(place, tile, width, half, keys, find, cube)


@njit(cache=True, nogil=True)
def write(found, most, cube, width, half, bits, squared):
    """
    Write the distances of a tile into its blocks.

    found    (side^3,) uint16, squared distances, y fastest, then z, x
    cube     (width^3,) int64, rows of the blocks about the tile and in it
    squared  (R, N) uint16, out; FAR beyond most
    """
    low, side = (1 << bits) - 1, TILE << bits
    for i in range(TILE):
        for j in range(TILE):
            for k in range(TILE):
                row = cube[i + half + width * (j + half + width * (k + half))]
                if row < 0:
                    continue
                for n in range(squared.shape[1]):
                    x, y, z = (
                        (i << bits) + (n & low),
                        n >> bits & low,
                        (k << bits) + (n >> 2 * bits),
                    )
                    value = found[(x * side + z) * side + y + (j << bits)]
                    squared[row, n] = value if value <= most else FAR


@njit(cache=True, nogil=True)
def fill(free, cube, width, half, bits, reach, marks, occupied):
    """
    Copy the occupancy about a tile; return whether any voxel is occupied.

    free    (W^3,) uint8, x fastest, out: 0 if occupied, else 1; W = side of the tile + 2 reach
    cube    (width^3,) int64, rows of the blocks about the tile and in it
    others  as in transform
    """
    side, span = 1 << bits, (TILE << bits) + 2 * reach
    before, is_empty = half * side - reach, True
    for place in range(len(cube)):
        row = cube[place]
        if row < 0 or occupied[row] == 0:
            continue
        if is_empty:
            free[:] = 1
            is_empty = False
        left = place % width * side - before
        front = place // width % width * side - before
        bottom = place // (width * width) * side - before
        first, last = max(-left, 0), min(span - left, side)
        for z in range(max(-bottom, 0), min(span - bottom, side)):
            for y in range(max(-front, 0), min(span - front, side)):
                line = left + span * (y + front + span * (z + bottom))
                number = (y + (z << bits)) << bits
                for x in range(first, last):
                    if marks[row, number + x] & NEW:
                        free[line + x] = 0
    return not is_empty


@njit(cache=True, nogil=True)
def transform_z(free, reach, side, run, found):
    """
    Find the squared distances along z in the planes of a tile.

    free   (W, W^2) uint8, see fill
    run    (W^2,) uint16, scratch
    found  (side, W^2) uint16, out; BEYOND without an occupied voxel in reach
    """
    span = len(free)
    run[:] = MAX_REACH + 1
    for z in range(reach + side):
        advance(free[z], run)
        if z >= reach:
            found[z - reach] = run
    run[:] = MAX_REACH + 1
    for z in range(span - 1, reach - 1, -1):
        advance(free[z], run)
        if z < reach + side:
            keep_less(run, found[z - reach])
    flat = found.ravel()
    for n in range(len(flat)):
        flat[n] = flat[n] * flat[n] if flat[n] <= reach else BEYOND


@njit(cache=True, nogil=True)
def advance(free, run):
    """Count the voxels since the last occupied one, in all lanes."""
    for n in range(len(run)):
        run[n] = np.uint16((run[n] + 1) * free[n])


@njit(cache=True, nogil=True)
def keep_less(values, least):
    """Keep the lesser of two, in place."""
    for n in range(len(values)):
        least[n] = min(values[n], least[n])


@njit(cache=True, nogil=True)
def slide(values, stride, reach, found):
    """
    Find the least of values plus squared distances along one axis, in a window.

    values  (V,) uint16, squared distances across the axis
    stride  of the axis; the first found is that of place reach * stride
    found   (F,) uint16, out
    """
    number = len(found)
    found[:] = values[reach * stride : reach * stride + number]
    for step in range(1, reach + 1):
        before, after = (reach - step) * stride, (reach + step) * stride
        added = np.uint16(step * step)
        lower(values[before : before + number], values[after : after + number], added, found)


@njit(cache=True, nogil=True)
def lower(before, after, added, found):
    """Lower values (F,) uint16 to the lesser of two plus a number."""
    for n in range(len(found)):
        less = min(before[n], after[n])
        found[n] = min(np.uint16(less + added), found[n])
