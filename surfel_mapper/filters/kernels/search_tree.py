# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The search tree of a scan: boxes of points, halved at the median along their longest edge.

A leaf holds LEAF consecutive points of the tree's order. A node is the tight box of a run of
leaves; children follow their parent in preorder, so that the subtree of a node with m leaves has
2 m - 1 nodes.

The tree as a tuple: xyz (3, L * LEAF) float64, points in the tree's order, padded with inf; order
(N,) int32, their rows; links (3, 2 L) int32, of each node FIRST its first leaf, RIGHT its right
child or -1, PARENT its parent or -1; boxes (2 L, 6) float64, lowest and highest corner; leaves
(L,) int32, the node of each leaf.

Source: Bentley 1975 (k-d trees).
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel, U
from surfel_mapper.kernels.lanes import NUMBERS

LEAF = NUMBERS
"""Points of a leaf, as many as place_of_least compares; 8 and 12 were slower."""

FIRST, RIGHT, PARENT = range(3)


@kernel(fastmath={'nnan'})
def build_nodes(points, order, links, boxes, xyz, num_leaves):
    """
    Build all nodes.

    points  (N, 3) float64, m, finite
    order   (N,) int32, in and out: rows of the points, permuted
    xyz     (3, L * LEAF) float64, out: the points of the leaves; before, xyz[0] holds the
            coordinates by which a node is halved
    """
    stack = np.empty((64, 3), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, 0, num_leaves
    top = 1
    values = xyz[0]
    while top > 0:
        top -= 1
        node, begin, end = stack[top, 0], stack[top, 1], stack[top, 2]
        first, last = begin * LEAF, min(end * LEAF, len(points))
        axis = bound_points(points, order, first, last, boxes, node)
        links[FIRST, node], links[RIGHT, node] = begin, -1
        if end - begin == 1:
            for i in range(U(first), U(last)):
                row = U(order[i])
                xyz[0, i], xyz[1, i], xyz[2, i] = points[row, 0], points[row, 1], points[row, 2]
            continue
        rank = (begin + end) >> 1
        for i in range(first, last):
            values[U(i)] = points[U(order[U(i)]), axis]
        split_at(values, order, first, last, rank * LEAF)
        lower, upper = node + 1, node + 2 * (rank - begin)
        links[RIGHT, node] = upper
        links[PARENT, lower] = links[PARENT, upper] = node
        stack[top, 0], stack[top, 1], stack[top, 2] = upper, rank, end
        stack[top + 1, 0], stack[top + 1, 1], stack[top + 1, 2] = lower, begin, rank
        top += 2


@inlined()
def bound_points(points, order, first, last, boxes, node):
    """Compute the box of the points from first to last - 1; return its longest axis."""
    low_x = low_y = low_z = math.inf
    high_x = high_y = high_z = -math.inf
    for i in range(U(first), U(last)):
        row = U(order[i])
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        low_x, high_x = min(low_x, x), max(high_x, x)
        low_y, high_y = min(low_y, y), max(high_y, y)
        low_z, high_z = min(low_z, z), max(high_z, z)
    boxes[node, 0], boxes[node, 1], boxes[node, 2] = low_x, low_y, low_z
    boxes[node, 3], boxes[node, 4], boxes[node, 5] = high_x, high_y, high_z
    dx, dy, dz = high_x - low_x, high_y - low_y, high_z - low_z
    y_or_z = 1 if dy >= dz else 2
    return 0 if dx >= max(dy, dz) else y_or_z


@inlined()
def move_below(values, rows, low, high, pivot):
    """
    Move the values below a pivot to the front of low to high - 1; return the end of them.

    Rows move with their values. A branch would be mispredicted half of the time.
    """
    end = low
    for i in range(low, high):
        value, row = values[i], rows[i]
        values[i], rows[i] = values[end], rows[end]
        values[end], rows[end] = value, row
        end += U(value < pivot)
    return end


@inlined()
def move_up_to(values, rows, low, high, pivot):
    """Move values as ``move_below`` does, those that are equal to the pivot too."""
    end = low
    for i in range(low, high):
        value, row = values[i], rows[i]
        values[i], rows[i] = values[end], rows[end]
        values[end], rows[end] = value, row
        end += U(value <= pivot)
    return end


@kernel(fastmath={'nnan'})
def split_at(values, order, low, high, rank):
    """Permute values and order from low to high - 1 so that no value before rank is larger."""
    low, high, rank = U(low), U(high), U(rank)
    while high - low > U(1):
        half, last = (low + high) >> U(1), high - U(1)
        a, b, c = values[low], values[half], values[last]
        pivot = max(min(a, b), min(max(a, b), c))
        at = last if pivot == c else (half if pivot == b else low)
        pivot_row = order[at]
        values[at], order[at] = c, order[last]
        less = move_below(values, order, low, last, pivot)
        values[last], order[last] = values[less], order[less]
        values[less], order[less] = pivot, pivot_row
        if less == rank or less + U(1) == rank:
            return
        if less > rank:
            high = less
        elif less > low:
            low = less + U(1)
        else:  # the pivot is the smallest, maybe one of many
            low = move_up_to(values, order, less, high, pivot)
            if low >= rank:
                return
