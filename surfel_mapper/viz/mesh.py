# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Meshes for pages and viewers: vertex normals and simplification.

A mesh is simplified by merging the vertices in each cell of a grid (Rossignac and Borrel 1993), in
one pass of array operations for any topology. Triangles with merged corners vanish. Edges are
rounded by a cell, a few pixels for 24,000 triangles on a page.
"""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.geometry import face_normals
from surfel_mapper.tsdf.mesh import Mesh

MAX_TRIANGLES = 24_000
"""Limit of all meshes on a page together: 0.6 to 0.8 MB of text, 12 bytes a triangle, 16 bytes a
vertex, of which there are 12,000 to 18,000."""

VERTEX = np.dtype([('place', '<u2', 3), ('', '<u2'), ('color', 'u1', 4), ('normal', 'i1', 4)])
"""Vertex format of page/view.js; the fourth components of colour and normal are unused."""

GREY = np.array([200, 200, 205], np.uint8)
"""Colour of meshes without colours."""


def vertex_normals(mesh: Mesh) -> npt.NDArray[np.float32]:
    """Return unit normals towards free space, (V, 3); 0 for vertices without triangles."""
    corners = mesh.vertices[mesh.triangles]
    across = face_normals(corners)
    normals = np.zeros_like(mesh.vertices)
    for corner, axis in np.ndindex(3, 3):
        vertex = mesh.triangles[:, corner]
        normals[:, axis] += np.bincount(vertex, across[:, axis], len(normals))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    np.divide(normals, length, out=normals, where=length > 0.0)
    return normals.astype(np.float32)


def reduced(mesh: Mesh, max_triangles: int = MAX_TRIANGLES) -> Mesh:
    """Return a mesh of at most max_triangles, its vertices merged in cells as large as needed."""
    if len(mesh) <= max_triangles:
        return mesh
    corners = mesh.vertices[mesh.triangles[:: max(len(mesh) // 10_000, 1)]]
    cell_m = float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))
    smaller = mesh
    while len(smaller) > max_triangles:
        cell_m *= max((len(smaller) / max_triangles) ** 0.5, 1.1)
        smaller = merged(mesh, cell_m)
    return smaller


def merged(mesh: Mesh, cell_m: float) -> Mesh:
    """Return a mesh with the vertices of each cell merged at their mean."""
    index = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / cell_m).astype(np.int64)
    sides = index.max(axis=0) + 1
    key = (index[:, 2] * sides[1] + index[:, 1]) * sides[0] + index[:, 0]
    _, cell, count = np.unique(key, return_inverse=True, return_counts=True)
    triangles = cell[mesh.triangles].astype(np.int32)
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]

    def mean(values: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        sums = [np.bincount(cell, column, len(count)) for column in values.T]
        means: npt.NDArray[np.float64] = np.stack(sums, axis=1) / count[:, None]
        return means

    colors = mesh.colors
    if len(colors):
        colors = np.rint(mean(colors)).astype(np.uint8)
    turned = np.roll(triangles, -1, axis=1), np.roll(triangles, -2, axis=1)
    first = triangles.argmin(axis=1)[:, None]
    same = np.where(first == 0, triangles, np.where(first == 1, *turned))
    return Mesh(
        vertices=mean(mesh.vertices),
        triangles=np.unique(same, axis=0) if len(same) else same,
        colors=colors,
    )


def mesh_data(
    mesh: Mesh,
    low: npt.NDArray[np.float64],
    size: npt.NDArray[np.float64],
    max_triangles: int = MAX_TRIANGLES,
) -> dict[str, Any]:
    """
    Return the data of a mesh for page/view.js, relative to the middle of the map's box.

    Vertices farther from that box than half of its longest side are left out.
    """
    centre, reach = low + 0.5 * size, 0.5 * size + 0.5 * size.max()
    near = np.less_equal(np.abs(mesh.vertices - centre), reach).min(axis=1)
    triangles = mesh.triangles[near[mesh.triangles].min(axis=1)]
    near_mesh = Mesh(vertices=mesh.vertices, triangles=triangles, colors=mesh.colors)
    mesh = reduced(near_mesh, max_triangles)
    used, indices = np.unique(mesh.triangles, return_inverse=True)
    packed = np.zeros(len(used), VERTEX)
    within = (mesh.vertices[used] - centre + reach) / (2.0 * reach)
    packed['place'] = np.rint(np.clip(within, 0.0, 1.0) * 65535.0)
    packed['normal'][:, :3] = np.rint(vertex_normals(mesh)[used] * 127.0)
    packed['color'][:, :3] = mesh.colors[used] if len(mesh.colors) else GREY
    return {
        'vertices': base64.b64encode(packed.tobytes()).decode(),
        'triangles': base64.b64encode(indices.astype('<u4').tobytes()).decode(),
        'reach': [float(side) for side in reach],
    }
