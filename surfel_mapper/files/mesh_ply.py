# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Meshes as binary PLY."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.files.atomic import replace_file
from surfel_mapper.files.ply import as_table

if TYPE_CHECKING:
    from surfel_mapper.tsdf.mesh import Mesh


def write_mesh(path: str | Path, mesh: Mesh, origin_m: npt.ArrayLike = (0.0, 0.0, 0.0)) -> None:
    """
    Write a mesh as a binary PLY, with the colours and labels of the vertices if it has any.

    Parameters
    ----------
    path : str or Path
        The file, written whole or not at all.
    mesh : Mesh
        The triangles.
    origin_m : (3,) float
        Added to the vertices, m.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    properties, vertices = as_table(vertex_columns(mesh, np.asarray(origin_m)))
    faces = np.empty(len(mesh), [('count', 'u1'), ('corners', '<i4', (3,))])
    faces['count'], faces['corners'] = 3, mesh.triangles
    head = (
        'ply\nformat binary_little_endian 1.0\ncomment surfel_mapper, metres\n'
        f'element vertex {len(vertices)}\n{properties}'
        f'element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n'
    )
    with replace_file(path) as file:
        file.write(head.encode('ascii'))
        file.write(vertices.view(np.uint8).data)
        file.write(faces.view(np.uint8).data)


def vertex_columns(mesh: Mesh, origin_m: npt.NDArray[np.float64]) -> dict[str, npt.NDArray[Any]]:
    """Return the properties of the vertices of a mesh."""
    columns = dict(zip('xyz', (mesh.vertices + origin_m).T, strict=True))
    if len(mesh.colors):
        columns.update(zip(('red', 'green', 'blue'), mesh.colors.T, strict=True))
    if len(mesh.labels):
        columns['label'] = mesh.labels
    return columns
