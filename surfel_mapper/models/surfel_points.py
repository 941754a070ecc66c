# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Points that stand for surfels: three by three across each disc, so that its slope is kept.

A full square of width w has sigma w / sqrt(12), so its half width is sqrt(3) sigma.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.surfels import Surfels

Array = npt.NDArray[np.float64]

LEAST_WIDTH = 0.04
"""A surfel of less variance across than along is a line, whose normal says little: one point."""

ABOVE_EXTENTS = 1.0
"""A map is looked at from so many of its diagonals above its middle."""


def surfel_points(surfels: Surfels, voxel_size_m: float) -> Array:
    """
    Return the points (9 K, 3) for surfels, m; those without a normal are left out.

    Parameters
    ----------
    surfels : Surfels
        K of them with a normal.
    voxel_size_m : float
        Edge of their voxels, m: no point leaves its voxel.

    """
    surfels = surfels.select(np.flatnonzero(np.isfinite(surfels.planarity)))
    x, y = across(surfels.normal)
    # the directions across the normal in which the disc is wide are not known: it is taken round
    wide = np.sqrt(3.0 * surfels.eigenvalues[:, 1:].mean(axis=1))
    wide[surfels.eigenvalues[:, 1] < LEAST_WIDTH * surfels.eigenvalues[:, 2]] = 0.0
    half = np.minimum(wide, voxel_size_m * np.sqrt(0.5))[:, None]
    low = surfels.voxel_index * voxel_size_m
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    parts = [surfels.position + half * (i * x + j * y) for i, j in steps]
    inside = [np.clip(part, low, np.nextafter(low + voxel_size_m, low)) for part in parts]
    points: Array = np.stack(inside, axis=1).reshape(-1, 3)
    return points


def across(normals: Array) -> tuple[Array, Array]:
    """Return two unit vectors (K, 3) across each normal and each other."""
    helper = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    x = np.cross(helper, normals)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return x, np.cross(normals, x)


def above(surfels: Surfels) -> Array:
    """Return a viewpoint (3,) far above the middle of surfels, m."""
    if not len(surfels):
        return np.zeros(3)
    low, high = surfels.position.min(axis=0), surfels.position.max(axis=0)
    middle: Array = 0.5 * (low + high)
    middle[2] = high[2] + ABOVE_EXTENTS * float(np.linalg.norm(high - low))
    return middle
