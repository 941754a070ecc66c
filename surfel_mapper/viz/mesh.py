# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The mesh of the TSDF for pages and viewers: normals of its vertices, and fewer triangles.

A mesh is made smaller by merging the vertices in each cell of a grid (Rossignac and Borrel 1993):
in one pass of array operations, whatever its topology. Triangles whose corners meet vanish. It
rounds edges off by a cell, which on a page of 100,000 triangles is a pixel or two.
"""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.geometry import face_normals
from surfel_mapper.tsdf.mesh import Mesh

MAX_TRIANGLES = 150_000
"""Shown on a page: 75,000 vertices of 16 bytes and 12 bytes a triangle, 4 MB of text."""

VERTEX = np.dtype([('place', '<u2', 3), ('', '<u2'), ('color', 'u1', 4), ('normal', 'i1', 4)])
"""A vertex as page/view.js takes it; the fourth colour and normal are spare."""

GREY = np.array([200, 200, 205], np.uint8)
"""Of meshes without colours."""


def vertex_normals(mesh: Mesh) -> npt.NDArray[np.float32]:
    """Return unit normals, (V, 3), towards free space; those of no triangle are 0."""
    corners = mesh.vertices[mesh.triangles]
    across = face_normals(corners)
    normals = np.zeros_like(mesh.vertices)
    for corner, axis in np.ndindex(3, 3):
        place = mesh.triangles[:, corner]
        normals[:, axis] += np.bincount(place, across[:, axis], len(normals))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    np.divide(normals, length, out=normals, where=length > 0.0)
    return normals.astype(np.float32)


def reduced(mesh: Mesh, max_triangles: int = MAX_TRIANGLES) -> Mesh:
    """Return a mesh of at most so many triangles, its vertices merged in ever larger cells."""
    if len(mesh) <= max_triangles:
        return mesh
    corners = mesh.vertices[mesh.triangles[:: max(len(mesh) // 10_000, 1)]]
    cell_m = float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))
    found = mesh
    while len(found) > max_triangles:
        cell_m *= max((len(found) / max_triangles) ** 0.5, 1.1)
        found = merged(mesh, cell_m)
    return found


def merged(mesh: Mesh, cell_m: float) -> Mesh:
    """Return a mesh whose vertices in one cell have become one, at their mean."""
    index = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / cell_m).astype(np.int64)
    sides = index.max(axis=0) + 1
    key = (index[:, 2] * sides[1] + index[:, 1]) * sides[0] + index[:, 0]
    _, place, count = np.unique(key, return_inverse=True, return_counts=True)
    triangles = place[mesh.triangles].astype(np.int32)
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]

    def mean(values: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        sums = [np.bincount(place, column, len(count)) for column in values.T]
        return np.stack(sums, axis=1) / count[:, None]

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
    mesh: Mesh, low: npt.NDArray[np.float64], size: npt.NDArray[np.float64]
) -> dict[str, Any]:
    """
    Return what page/view.js needs of a mesh: what is about the box of the map, from its middle.

    Vertices farther from that box than half of its longest side are left out.
    """
    middle, reach = low + 0.5 * size, 0.5 * size + 0.5 * size.max()
    near = np.less_equal(np.abs(mesh.vertices - middle), reach).min(axis=1)
    triangles = mesh.triangles[near[mesh.triangles].min(axis=1)]
    mesh = reduced(Mesh(vertices=mesh.vertices, triangles=triangles, colors=mesh.colors))
    used, places = np.unique(mesh.triangles, return_inverse=True)
    packed = np.zeros(len(used), VERTEX)
    within = (mesh.vertices[used] - middle + reach) / (2.0 * reach)
    packed['place'] = np.rint(np.clip(within, 0.0, 1.0) * 65535.0)
    packed['normal'][:, :3] = np.rint(vertex_normals(mesh)[used] * 127.0)
    packed['color'][:, :3] = mesh.colors[used] if len(mesh.colors) else GREY
    return {
        'vertices': base64.b64encode(packed.tobytes()).decode(),
        'triangles': base64.b64encode(places.astype('<u4').tobytes()).decode(),
        'reach': [float(side) for side in reach],
    }
