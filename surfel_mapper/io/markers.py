# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surfels as markers: discs coloured by planarity, normals as lines.

A disc is a regular polygon cut into a fan of triangles. Eight corners look round and take 18
vertices of 40 bytes: 20,000 discs are 14 MB. Corners are computed once each and copied to the
triangles as opaque items of 24 bytes, which is four times as fast as indexing rows of three
numbers.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.io.cdr import ADD, DELETE, LINE_LIST, Marker, TRIANGLE_LIST

if TYPE_CHECKING:
    from surfel_mapper.mapping.surfels import Surfels

SEGMENTS = 8

PALETTE = np.array(
    [
        (0.303, 0.035, 0.482),
        (0.204, 0.259, 0.679),
        (0.076, 0.457, 0.652),
        (0.112, 0.606, 0.652),
        (0.146, 0.758, 0.613),
        (0.541, 0.873, 0.429),
        (0.964, 0.918, 0.304),
    ]
)
"""
Colours of planarity 0 to 1 at equal distances, red green blue: violet, blue, green, yellow.

Lightness rises evenly from 0.34 to 0.92 while the hue turns from 305 to 105 deg in Oklab, each
as colourful as the screen allows: the order can be seen in grey, and by the colour-blind.
"""

NORMAL_COLOR = (0.9, 0.9, 0.9, 0.8)


def surfel_markers(
    surfels: Surfels,
    voxel_size_m: float,
    *,
    stamp_ns: int,
    frame_id: str,
    max_markers: int = 20_000,
) -> list[Marker]:
    """
    Return two markers that draw surfels: their discs, and their normals as lines.

    Parameters
    ----------
    surfels : Surfels
        Those without a normal are left out.
    voxel_size_m : float
        Bounds the radius of a disc at half the diagonal of a voxel's face.
    stamp_ns, frame_id : int, str
        Of the map.
    max_markers : int
        If there are more surfels, so many are drawn, evenly spread; see thinned.

    Returns
    -------
    list of Marker
        ``discs`` and ``normals``, which replace those sent before; where nothing is to be drawn,
        they delete them.

    """
    rows = np.flatnonzero(np.isfinite(surfels.normal).all(axis=1))
    if len(rows) > max_markers:
        rows = rows[thinned(surfels.voxel_index[rows], max_markers)]
    position, normal = surfels.position[rows], surfels.normal[rows]
    radius = disc_radius(surfels.eigenvalues[rows], voxel_size_m)
    colors = np.repeat(planarity_colors(surfels.planarity[rows]), 3 * (SEGMENTS - 2), axis=0)
    lines = np.stack([position, position + 0.5 * voxel_size_m * normal], axis=1)
    action = ADD if len(rows) else DELETE
    return [
        Marker(
            ns='discs', id=0, type=TRIANGLE_LIST, action=action,
            frame_id=frame_id, stamp_ns=stamp_ns,
            points=disc_triangles(position, normal, radius, SEGMENTS), colors=colors,
        ),
        Marker(
            ns='normals', id=0, type=LINE_LIST, action=action,
            frame_id=frame_id, stamp_ns=stamp_ns,
            scale=(0.02 * voxel_size_m, 0.0, 0.0), color=NORMAL_COLOR, points=lines.reshape(-1, 3),
        ),
    ]  # fmt: skip


def disc_radius(
    eigenvalues: npt.NDArray[np.float64], voxel_size_m: float
) -> npt.NDArray[np.float64]:
    """
    Return the radius of the disc that stands for each surfel, (K,) m.

    The variance along the side of a square patch is side^2 / 12; half of the side, so that the
    discs of a plane touch, is sqrt(3 e2) for the larger variance in the patch.
    """
    radius: npt.NDArray[np.float64] = np.sqrt(3.0 * np.maximum(eigenvalues[:, 2], 0.0))
    return np.minimum(radius, math.sqrt(0.5) * voxel_size_m, out=radius)


def disc_triangles(
    position: npt.NDArray[np.float64],
    normal: npt.NDArray[np.float64],
    radius: npt.NDArray[np.float64],
    segments: int,
) -> npt.NDArray[np.float64]:
    """
    Return regular polygons as triangles, counter-clockwise seen from where the normals point.

    Parameters
    ----------
    position : (K, 3) float64, m
        Centres.
    normal : (K, 3) float64
        Unit vectors.
    radius : (K,) float64, m
        From the centre to the corners.
    segments : int
        Corners of a polygon, 3 or more.

    Returns
    -------
    (K * (segments - 2) * 3, 3) float64, m
        Three corners a triangle, polygon by polygon.

    """
    u, v = (radius[:, None] * axis for axis in tangents(normal))
    corners = np.empty((segments, len(position), 3))
    for i in range(segments):
        angle = 2.0 * math.pi * i / segments
        corners[i] = position + math.cos(angle) * u + math.sin(angle) * v
    item = np.dtype((np.void, corners.itemsize * 3))
    fan = [corner for i in range(1, segments - 1) for corner in (0, i, i + 1)]
    triangles = np.empty((len(position), len(fan)), item)
    for place, corner in enumerate(fan):
        triangles[:, place] = corners[corner].view(item)[:, 0]
    return triangles.view(np.float64).reshape(-1, 3)


def tangents(
    normal: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """
    Return two unit vectors that make a right-handed frame with each normal, (K, 3) both.

    Source: Duff et al. 2017, Building an Orthonormal Basis, Revisited: no branch, and no normal
    near which it loses digits.
    """
    x, y, z = normal.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    u = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    v = np.stack([b, sign + y * y * a, -y], axis=1)
    return u, v


def planarity_colors(planarity: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Return red, green, blue and opacity of each planarity, (K, 4)."""
    colors = np.ones((len(planarity), 4), np.float32)
    anchors = np.linspace(0.0, 1.0, len(PALETTE))
    for channel in range(3):
        colors[:, channel] = np.interp(planarity, anchors, PALETTE[:, channel])
    return colors


def thinned(voxel_index: npt.NDArray[np.int32], number: int) -> npt.NDArray[np.int64]:
    """
    Return the rows of so many voxels, evenly spread and in order.

    They are those of the smallest hashes, so that a voxel drawn stays drawn while the map grows:
    any rule that looks at rows would redraw the map with others every time.
    """
    mixed = np.zeros(len(voxel_index), np.uint64)
    for axis in range(3):
        mixed ^= voxel_index[:, axis].astype(np.uint64)
        mixed *= np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio, odd
        mixed ^= mixed >> np.uint64(29)
    return np.sort(np.argpartition(mixed, number - 1)[:number])
