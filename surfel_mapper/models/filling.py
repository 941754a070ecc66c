# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What rings enclose, as triangles for those who draw it, and as one ring for those who want one.

The plane is cut into slabs at the height of every corner; within a slab the sides of the rings do
not end, and what lies between the first and the second, the third and the fourth and so on is a
trapezoid. Trapezoids between the same two sides are joined again over the slabs. So holes, pieces
that do not hang together, and rings that touch need no care.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


def filled(rings: Sequence[Array]) -> Array:
    """
    Return triangles (T, 3, 2), against the clock, that cover what rings enclose.

    Parameters
    ----------
    rings : sequence of (M, 2) float64
        Their corners, not closed. What an odd number of them encloses is covered: outer rings
        and holes in them may run either way.

    """
    starts = np.concatenate([np.empty((0, 2)), *rings])
    ends = np.concatenate([np.empty((0, 2)), *(np.roll(ring, -1, axis=0) for ring in rings)])
    leaning = starts[:, 1] != ends[:, 1]
    starts, ends = starts[leaning], ends[leaning]
    levels, level = np.unique(np.concatenate([starts[:, 1], ends[:, 1]]), return_inverse=True)
    level = level.reshape(2, -1)
    left, right, low, high = trapezoids(starts, ends, levels, level.min(axis=0), level.max(axis=0))

    def corner(side: Indices, y: Array) -> Array:
        share = (y - starts[side, 1]) / (ends[side, 1] - starts[side, 1])
        x = starts[side, 0] + share * (ends[side, 0] - starts[side, 0])
        return np.stack([x, y], axis=1)

    a, b = corner(left, levels[low]), corner(right, levels[low])
    c, d = corner(right, levels[high]), corner(left, levels[high])
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    solid: Array = triangles[areas(triangles) > 0.0]
    return solid


def trapezoids(
    starts: Array, ends: Array, levels: Array, lowest: Indices, highest: Indices
) -> tuple[Indices, Indices, Indices, Indices]:
    """
    Return the sides left and right of every trapezoid, and the levels from which to which it is.

    Parameters
    ----------
    starts, ends : (E, 2) float64
        Of the sides, none of which is level.
    levels : (L,) float64
        All heights of corners, ascending.
    lowest, highest : (E,) int64
        The levels from which to which each side goes.

    """
    number = highest - lowest
    side = np.repeat(np.arange(len(starts)), number)
    slab = np.arange(len(side)) - np.repeat(np.cumsum(number) - number, number) + lowest[side]
    middle = 0.5 * (levels[slab] + levels[slab + 1]) if len(slab) else np.empty(0)
    share = (middle - starts[side, 1]) / (ends[side, 1] - starts[side, 1])
    x = starts[side, 0] + share * (ends[side, 0] - starts[side, 0])
    order = np.lexsort((x, slab))
    left, right, slab = side[order[::2]], side[order[1::2]], slab[order[::2]]
    order = np.lexsort((slab, right, left))
    left, right, slab = left[order], right[order], slab[order]
    goes_on = (np.diff(left) == 0) & (np.diff(right) == 0) & (np.diff(slab) == 1)
    first = np.flatnonzero(np.append(True, ~goes_on)[: len(slab)])
    last = np.append(first[1:], len(slab))[: len(first)] - 1
    return left[first], right[first], slab[first], slab[last] + 1


def areas(triangles: Array) -> Array:
    """Return the areas, (T,), of triangles (T, 3, 2) or (T, 3, 3); in 2D against the clock."""
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    if triangles.shape[2] == 2:
        across: Array = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        return 0.5 * across
    length: Array = np.linalg.norm(np.cross(a, b), axis=1)
    return 0.5 * length


def joined(rings: Sequence[Array]) -> Array:
    """
    Return one ring (M, D) of all rings, by ways there and back between their nearest corners.

    The ways enclose nothing, so the area is that of the rings, holes taken off where they run
    the other way; and a point is inside by the parity of crossings, as with the rings apart.
    """
    if not rings:
        return np.empty((0, 3))
    ordered = sorted(rings, key=len, reverse=True)
    whole = ordered[0]
    for ring in ordered[1:]:
        apart = ((whole[:, None] - ring[None]) ** 2).sum(axis=2)
        here, there = np.unravel_index(int(apart.argmin()), apart.shape)
        way = np.roll(ring, -int(there), axis=0)
        parts = [whole[: here + 1], way, way[:1], whole[here:]]
        whole = np.concatenate(parts)
    return whole
