# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Outlines and triangles of patches, for those who draw or measure them.

Both come from masks of what is covered, cells cut into smaller squares: the rim of one, with the
steps taken off, and two triangles for every square of the other.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.multi_model import Plane

Array = npt.NDArray[np.float64]

PARTS = 4
"""A cell is cut into so many squares along either side for its outline."""

PARTS_OF_SURFACE = 2
"""And so many for its triangles: a spline bends little within half a cell."""

TOLERANCE = 0.75
"""An outline is this near to the rim of the mask, in squares."""

Corner = tuple[int, int]


def outline(patch: Plane) -> list[Array]:
    """
    Return the rings around what a patch covers, (M, 3) m each, not closed.

    Outer ones run against the clock seen from the side that the normal points to, holes with it.
    """
    return [patch.lifted(ring) for ring in local_outline(patch)]


def local_outline(patch: Plane) -> list[Array]:
    """Return the same as places (M, 2) in the frame of the patch, m."""
    side_m = patch.grid.pitch_m / PARTS
    return [
        patch.grid.origin + side_m * simplified(middles(ring))
        for ring in rings(patch.grid.mask(PARTS))
    ]


def triangles(patch: Plane) -> tuple[Array, npt.NDArray[np.int64]]:
    """Return vertices, (V, 3) m, and triangles, (T, 3), of a patch, facing along its normal."""
    side_m = patch.grid.pitch_m / PARTS_OF_SURFACE
    mask = patch.grid.mask(PARTS_OF_SURFACE)
    squares = np.argwhere(mask)
    steps = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    x, y = np.moveaxis(squares[:, None] + steps, 2, 0)
    lattice = np.zeros(np.array(mask.shape) + 1, np.bool_)
    lattice[x, y] = True
    number = np.cumsum(lattice).reshape(lattice.shape) - 1
    quads = number[x, y]
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return patch.lifted(patch.grid.origin + side_m * np.argwhere(lattice)), faces


def rings(mask: npt.NDArray[np.bool_]) -> list[Array]:
    """
    Return the corners (M, 2) along every rim of a mask, what is covered on the left.

    Squares that touch at a corner only do not hang together there.
    """
    padded = np.pad(mask, 1)
    inner = padded[1:-1, 1:-1]
    after: dict[Corner, list[Corner]] = {}
    # a square's side towards an empty neighbour, from its first corner to its last
    for empty, first, last in (
        (~padded[1:-1, :-2], (0, 0), (1, 0)),
        (~padded[2:, 1:-1], (1, 0), (1, 1)),
        (~padded[1:-1, 2:], (1, 1), (0, 1)),
        (~padded[:-2, 1:-1], (0, 1), (0, 0)),
    ):
        for x, y in np.argwhere(inner & empty).tolist():
            start = (x + first[0], y + first[1])
            after.setdefault(start, []).append((x + last[0], y + last[1]))
    found = []
    while after:
        found.append(np.array(followed(after, next(iter(after))), np.float64))
    return found


def followed(after: dict[Corner, list[Corner]], start: Corner) -> list[Corner]:
    """Return one ring from a corner on, taking its sides out of what is left."""
    ring, at, before = [start], start, start
    while True:
        ways = after[at]
        ahead = (at[0] - before[0], at[1] - before[1])
        left = (at[0] - ahead[1], at[1] + ahead[0])
        step = left if len(ways) > 1 and left in ways else ways[0]
        ways.remove(step)
        if not ways:
            del after[at]
        if step == start:
            return ring
        ring.append(step)
        at, before = step, at


def middles(ring: Array) -> Array:
    """Return the middles of the sides of a ring: steps become slopes."""
    return 0.5 * (ring + np.roll(ring, -1, axis=0))


def simplified(ring: Array) -> Array:
    """Return the corners of a ring (M, 2) that matter, by Douglas and Peucker; at least three."""
    far = int(np.argmax(((ring - ring[0]) ** 2).sum(axis=1)))
    closed = np.concatenate([ring, ring[:1]])
    kept = np.zeros(len(closed), bool)
    kept[[0, far]] = True
    waiting = [(0, far), (far, len(ring))]
    while waiting:
        first, last = waiting.pop()
        if last - first < 2:
            continue
        a, b = closed[first], closed[last]
        along, inner = b - a, closed[first + 1 : last] - a
        length = float(np.hypot(*along))
        across = np.abs(along[0] * inner[:, 1] - along[1] * inner[:, 0])
        away = across / length if length > 0.0 else np.hypot(*inner.T)
        worst = int(np.argmax(away))
        if away[worst] > TOLERANCE:
            middle = first + 1 + worst
            kept[middle] = True
            waiting += [(first, middle), (middle, last)]
    chosen = ring[kept[:-1]]
    return chosen if len(chosen) >= 3 else ring
