# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What rings enclose, as triangles.

The plane is cut into slabs at the height of every corner; within a slab the sides of the rings do
not end, and what lies between the first and the second, the third and the fourth and so on is a
trapezoid. Trapezoids between the same two sides are joined again over the slabs. The sides that a
slab crosses are kept in their order from left to right, which changes little from one slab to the
next, so inserting soon sorts them again.
"""

from numba import njit
import numpy as np


@njit(cache=True, nogil=True)
def fill_rings(corners, ends):
    """
    Return the triangles that cover what rings enclose, (T, 3, 2) float64, against the clock.

    corners  (M, 2) float64, ring after ring
    ends     (R,) int64, behind the last corner of each
    """
    sides = leaning_sides(corners, ends)
    starts, stops = sides
    levels = np.unique(np.append(starts[:, 1], stops[:, 1]))
    lowest = np.searchsorted(levels, np.minimum(starts[:, 1], stops[:, 1]))
    highest = np.searchsorted(levels, np.maximum(starts[:, 1], stops[:, 1]))
    found = find_trapezoids(sides, levels, lowest, highest)
    triangles, num = np.empty((2 * len(found), 3, 2)), 0
    for upper in range(2):
        for row in np.argsort(found[:, 0] * len(starts) + found[:, 1], kind='mergesort'):
            left, right, low, high = found[row]
            put(sides, left, levels[low], triangles[num, 0])
            if upper:
                put(sides, right, levels[high], triangles[num, 1])
                put(sides, left, levels[high], triangles[num, 2])
            else:
                put(sides, right, levels[low], triangles[num, 1])
                put(sides, right, levels[high], triangles[num, 2])
            (ax, ay), (bx, by), (cx, cy) = triangles[num]
            num += (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) > 0.0
    return triangles[:num].copy()


@njit(cache=True, nogil=True)
def leaning_sides(corners, ends):
    """Return the starts and the ends, (E, 2) each, of the sides that are not level."""
    starts, stops = np.empty_like(corners), np.empty_like(corners)
    num = begin = 0
    for end in ends:
        for k in range(begin, end):
            after = k + 1 if k + 1 < end else begin
            if corners[k, 1] != corners[after, 1]:
                starts[num], stops[num] = corners[k], corners[after]
                num += 1
        begin = end
    return starts[:num], stops[:num]


@njit(cache=True, nogil=True)
def put(sides, side, height, corner):
    """Write where a side is at a height."""
    corner[0], corner[1] = place_of(sides, side, height), height


@njit(cache=True, nogil=True)
def place_of(sides, side, height):
    """Return x of a side at a height."""
    starts, stops = sides
    share = (height - starts[side, 1]) / (stops[side, 1] - starts[side, 1])
    return starts[side, 0] + share * (stops[side, 0] - starts[side, 0])


@njit(cache=True, nogil=True)
def find_trapezoids(sides, levels, lowest, highest):
    """
    Return the trapezoids between sides, (F, 4) int64: left, right, lowest and highest level.

    sides    starts (E, 2) and ends (E, 2), float64; none is level, and as many go up as down
             through any height
    levels   (L,) float64, all heights of corners, ascending
    lowest   (E,) int64, the level from which each goes
    highest  (E,) int64, and to which

    What lies between the same two sides in neighbouring slabs is one trapezoid.
    """
    order = np.argsort(lowest, kind='mergesort')
    found = np.empty(((highest - lowest).sum() // 2, 4), np.int64)
    active, x = np.empty(len(lowest), np.int64), np.empty(len(lowest))
    last = np.full(len(lowest), -1)  # the trapezoid begun last to the right of each side
    entered = num_active = num = 0
    for slab in range(len(levels) - 1):
        stays = 0
        for k in range(num_active):
            if highest[active[k]] > slab:
                active[stays] = active[k]
                stays += 1
        num_active = stays
        while entered < len(order) and lowest[order[entered]] == slab:
            active[num_active] = order[entered]
            num_active += 1
            entered += 1
        sort_by_place(sides, 0.5 * (levels[slab] + levels[slab + 1]), active[:num_active], x)
        for k in range(0, num_active, 2):
            left, right = active[k], active[k + 1]
            row = last[left]
            if row < 0 or found[row, 1] != right or found[row, 3] != slab:
                row = num
                found[row, 0], found[row, 1], found[row, 2] = left, right, slab
                last[left] = row
                num += 1
            found[row, 3] = slab + 1
    return found[:num]


@njit(cache=True, nogil=True)
def sort_by_place(sides, height, active, x):
    """Sort sides by where they are at a height, then by number; x (E,) float64 is overwritten."""
    for k in range(len(active)):
        side = active[k]
        x[side] = place_of(sides, side, height)
        at = k
        while at > 0 and (
            x[active[at - 1]] > x[side] or (x[active[at - 1]] == x[side] and active[at - 1] > side)
        ):
            active[at] = active[at - 1]
            at -= 1
        active[at] = side
