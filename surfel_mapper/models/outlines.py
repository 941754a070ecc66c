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

from surfel_mapper.models.kernels.rims import follow_sides, lay_sides, mark_corners
from surfel_mapper.models.multi_model import Plane

Array = npt.NDArray[np.float64]

PARTS = 4
"""A cell is cut into so many squares along either side for its outline."""

PARTS_OF_SURFACE = 2
"""And so many for its triangles: a spline bends little within half a cell."""

TOLERANCE = 0.75
"""An outline is this near to the rim of the mask, in squares."""


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
    ways = np.zeros(np.array(mask.shape) + 1, np.uint8)
    num = lay_sides(mask, ways)
    corners, ends = np.empty((num, 2)), np.empty(num, np.int64)
    num_rings = follow_sides(mask, ways, corners, ends)
    return np.split(corners, ends[: num_rings - 1]) if num else []


def middles(ring: Array) -> Array:
    """Return the middles of the sides of a ring: steps become slopes."""
    return 0.5 * (ring + next_corners(ring))


def next_corners(ring: Array) -> Array:
    """Return for each corner of a ring (M, D) the one after it; np.roll takes longer."""
    return np.concatenate([ring[1:], ring[:1]])


def simplified(ring: Array) -> Array:
    """Return the corners of a ring (M, 2) that matter, by Douglas and Peucker; at least three."""
    kept = np.zeros(len(ring), np.bool_)
    mark_corners(ring, TOLERANCE, kept)
    chosen = ring[kept]
    return chosen if len(chosen) >= 3 else ring
