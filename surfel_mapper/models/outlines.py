# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Outlines and triangles of patches.

Both come from masks of the covered area, cells divided into smaller squares: the outline is the
boundary of one mask, smoothed and simplified; surfaces get two triangles for every square of the
other. Planes are triangulated from their outline; the sweep handles holes, separate parts and
rings that touch.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from surfel_mapper.geometry import face_normals
from surfel_mapper.models.grid import Grid
from surfel_mapper.models.kernels.outlines import (
    mark_sides,
    simplify_loop,
    trace_loops,
)
from surfel_mapper.models.multi_model import Plane

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

PARTS = 4
"""Squares along either side of a cell, for outlines."""

PARTS_OF_SURFACE = 2
"""Squares along either side of a cell, for triangles: a spline bends little within half a cell."""

TOLERANCE = 0.75
"""Tolerance of the simplification of outlines, in squares."""


def outline(patch: Plane) -> list[Array]:
    """
    Return the rings around the covered area of a patch, (M, 3) m each, not closed.

    Outer rings run counter-clockwise seen from the side of the normal, holes clockwise.
    """
    return [patch.lifted(ring) for ring in local_outline(patch)]


def local_outline(patch: Plane) -> list[Array]:
    """Return the outline as locations (M, 2) in the frame of the patch, m."""
    mask, side_m = covered_squares(patch.grid, PARTS)
    return [patch.grid.origin + side_m * simplified(midpoints(ring)) for ring in rings(mask)]


def triangles(patch: Plane) -> tuple[Array, npt.NDArray[np.int64]]:
    """Return vertices, (V, 3) m, and triangles, (T, 3), of a patch, facing along its normal."""
    mask, side_m = covered_squares(patch.grid, PARTS_OF_SURFACE)
    squares = np.argwhere(mask)
    steps = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    x, y = np.moveaxis(squares[:, None] + steps, 2, 0)
    lattice = np.zeros(np.array(mask.shape) + 1, np.bool_)
    lattice[x, y] = True
    number = np.cumsum(lattice).reshape(lattice.shape) - 1
    quads = number[x, y]
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return patch.lifted(patch.grid.origin + side_m * np.argwhere(lattice)), faces


def covered_squares(grid: Grid, divisions: int) -> tuple[npt.NDArray[np.bool_], float]:
    """
    Return which squares of divided cells are covered, and their edge, m.

    If no square is, they are halved: a small patch may be in the corners of its cells only. Cuts
    leave a 255th of a cell, so this ends.
    """
    mask = grid.mask(divisions)
    while not mask.any() and grid.filled.any():
        divisions *= 2
        mask = grid.mask(divisions)
    return mask, grid.pitch_m / divisions


def rings(mask: npt.NDArray[np.bool_]) -> list[Array]:
    """
    Return the corners (M, 2) of every boundary loop of a mask, with the covered side on the left.

    Squares that touch at a corner only are not connected there.
    """
    ways = np.zeros(np.array(mask.shape) + 1, np.uint8)
    num = mark_sides(mask, ways)
    corners, ends = np.empty((num, 2)), np.empty(num, np.int64)
    num_rings = trace_loops(mask, ways, corners, ends)
    return np.split(corners, ends[: num_rings - 1]) if num else []


def midpoints(ring: Array) -> Array:
    """Return the midpoints of the sides of a ring: steps become slopes."""
    return 0.5 * (ring + next_corners(ring))


def next_corners(ring: Array) -> Array:
    """Return for each corner of a ring (M, D) the next one; faster than np.roll."""
    return np.concatenate([ring[1:], ring[:1]])


def simplified(ring: Array) -> Array:
    """Return the corners of a ring (M, 2) that Douglas-Peucker keeps; at least three."""
    kept = np.zeros(len(ring), np.bool_)
    simplify_loop(ring, TOLERANCE, kept)
    chosen = ring[kept]
    return chosen if len(chosen) >= 3 else ring


def triangulated(rings: Sequence[Array]) -> Array:
    """
    Return counter-clockwise triangles (T, 3, 2) that cover the inside of rings.

    Parameters
    ----------
    rings : sequence of (M, 2) float64
        Their corners, not closed. Even-odd rule: points inside an odd number of rings are covered,
        whatever the direction of the rings.

    """
    starts, stops = sloped_sides(rings)
    heights = np.stack([starts[:, 1], stops[:, 1]])
    levels, index = np.unique(heights, return_inverse=True)
    lowest, highest = np.sort(index.reshape(2, -1), axis=0)
    first, second, low, high = trapezoids((starts, stops), levels, lowest, highest)

    def corner(side: Indices, level: Indices) -> Array:
        return np.stack([sides_x(starts, stops, side, levels[level]), levels[level]], axis=1)

    a, b = corner(first, low), corner(second, low)
    c, d = corner(second, high), corner(first, high)
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return triangles[areas(triangles) > 0.0]


def sloped_sides(rings: Sequence[Array]) -> tuple[Array, Array]:
    """Return the starts and the ends, (E, 2) each, of the sides of rings that are not level."""
    starts = np.concatenate([np.empty((0, 2)), *rings])
    stops = np.concatenate([np.empty((0, 2)), *map(next_corners, rings)])
    sloped = starts[:, 1] != stops[:, 1]
    return starts[sloped], stops[sloped]


def sides_x(starts: Array, stops: Array, side: Indices, height: Array) -> Array:
    """Return x (n,) of sides at heights."""
    first, last = starts[side], stops[side]
    share = (height - first[:, 1]) / (last[:, 1] - first[:, 1])
    x: Array = first[:, 0] + share * (last[:, 0] - first[:, 0])
    return x


def trapezoids(
    sides: tuple[Array, Array], levels: Array, lowest: Indices, highest: Indices
) -> tuple[Indices, Indices, Indices, Indices]:
    """
    Return the trapezoids between sides: left and right side, lowest and highest level, (F,) each.

    The plane is cut into slabs at the height of every corner. No side ends within a slab, so the
    areas between the first and second side, the third and fourth and so on are trapezoids. Those
    between the same two sides in neighbouring slabs are merged.

    Parameters
    ----------
    sides : (E, 2), (E, 2) float64
        Starts and ends; none is level, and as many go up as down through any height.
    levels : (L,) float64
        All heights of corners, ascending.
    lowest, highest : (E,) int64
        Levels at which each side starts and ends.

    """
    spans = highest - lowest
    side = np.repeat(np.arange(len(spans)), spans)
    slab = np.arange(len(side)) + np.repeat(highest - np.cumsum(spans), spans)
    x = sides_x(*sides, side, 0.5 * (levels[slab] + levels[slab + 1]))
    order = np.lexsort((side, x, slab))
    a, b, slab = side[order[::2]], side[order[1::2]], slab[order[::2]]
    order = np.lexsort((slab, b, a))
    a, b, slab = a[order], b[order], slab[order]
    is_new = np.ones(len(slab), np.bool_)
    is_new[1:] = (a[1:] != a[:-1]) | (b[1:] != b[:-1]) | (slab[1:] != slab[:-1] + 1)
    is_last = np.ones(len(slab), np.bool_)
    is_last[:-1] = is_new[1:]
    return a[is_new], b[is_new], slab[is_new], slab[is_last] + 1


def areas(triangles: Array) -> Array:
    """Return the areas, (T,), of triangles (T, 3, 2) or (T, 3, 3); 2D: signed."""
    if triangles.shape[2] == 2:
        a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        across: Array = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        return 0.5 * across
    length: Array = np.linalg.norm(face_normals(triangles), axis=1)
    return 0.5 * length


def bridged(rings: Sequence[Array]) -> Array:
    """
    Return one ring (M, D) of all rings, connected by bridges between near corners.

    A bridge is traversed both ways and encloses nothing, so the signed area is the sum of those of
    the rings, and the even-odd rule gives the same inside.
    """
    if not rings:
        return np.empty((0, 3))
    mixed = np.random.default_rng(0).permutation(len(rings))  # traced ones are sorted by place
    ordered = sorted((rings[k] for k in mixed), key=len, reverse=True)
    starts = np.cumsum([0, *map(len, ordered)])
    corners = np.concatenate(ordered)
    bridges = nearest_corners(corners, starts)
    following = np.arange(1, len(corners) + 1)
    following[starts[1:] - 1] = starts[:-1]
    preceding, ways = np.argsort(following).tolist(), following.tolist()
    for host, entry in bridges:  # to the entry, around its ring, and back by copies of both
        ways[preceding[entry]] = len(ways)
        ways += [len(ways) + 1, ways[host]]
        ways[host] = entry
    copies = [corner for host, entry in bridges for corner in (entry, host)]
    order = [0]
    while len(order) < len(ways):
        order.append(ways[order[-1]])
    whole: Array = np.concatenate([corners, corners[copies]])[order]
    return whole


def nearest_corners(corners: Array, starts: npt.NDArray[np.int64]) -> list[tuple[int, int]]:
    """
    Return a corner of an earlier ring for each but the first, and its own nearest corner to that.

    A search tree of the corners before finds those of a quarter more rings: 18,000 corners of
    3,400 rings take 40 ms, while comparing all corners takes 18 s.

    Parameters
    ----------
    corners : (M, D) float64
        Ring after ring.
    starts : (R + 1,) int64
        First corner of each, and M.

    """
    from scipy.spatial import cKDTree  # 0.4 s that mapping without models saves

    bridges: list[tuple[int, int]] = []
    num_joined, number = 1, len(starts) - 1
    while num_joined < number:
        some = starts[num_joined : num_joined + max(num_joined // 4, 1) + 1]
        apart, host = cKDTree(corners[: some[0]]).query(corners[some[0] : some[-1]])
        for first, end in pairwise((some - some[0]).tolist()):
            corner = first + int(apart[first:end].argmin())
            bridges.append((int(host[corner]), int(some[0]) + corner))
        num_joined += len(some) - 1
    return bridges
