# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Squared distances of voxels to the nearest occupied voxel, made again where occupancy has changed.

A voxel p that becomes occupied lowers the distances of the voxels about it that are nearer to p
than to any other; one that becomes free raises those whose distance was that to p. If there is an
occupied voxel k voxels from p along an axis, voxels more than k / 2 on that side are nearer to it:
in a wall the ball about p is a column. ``lower`` writes the new distances. ``mark_raised`` marks
the voxels whose nearest one has gone, and ``search`` finds their next: from the former distance
on, through the places about them in the order of their distance.

Blocks that are new, or have many marked voxels, are computed as a whole by ``transform`` from the
occupied voxels in reach, in one pass along each axis (Felzenszwalb and Huttenlocher 2012, with
a window instead of an envelope of parabolas: reaches are short, and plain loops compile to vector
instructions).

Distances are integers and exact: the result does not depend on the order of changes.
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

RAISED = np.uint8(4)
"""The nearest occupied voxel has gone."""

NEIGHBOURS = 4
"""Voxels along an axis that are looked at for a nearer occupied one, on either side."""

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
def place_in(x, y, z, bits, width):
    """Return the place in a cube of the block of a voxel, counted from the block in the middle."""
    half = width // 2
    return (x >> bits) + half + width * ((y >> bits) + half + width * ((z >> bits) + half))


@njit(cache=True, nogil=True)
def number_in(x, y, z, bits):
    """Return the number of a voxel in its block."""
    low = (1 << bits) - 1
    return (x & low) | (y & low) << bits | (z & low) << 2 * bits


@njit(cache=True, nogil=True)
def bound(voxel, bit, reach, index, width, bits, keys, find, marks, cube, least, largest):
    """
    Find the box of the voxels that may be nearer to a voxel than to another one on its axes.

    voxel           (3,) int64, counted from the block in the middle of a cube
    bit             mark of the others
    index, keys, find, cube  as in look_up
    bits, marks     as in spread
    least, largest  (3,) int64, out, counted as voxel
    """
    for axis in range(3):
        for sign in (-1, 1):
            nearest = reach
            for k in range(1, min(NEIGHBOURS, reach) + 1):
                x = voxel[0] + sign * k * (axis == 0)
                y = voxel[1] + sign * k * (axis == 1)
                z = voxel[2] + sign * k * (axis == 2)
                place = place_in(x, y, z, bits, width)
                if cube[place] == UNREAD:  # here, not in a function: calls cost 30 times the rest
                    look_up(place, index, width, width // 2, keys, find, cube)
                if cube[place] >= 0 and marks[cube[place], number_in(x, y, z, bits)] & bit:
                    nearest = k // 2
                    break
            if sign < 0:
                least[axis] = voxel[axis] - nearest
            else:
                largest[axis] = voxel[axis] + nearest


@njit(cache=True, nogil=True)
def spread(rows, index, flips, most, targets, bits, keys, find, marks, squared, num_raised):
    """
    Lower the distances about voxels that became occupied, or mark those that voxels have left.

    rows        (K,) int64, blocks of these voxels
    index       (K, 3) int64, their block indices
    flips       NEW: voxels that became occupied; OLD: voxels that became free
    most        int64, largest squared distance, voxels
    targets     (R,) bool, blocks to look at
    bits        a block has 2^bits voxels a side
    keys        (R,) int64, see look_up
    marks       (R, N) uint8, in and out: RAISED is set
    squared     (R, N) uint16, in and out: lowered
    num_raised  (R,) int64, in and out: marked voxels of each block
    """
    low, reach = (1 << bits) - 1, np.int64(np.sqrt(most))
    half = (reach + low) >> bits
    width = 2 * half + 1
    cube = np.empty(width * width * width, np.int64)
    least, largest = np.empty(3, np.int64), np.empty(3, np.int64)
    middle, voxel = half * (1 + width * (1 + width)), np.empty(3, np.int64)
    plane = np.empty(1 << 2 * bits, np.uint16)
    for b in range(len(rows)):
        cube[:] = UNREAD
        cube[middle] = rows[b]
        for n in range(marks.shape[1]):
            if marks[rows[b], n] & (OLD | NEW) != flips:
                continue
            voxel[0], voxel[1], voxel[2] = n & low, n >> bits & low, n >> 2 * bits
            near = (index[b], width, bits, keys, find, marks, cube)
            bound(voxel, flips, reach, *near, least, largest)
            for j in range(least[1] >> bits, (largest[1] >> bits) + 1):
                for i in range(least[0] >> bits, (largest[0] >> bits) + 1):
                    square(voxel[0] - (i << bits), voxel[1] - (j << bits), bits, plane)
                    for k in range(least[2] >> bits, (largest[2] >> bits) + 1):
                        place = middle + i + width * (j + width * k)
                        if cube[place] == UNREAD:
                            look_up(place, index[b], width, half, keys, find, cube)
                        row = cube[place]
                        if row < 0 or not targets[row]:
                            continue
                        above = (k << bits) - voxel[2]
                        first = max(-reach - above, 0)
                        last = min(reach - above, low) + 1
                        if flips == NEW:
                            lower(plane, above, first, last, most, squared[row])
                        else:
                            num_raised[row] += mark_raised(
                                plane, above, first, last, squared[row], marks[row]
                            )


@njit(cache=True, nogil=True)
def square(x, y, bits, plane):
    """
    Find the squared distances across z of a layer of a block.

    x, y   int64, of the place in question, from the first voxel of the block
    plane  (side^2,) uint16, out; at most BEYOND
    """
    for n in range(len(plane)):
        length = ((n & ((1 << bits) - 1)) - x) ** 2 + ((n >> bits) - y) ** 2
        plane[n] = min(length, BEYOND)


@njit(cache=True, nogil=True)
def lower(plane, above, first, last, most, squared):
    """
    Lower the distances of the voxels of a block to those from a voxel.

    plane        (side^2,) uint16, from square
    above        z of the first layer, from the voxel
    first, last  layers to look at, the last not included
    most         as in spread
    squared      (N,) uint16, in and out
    """
    limit = np.uint16(most)
    for z in range(first, last):
        added = np.uint16((above + z) ** 2)
        layer = squared[z * len(plane) : (z + 1) * len(plane)]
        for n in range(len(plane)):
            length = np.uint16(plane[n] + added)
            layer[n] = min(layer[n], length if length <= limit else FAR)


@njit(cache=True, nogil=True)
def mark_raised(plane, above, first, last, squared, marks):
    """
    Mark the voxels of a block whose distance is that to a voxel; return the number of new marks.

    marks   (N,) uint8, in and out
    others  as in lower
    """
    found = 0
    for z in range(first, last):
        added, start, equal = np.uint16((above + z) ** 2), z * len(plane), False
        layer = squared[start : start + len(plane)]
        for n in range(len(plane)):
            equal |= layer[n] == np.uint16(plane[n] + added)
        if equal:
            for n in range(len(plane)):
                if layer[n] == np.uint16(plane[n] + added):
                    found += marks[start + n] & RAISED == 0
                    marks[start + n] |= RAISED
    return found


@njit(cache=True, nogil=True)
def search(rows, index, places, lengths, firsts, bits, keys, find, marks, squared):
    """
    Find the distances of marked voxels, none of which is less than before.

    rows     (K,) int64, blocks with marked voxels
    index    (K, 3) int64, their block indices
    places   (P, 3) int16, offsets of the voxels about a voxel
    lengths  (P,) uint16, their squared distances, ascending
    firsts   (most + 1,) int64, the first place of at least each squared distance
    bits, keys, find  as in spread
    marks    (R, N) uint8, in and out: RAISED is unset
    squared  (R, N) uint16, in and out
    """
    low, reach = (1 << bits) - 1, np.int64(np.sqrt(len(firsts) - 1))
    half = (reach + low) >> bits
    width = 2 * half + 1
    cube = np.empty(width * width * width, np.int64)
    for b in range(len(rows)):
        mark, distance = marks[rows[b]], squared[rows[b]]
        cube[:] = UNREAD
        for n in range(len(mark)):
            if mark[n] & RAISED:
                x, y, z = n & low, n >> bits & low, n >> 2 * bits
                mark[n] &= ~RAISED
                first, distance[n] = firsts[distance[n]], FAR
                for p in range(first, len(places)):
                    u, v, w = x + places[p, 0], y + places[p, 1], z + places[p, 2]
                    place = place_in(u, v, w, bits, width)
                    if cube[place] == UNREAD:
                        look_up(place, index[b], width, half, keys, find, cube)
                    if cube[place] >= 0 and marks[cube[place], number_in(u, v, w, bits)] & NEW:
                        distance[n] = lengths[p]
                        break


@njit(cache=True, nogil=True)
def transform(tiles, size, most, bits, keys, find, marks, occupied, squared):
    """
    Compute the distances of all voxels in tiles of size^3 blocks.

    tiles     (K, 3) int64, index of the first block of each
    size      1 or more: the windows of blocks that are computed together overlap
    most, bits, keys, find  as in spread
    marks     (R, N) uint8, NEW for occupied voxels
    occupied  (R,) int64, number of occupied voxels of each block
    squared   (R, N) uint16, out; FAR if no voxel in reach is occupied
    """
    side, reach = size << bits, np.int64(np.sqrt(most))
    half = (reach + (1 << bits) - 1) >> bits
    width, span = 2 * half + size, side + 2 * reach
    cube = np.empty(width * width * width, np.int64)
    free = np.empty((span, span * span), np.uint8)
    run = np.empty(span * span, np.uint16)
    along_z = np.empty((side, span * span), np.uint16)
    along_y = np.empty(side * span, np.uint16)
    turned = np.empty(span * side * side, np.uint16)
    found = np.empty(side * side * side, np.uint16)
    for b in range(len(tiles)):
        follow(tiles, b, width, half, keys, find, cube)
        if fill(free.ravel(), cube, width, half, bits, reach, span, marks, occupied):
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
    """Look up the blocks about a tile; those about the tile before it are known if it is below."""
    before, tile = tiles[max(number - 1, 0)], tiles[number]
    step = tile[2] - before[2]
    is_above = step > 0 and before[0] == tile[0] and before[1] == tile[1]
    shift = width * width * min(step, width) if is_above else len(cube)
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
    size, low = width - 2 * half, (1 << bits) - 1
    side = size << bits
    for i in range(size):
        for j in range(size):
            for k in range(size):
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
def fill(free, cube, width, half, bits, reach, span, marks, occupied):
    """
    Copy the occupancy about a tile; return whether any voxel is occupied.

    free    (W^3,) uint8, x fastest, out: 0 if occupied, else 1
    span    W, side of the tile + 2 reach
    cube    (width^3,) int64, rows of the blocks about the tile and in it
    others  as in transform
    """
    side = 1 << bits
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
                    free[line + x] = (marks[row, number + x] & NEW) == 0
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
        lower_line(values[before : before + number], values[after : after + number], added, found)


@njit(cache=True, nogil=True)
def lower_line(before, after, added, found):
    """Lower values (F,) uint16 to the lesser of two plus a number."""
    for n in range(len(found)):
        less = min(before[n], after[n])
        found[n] = min(np.uint16(less + added), found[n])
