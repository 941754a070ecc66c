# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The nearest neighbours of all points of a scan within it, in the tree of search_tree.py.

All points are asked for, leaf by leaf, which a search for single points cannot exploit. The
smallest node about a leaf that holds k points bounds the distances to the k-th neighbours, so the
leaves that can matter to any point of the leaf are gathered once, and each point compares its
bound with their boxes, with vector instructions. That bound follows from the one of the point
before by the triangle inequality; so the point nearest to it comes next, which saves a tenth of
the time. Distances below the bound are appended without a branch, and the k smallest are kept when
the buffer is full and at the end. 120,000 points of a lidar, k = 10: 0.05 s; scipy's tree takes
0.24 s.

Source: Friedman, Bentley and Finkel 1977 for the search by bounds.
"""

import math

import numpy as np

from surfel_mapper.filters.kernels.search_tree import FIRST, LEAF, PARENT, RIGHT
from surfel_mapper.filters.kernels.smallest import largest, select, sort
from surfel_mapper.kernels.compiling import inlined, kernel, U
from surfel_mapper.kernels.lanes import place_of_least

GATHERED = 256
"""Maximum number of leaves gathered for one leaf; if there are more, its points are searched for
one by one. A leaf with a stray point far away would else gather all leaves."""

WIDER = 1.0 + 1e-12
"""Factor on bounds, for rounding."""

TINY = 1e-300
"""Added to squared bounds, so that points at distance 0 are below them."""


@inlined()
def square(x, y, z):
    """Return the squared length of a vector."""
    return (x * x + y * y) + z * z


@inlined()
def widened(bound, moved, limit):
    """Return the square of sqrt(bound) + sqrt(moved), a little more for rounding."""
    reach = (math.sqrt(bound) + math.sqrt(moved)) * WIDER
    return min(reach * reach + TINY, limit)


@inlined()
def outside(low, high, value):
    """Return the distance of a value from an interval."""
    return max(max(low - value, value - high), 0.0)


@inlined()
def point_gap(boxes, node, x, y, z):
    """Return the squared distance of a point from the box of a node."""
    node = U(node)
    dx = outside(boxes[node, 0], boxes[node, 3], x)
    dy = outside(boxes[node, 1], boxes[node, 4], y)
    dz = outside(boxes[node, 2], boxes[node, 5], z)
    return square(dx, dy, dz)


@inlined()
def box_gap(boxes, first, second):
    """Return the squared distance between the boxes of two nodes."""
    total, first, second = 0.0, U(first), U(second)
    for axis in range(U(3)):
        low = max(boxes[first, axis], boxes[second, axis])
        high = min(boxes[first, U(3) + axis], boxes[second, U(3) + axis])
        apart = max(low - high, 0.0)
        total += apart * apart
    return total


@inlined()
def reach_of(links, boxes, leaf, k, num_points):
    """
    Return a squared distance within which each point of a leaf has k neighbours.

    It is the largest one between the boxes of the leaf and of its lowest ancestor of k points.
    """
    node, first = leaf, np.int64(links[FIRST, leaf]) * LEAF
    num_inside = min(first + LEAF, num_points) - first
    while num_inside < k and links[PARENT, node] >= 0:
        node = np.int64(links[PARENT, node])
        first = np.int64(links[FIRST, node]) * LEAF
        # the subtree of the left child, of half of the leaves, ends before the right one
        num_inside = min(first + (np.int64(links[RIGHT, node]) - node) * LEAF, num_points) - first
    total = TINY
    for axis in range(3):
        below = boxes[leaf, 3 + axis] - boxes[node, axis]
        above = boxes[node, 3 + axis] - boxes[leaf, axis]
        far = max(below, above)
        total += far * far
    return total * WIDER


@inlined()
def sibling_of(links, node):
    """Return the parent of a node and the other child of it."""
    parent = np.int64(links[PARENT, node])
    right = np.int64(links[RIGHT, parent])
    return parent, (right if right != node else parent + 1)


@inlined()
def scan(xs, ys, zs, base, x, y, z, bound, count, squares, indices, apart):
    """Append the points of a leaf closer than the bound; return the number of neighbours."""
    for i in range(U(LEAF)):
        apart[i] = square(xs[base + i] - x, ys[base + i] - y, zs[base + i] - z)
    for i in range(U(LEAF)):
        squares[count], indices[count] = apart[i], np.int32(base + i)
        count += U(apart[i] < bound)
        # the entry of a farther point is overwritten
    return count


@inlined()
def search(xs, ys, zs, links, boxes, node, x, y, z, k, bound, buffers, apart, stack):
    """
    Search from a leaf upwards; return the number of neighbours and the bound.

    buffers  squares (C,) float64, out: squared distances of the neighbours; C at least
             k + 2 LEAF;
             indices (C,) int32, out: their indices in the order of the tree
    """
    squares, indices = buffers
    full = U(len(squares) - LEAF)
    base = U(links[FIRST, node]) * U(LEAF)
    count = scan(xs, ys, zs, base, x, y, z, bound, U(0), squares, indices, apart)
    if count > k:
        bound = select(squares, indices, count, k)
        count = k
    while links[PARENT, node] >= 0:
        node, stack[0] = sibling_of(links, node)
        top = 1
        while top > 0:
            top -= 1
            branch = stack[top]
            if point_gap(boxes, branch, x, y, z) >= bound:
                continue
            upper = np.int64(links[RIGHT, branch])
            if upper < 0:
                base = U(links[FIRST, branch]) * U(LEAF)
                count = scan(xs, ys, zs, base, x, y, z, bound, count, squares, indices, apart)
                if count > full:
                    bound = select(squares, indices, count, k)
                    count = k
            else:
                lower = branch + 1
                left_first = point_gap(boxes, lower, x, y, z) < point_gap(boxes, upper, x, y, z)
                stack[top], stack[top + 1] = (upper, lower) if left_first else (lower, upper)
                top += 2
    return count, bound


@inlined()
def gather(links, boxes, leaf, reach, stack, near, bases):
    """
    Gather the leaves with boxes closer to the box of a leaf than a squared distance.

    near   (6, GATHERED) float64, out: their boxes
    bases  (GATHERED,) uint64, out: their first points

    Returns their number, or -1 if there are too many.
    """
    num, node, top = np.int64(0), leaf, 1
    stack[0] = leaf
    while top > 0:
        while top > 0 and num >= 0:
            top -= 1
            branch = stack[top]
            if box_gap(boxes, leaf, branch) >= reach:
                continue
            right = np.int64(links[RIGHT, branch])
            if right >= 0:
                stack[top], stack[top + 1] = right, branch + 1
                top += 2
            elif num == GATHERED:
                num = np.int64(-1)
            else:
                for side in range(6):
                    near[side, num] = boxes[branch, side]
                bases[num] = U(links[FIRST, branch]) * U(LEAF)
                num += 1
        top = 0
        if num >= 0 and links[PARENT, node] >= 0:
            node, stack[0] = sibling_of(links, node)
            top = 1
    return num


@kernel(error_model='numpy', fastmath={'nnan'})
def find_nearest(tree, block, within_sq, ordered, near, squared):
    """
    Find the nearest neighbours of the points of some leaves.

    tree       as search_tree.py describes it
    block      (2,) int64, the first leaf, and the one after the last
    within_sq  float64, m^2: only points closer than this
    ordered    bool, whether neighbours are sorted by distance, equal ones by row
    near       (P, k) int32, out: neighbours' indices in the order of the tree, N past the last
    squared    (P, k) float64, out: squared distances, m^2, inf past the last
    """
    xyz, order, links, boxes, leaves = tree
    xs, ys, zs = xyz[0], xyz[1], xyz[2]
    k = U(near.shape[1])
    size = max(U(2) * k, k + U(32)) + U(LEAF)
    full = size - U(LEAF)
    squares, indices, apart = np.empty(size), np.empty(size, np.int32), np.empty(LEAF)
    buffers = squares, indices
    stack, sides = np.empty(128, np.int64), np.empty((6, GATHERED))
    low_x, low_y, low_z = sides[0], sides[1], sides[2]
    high_x, high_y, high_z = sides[3], sides[4], sides[5]
    bases, close, gaps = np.empty(GATHERED, U), np.empty(GATHERED, U), np.empty(GATHERED)
    bound, last_x, last_y, last_z = within_sq, 0.0, 0.0, 0.0
    for leaf in range(block[0], block[1]):
        node = np.int64(leaves[leaf])
        start = U(leaf * LEAF)
        num = U(min(LEAF, len(order) - leaf * LEAF))
        reach = min(reach_of(links, boxes, node, np.int64(k), len(order)), within_sq)
        num_near = gather(links, boxes, node, reach, stack, sides, bases)
        at, visited = U(0), U(0)
        for _ in range(num):
            index, out = start + at, start + at - U(block[0] * LEAF)
            x, y, z = xs[index], ys[index], zs[index]
            bound = widened(bound, square(x - last_x, y - last_y, z - last_z), reach)
            last_x, last_y, last_z = x, y, z
            if num_near < 0:
                count, bound = search(
                    xs, ys, zs, links, boxes, node, x, y, z, k, bound, buffers, apart, stack
                )
                at += U(1)
            else:
                for i in range(U(num_near)):
                    dx = outside(low_x[i], high_x[i], x)
                    dy = outside(low_y[i], high_y[i], y)
                    dz = outside(low_z[i], high_z[i], z)
                    gaps[i] = square(dx, dy, dz)
                count = scan(xs, ys, zs, start, x, y, z, bound, U(0), squares, indices, apart)
                visited |= U(1) << at
                at = U(place_of_least(apart, visited))
                if count > k:
                    bound = select(squares, indices, count, k)
                    count = k
                num_close = U(0)
                for i in range(U(1), U(num_near)):
                    close[num_close], gaps[num_close] = bases[i], gaps[i]
                    num_close += U(gaps[i] < bound)
                for i in range(num_close):
                    if gaps[i] < bound:
                        count = scan(
                            xs, ys, zs, close[i], x, y, z, bound, count, squares, indices, apart
                        )
                        if count > full:
                            bound = select(squares, indices, count, k)
                            count = k
            if count > k:
                bound = select(squares, indices, count, k)
            else:
                bound = largest(squares, k) if count == k else within_sq
            count = min(count, k)
            if ordered:
                sort(squares, indices, order, count)
            for i in range(count):
                near[out, i], squared[out, i] = indices[i], squares[i]
            for i in range(count, k):
                near[out, i], squared[out, i] = len(order), math.inf
