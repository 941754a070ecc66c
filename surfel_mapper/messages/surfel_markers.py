# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surfels as coloured discs with normals as lines, and meshes as triangles.

A disc is a hexagon of four triangles, 12 vertices of 40 bytes: 20,000 discs are 10 MB, of which
the middleware makes two more copies. (A colour per triangle would save a quarter, but not every
viewer supports it.) All discs are one marker and all lines another, so each message replaces the
picture before it, with surfels that have left the map.
"""

from __future__ import annotations

from collections.abc import Iterable
import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.geometry import face_normals
from surfel_mapper.mapping.ages import last_seen_ns
from surfel_mapper.messages.markers import ADD, DELETE, LINE_LIST, Marker, TRIANGLE_LIST

if TYPE_CHECKING:
    from surfel_mapper.mapping.surfels import Surfels
    from surfel_mapper.mapping.window import WindowedScan
    from surfel_mapper.tsdf.mesh import Mesh


SEGMENTS = 6

ANGLES = np.arange(SEGMENTS) * (2.0 * math.pi / SEGMENTS)

CIRCLE = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
"""The corners of a disc."""

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
Colours of 0 to 1 at equal distances, red green blue: violet, blue, green, yellow.

Lightness rises evenly from 0.34 to 0.92 while the hue turns from 305 to 105 deg in Oklab, with the
highest chroma of a screen: the order can be seen in grey, and by the colour-blind.
"""

SHADES = 256

TABLE = np.stack(
    [
        np.interp(np.linspace(0, 1, SHADES), np.linspace(0, 1, len(PALETTE)), channel)
        for channel in (*PALETTE.T, np.ones(len(PALETTE)))
    ],
    axis=1,
).astype(np.float32)
"""The palette in fine steps, with opacity."""

NORMAL_COLOR = (0.9, 0.9, 0.9, 0.8)


def surfel_markers(
    surfels: Surfels,
    voxel_size_m: float,
    colors: npt.NDArray[np.float32],
    *,
    stamp_ns: int,
    frame_id: str,
) -> list[Marker]:
    """
    Return two markers that draw surfels: their discs, and their normals as lines.

    Parameters
    ----------
    surfels : Surfels
        Surfels without a normal are left out.
    voxel_size_m : float
        Twice the length of the normals.
    colors : (K, 4) float32
        Red, green, blue and opacity of each surfel in [0, 1]; see shades and normal_colors.
    stamp_ns, frame_id : int, str
        Of the map.

    Returns
    -------
    list of Marker
        ``discs`` and ``normals``, which replace those sent before, or delete them if there is
        nothing to draw.

    """
    rows = np.flatnonzero(np.isfinite(surfels.normal[:, 0]))  # nan in all of it, or in none
    position, normal = surfels.position[rows], surfels.normal[rows]
    radius = disc_radius(surfels.eigenvalues[rows], surfels.size[rows])
    discs = disc_triangles(position, normal, radius, CIRCLE)
    lines = np.stack([position, position + 0.5 * voxel_size_m * normal], axis=1)
    action = ADD if len(rows) else DELETE
    return [
        Marker(
            ns='discs',
            id=0,
            type=TRIANGLE_LIST,
            action=action,
            frame_id=frame_id,
            stamp_ns=stamp_ns,
            points=discs.reshape(-1, 3),
            colors=np.repeat(colors[rows], discs.shape[1], axis=0),
        ),
        Marker(
            ns='normals',
            id=0,
            type=LINE_LIST,
            action=action,
            frame_id=frame_id,
            stamp_ns=stamp_ns,
            scale=(0.02 * voxel_size_m, 0.0, 0.0),
            color=NORMAL_COLOR,
            points=lines.reshape(-1, 3),
        ),
    ]


def disc_triangles(
    position: npt.NDArray[np.float64],
    normal: npt.NDArray[np.float64],
    radius: npt.NDArray[np.float64],
    circle: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """
    Return the corners (K, 3 (S - 2), 3) of triangles that make up discs, counter-clockwise.

    The corners (S, 2) of the circle are turned by two axes that are orthogonal to each normal.

    Source: Duff et al. 2017, Building an orthonormal basis, revisited, for the axes.
    """
    x, y, z = normal.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    u = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    v = np.stack([b, sign + y * y * a, -y], axis=1)
    c, s = circle.T[:, None, :, None] * radius[:, None, None]
    corners = position[:, None] + (c * u[:, None] + s * v[:, None])
    fan = [corner for k in range(1, len(circle) - 1) for corner in (0, k, k + 1)]
    return np.asarray(corners[:, fan])


def disc_radius(
    eigenvalues: npt.NDArray[np.float64], size_m: npt.ArrayLike
) -> npt.NDArray[np.float64]:
    """
    Return the radius of the disc that stands for each surfel, (K,) m.

    It is at most half the diagonal of a face of the voxel, of edge size_m.

    The variance along the side of a square patch is side^2 / 12; half of the side, so that the
    discs of a plane touch, is sqrt(3 e2) for the larger variance in the patch.
    """
    radius: npt.NDArray[np.float64] = np.sqrt(3.0 * np.maximum(eigenvalues[:, 2], 0.0))
    return np.minimum(radius, math.sqrt(0.5) * np.asarray(size_m), out=radius)


def shades(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Return the colours of values in [0, 1], (K, 4): dark to bright; nan counts as 0."""
    steps = np.rint(np.nan_to_num(np.clip(values, 0.0, 1.0)) * (SHADES - 1))
    return np.asarray(TABLE[steps.astype(np.uint8)])


def disc_colors(
    kind: str, surfels: Surfels, scans: Iterable[WindowedScan] = ()
) -> npt.NDArray[np.float32]:
    """
    Return the colours of surfels, (K, 4).

    Parameters
    ----------
    kind : str
        planarity, normal or age. The age is that of the newest scan that saw the voxel, from dark
        for the oldest scan of the window to bright for the newest.
    surfels : Surfels
        K of them.
    scans : iterable of WindowedScan
        The scans of the window.

    """
    if kind == 'normal':
        return normal_colors(surfels.normal)
    if kind == 'planarity':
        return shades(surfels.planarity)
    window = list(scans)
    stamps = [scan.stamp_ns for scan in window] or [0]
    span_ns = max(max(stamps) - min(stamps), 1)
    last_ns = last_seen_ns(surfels.voxel_index, window)
    return shades((last_ns - min(stamps)) / span_ns)


def normal_colors(normal: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Return the colours of normals, (K, 4): red, green, blue are x, y, z from -1 to 1."""
    colors = np.ones((len(normal), 4), np.float32)
    colors[:, :3] = 0.5 * normal + 0.5
    return colors


LIGHT = np.array([0.3, -0.4, 0.87])
"""Direction to the light that shades meshes without colours."""


def mesh_marker(mesh: Mesh, *, number: int, stamp_ns: int, frame_id: str) -> Marker:
    """
    Return a marker of the namespace ``mesh``; an empty mesh deletes the one before.

    Parameters
    ----------
    mesh : Mesh
        If it has no colours, triangles are shaded by their slope: viewers do not light markers.
    number : int
        Id of the marker.
    stamp_ns, frame_id : int, str
        Of the mesh.

    """
    corners = mesh.vertices[mesh.triangles]
    colors = np.ones((len(mesh), 3, 4), np.float32)
    if len(mesh.colors):
        colors[..., :3] = mesh.colors[mesh.triangles] / np.float32(255.0)
    else:
        colors[..., :3] = shade(corners)[:, None, None]
    return Marker(
        ns='mesh',
        id=number,
        type=TRIANGLE_LIST,
        action=ADD if len(mesh) else DELETE,
        frame_id=frame_id,
        stamp_ns=stamp_ns,
        points=corners.reshape(-1, 3),
        colors=colors.reshape(-1, 4),
    )


def shade(corners: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Return the brightness of triangles (F, 3, 3), (F,) from 0.3 to 1."""
    normals = face_normals(corners)
    lengths = np.linalg.norm(normals, axis=1)
    lightness = normals @ LIGHT / np.where(lengths > 0.0, lengths, 1.0)
    return np.asarray(0.65 + 0.35 * lightness / np.linalg.norm(LIGHT), np.float32)
