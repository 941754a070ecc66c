# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Boundary loops of masks, and their simplification.

Corner (x, y) is the lowest of square (x, y). The boundary sides of covered squares run with
the covered side on their left. At most two leave a corner, each in its own direction, so one byte
a corner stores them: bit 0 for x, 1 for y, 2 for -x, 3 for -y.

Source: Douglas and Peucker 1973 for the simplification.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel


@kernel(error_model='numpy')
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


@kernel(error_model='numpy')
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


@inlined(error_model='numpy')
def trace_loop(ways, start_x, start_y, corners, num):
    """
    Append one loop after the first num corners; return the new number of corners.

    If two sides leave a corner, the left one is taken: squares that touch at a corner only are not
    connected there.
    """
    x, y = start_x, start_y
    left_turn = 4  # there is none at the start
    while True:
        corners[num, 0], corners[num, 1] = x, y
        num += 1
        direction = 0
        while not ways[x, y] >> direction & 1:
            direction += 1
        if left_turn < 4 and ways[x, y] >> left_turn & 1:
            direction = left_turn
        ways[x, y] ^= 1 << direction
        x += (direction == 0) - (direction == 2)
        y += (direction == 1) - (direction == 3)
        left_turn = (direction + 1) % 4
        if x == start_x and y == start_y:
            return num


@kernel(error_model='numpy')
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


@inlined(error_model='numpy')
def farthest_corner(ring):
    """Return the index of the corner that is farthest from the first."""
    far, most = 0, -1.0
    for k in range(len(ring)):
        x, y = ring[k, 0] - ring[0, 0], ring[k, 1] - ring[0, 1]
        if x * x + y * y > most:
            far, most = k, x * x + y * y
    return far
