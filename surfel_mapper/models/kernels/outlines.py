# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Boundary loops of masks, their simplification, and triangulation of polygons with holes.

Loops. Corner (x, y) is the lowest of square (x, y). The boundary sides of covered squares run with
the covered side on their left. At most two leave a corner, each in its own direction, so one byte
a corner stores them: bit 0 for x, 1 for y, 2 for -x, 3 for -y.

Triangulation. The plane is cut into slabs at the height of every corner. No edge ends within a
slab, so the areas between the first and second edge, the third and fourth and so on are
trapezoids; those between the same two edges are merged across slabs. The edges that cross a slab
stay sorted from left to right; this order changes little from slab to slab, so insertion sort is
fast.

Source: Douglas and Peucker 1973 for the simplification.
"""

import math

from numba import njit
import numpy as np


@njit(cache=True, nogil=True)
def mark_sides(mask, ways):
    """
    Mark the boundary sides of the covered squares of a mask; return how many there are.

    mask  (X, Y) bool
    ways  (X + 1, Y + 1) uint8, zeros; out: directions in which sides leave each corner
    """
    end_x, end_y = mask.shape
    num = 0
    for x in range(end_x):
        for y in range(end_y):
            if not mask[x, y]:
                continue
            if y == 0 or not mask[x, y - 1]:
                ways[x, y] |= 1
                num += 1
            if x + 1 == end_x or not mask[x + 1, y]:
                ways[x + 1, y] |= 2
                num += 1
            if y + 1 == end_y or not mask[x, y + 1]:
                ways[x + 1, y + 1] |= 4
                num += 1
            if x == 0 or not mask[x - 1, y]:
                ways[x, y + 1] |= 8
                num += 1
    return num


@njit(cache=True, nogil=True)
def trace_loops(mask, ways, corners, ends):
    """
    Trace boundary loops until all sides are used; return how many loops there are.

    mask     (X, Y) bool
    ways     (X + 1, Y + 1) uint8, of mark_sides; is consumed
    corners  (S, 2) float64, out: loop after loop
    ends     (S,) int64, out: one past the last corner of each

    Every loop has a side along x, so the search starts at those.
    """
    end_x, end_y = mask.shape
    num = num_rings = 0
    for x in range(end_x):
        for y in range(end_y):
            if not mask[x, y] or (y > 0 and mask[x, y - 1]):
                continue
            while ways[x, y] != 0:
                num = trace_loop(ways, x, y, corners, num)
                ends[num_rings] = num
                num_rings += 1
    return num_rings


@njit(cache=True, nogil=True)
def trace_loop(ways, start_x, start_y, corners, num):
    """
    Append one loop after the first num corners; return the new number of corners.

    If two sides leave a corner, the left one is taken: squares that touch at a corner only are not
    connected there.
    """
    x, y = start_x, start_y
    left = 4  # there is none at the start
    while True:
        corners[num, 0], corners[num, 1] = x, y
        num += 1
        direction = 0
        while not ways[x, y] >> direction & 1:
            direction += 1
        if left < 4 and ways[x, y] >> left & 1:
            direction = left
        ways[x, y] ^= 1 << direction
        x += (1, 0, -1, 0)[direction]
        y += (0, 1, 0, -1)[direction]
        left = (direction + 1) % 4
        if x == start_x and y == start_y:
            return num


@njit(cache=True, nogil=True, error_model='numpy')
def simplify_loop(ring, tolerance, kept):
    """
    Mark the corners that Douglas-Peucker keeps; the others lie within a tolerance of the result.

    ring  (M, 2) float64, its corners, not closed; at least one
    kept  (M,) bool, zeros; out

    The first corner and the one farthest from it are kept; then, recursively, the farthest corner
    from the line between two kept ones.
    """
    size = len(ring)
    kept[0] = True
    waiting = np.empty((size + 2, 2), np.int64)
    far = farthest_corner(ring)
    kept[far] = True
    waiting[0, 0], waiting[0, 1] = 0, far
    waiting[1, 0], waiting[1, 1] = far, size
    num = 2
    while num > 0:
        num -= 1
        first, last = waiting[num, 0], waiting[num, 1]
        ax, ay = ring[first, 0], ring[first, 1]
        along_x, along_y = ring[last % size, 0] - ax, ring[last % size, 1] - ay
        length = math.hypot(along_x, along_y)
        worst, most = 0, -1.0
        for k in range(first + 1, last):
            x, y = ring[k, 0] - ax, ring[k, 1] - ay
            away = math.hypot(x, y)
            if length > 0.0:
                away = abs(along_x * y - along_y * x) / length
            if away > most:
                worst, most = k, away
        if most > tolerance:
            kept[worst] = True
            waiting[num, 0], waiting[num, 1] = first, worst
            waiting[num + 1, 0], waiting[num + 1, 1] = worst, last
            num += 2


@njit(cache=True, nogil=True)
def farthest_corner(ring):
    """Return the index of the corner that is farthest from the first."""
    far, most = 0, -1.0
    for k in range(len(ring)):
        x, y = ring[k, 0] - ring[0, 0], ring[k, 1] - ring[0, 1]
        if x * x + y * y > most:
            far, most = k, x * x + y * y
    return far


@njit(cache=True, nogil=True)
def triangulate_rings(corners, ends):
    """
    Return counter-clockwise triangles that cover the inside of rings, (T, 3, 2) float64.

    corners  (M, 2) float64, ring after ring
    ends     (R,) int64, one past the last corner of each
    """
    sides = sloped_edges(corners, ends)
    starts, stops = sides
    levels = np.unique(np.append(starts[:, 1], stops[:, 1]))
    lowest = np.searchsorted(levels, np.minimum(starts[:, 1], stops[:, 1]))
    highest = np.searchsorted(levels, np.maximum(starts[:, 1], stops[:, 1]))
    found = find_trapezoids(sides, levels, lowest, highest)
    triangles, num = np.empty((2 * len(found), 3, 2)), 0
    for upper in range(2):
        for row in np.argsort(found[:, 0] * len(starts) + found[:, 1], kind='mergesort'):
            left, right, low, high = found[row]
            write_corner(sides, left, levels[low], triangles[num, 0])
            if upper:
                write_corner(sides, right, levels[high], triangles[num, 1])
                write_corner(sides, left, levels[high], triangles[num, 2])
            else:
                write_corner(sides, right, levels[low], triangles[num, 1])
                write_corner(sides, right, levels[high], triangles[num, 2])
            (ax, ay), (bx, by), (cx, cy) = triangles[num]
            num += (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) > 0.0
    return triangles[:num].copy()


@njit(cache=True, nogil=True)
def sloped_edges(corners, ends):
    """Return the starts and the ends, (E, 2) each, of the edges that are not level."""
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
def write_corner(sides, side, height, corner):
    """Write the point of an edge at a height."""
    corner[0], corner[1] = edge_x(sides, side, height), height


@njit(cache=True, nogil=True)
def edge_x(sides, side, height):
    """Return x of an edge at a height."""
    starts, stops = sides
    share = (height - starts[side, 1]) / (stops[side, 1] - starts[side, 1])
    return starts[side, 0] + share * (stops[side, 0] - starts[side, 0])


@njit(cache=True, nogil=True)
def find_trapezoids(sides, levels, lowest, highest):
    """
    Return the trapezoids between edges, (F, 4) int64: left, right, lowest and highest level.

    sides    starts (E, 2) and ends (E, 2), float64; none is level, and as many go up as down
             through any height
    levels   (L,) float64, all heights of corners, ascending
    lowest   (E,) int64, the level at which each starts
    highest  (E,) int64, the level at which each ends

    Trapezoids between the same two edges in neighbouring slabs are merged.
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
        sort_edges(sides, 0.5 * (levels[slab] + levels[slab + 1]), active[:num_active], x)
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
def sort_edges(sides, height, active, x):
    """Sort edges by x at a height, then by index; x (E,) float64 is overwritten."""
    for k in range(len(active)):
        side = active[k]
        x[side] = edge_x(sides, side, height)
        at = k
        while at > 0 and (
            x[active[at - 1]] > x[side] or (x[active[at - 1]] == x[side] and active[at - 1] > side)
        ):
            active[at] = active[at - 1]
            at -= 1
        active[at] = side
