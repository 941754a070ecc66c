# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What rings enclose, as triangles for those who draw it, and as one ring for those who want one.

Triangles are found by a line that sweeps over the sides (models/kernels/filling.py), so holes,
pieces that do not hang together, and rings that touch need no care.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from surfel_mapper.geometry import face_normals
from surfel_mapper.models.kernels.filling import fill_rings

Array = npt.NDArray[np.float64]


def filled(rings: Sequence[Array]) -> Array:
    """
    Return triangles (T, 3, 2), against the clock, that cover what rings enclose.

    Parameters
    ----------
    rings : sequence of (M, 2) float64
        Their corners, not closed. What an odd number of them encloses is covered: outer rings
        and holes in them may run either way.

    """
    corners = np.concatenate([np.empty((0, 2)), *rings])
    found: Array = fill_rings(corners, np.cumsum([len(ring) for ring in rings], dtype=np.int64))
    return found


def areas(triangles: Array) -> Array:
    """Return the areas, (T,), of triangles (T, 3, 2) or (T, 3, 3); in 2D against the clock."""
    if triangles.shape[2] == 2:
        a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        across: Array = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        return 0.5 * across
    length: Array = np.linalg.norm(face_normals(triangles), axis=1)
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
