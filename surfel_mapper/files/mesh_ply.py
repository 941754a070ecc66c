# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Meshes as PLY, in parts: a mesh of a long drive need not fit into memory.

Vertices go to the file, faces to a temporary one until all vertices are written. The numbers of
both are known at the end, so the header is written last, into room left for it.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
import shutil
from tempfile import TemporaryFile
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.files.atomic import replace_file
from surfel_mapper.files.ply import as_table

if TYPE_CHECKING:
    from surfel_mapper.tsdf.mesh import Mesh

HEADER_BYTES = 512
"""Room for the header; it takes up to 380."""


def write_mesh(path: str | Path, mesh: Mesh, origin_m: npt.ArrayLike = (0.0, 0.0, 0.0)) -> None:
    """Write a mesh; see write_mesh_parts."""
    write_mesh_parts(path, [mesh], origin_m)


def write_mesh_parts(
    path: str | Path, parts: Iterable[Mesh], origin_m: npt.ArrayLike = (0.0, 0.0, 0.0)
) -> None:
    """
    Write a mesh as a binary PLY, with the colours and labels of the vertices if it has any.

    Parameters
    ----------
    path : str or Path
        The file, written whole or not at all.
    parts : iterable of Mesh
        One or more; triangles count the vertices of all parts up to theirs. No more than one part
        is in memory at a time.
    origin_m : (3,) float
        Added to the vertices, m.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    layout = np.dtype([('count', 'u1'), ('corners', '<i4', (3,))])
    properties, num_vertices, num_faces = '', 0, 0
    with replace_file(path) as file, TemporaryFile(dir=Path(path).parent) as rest:
        file.write(b' ' * HEADER_BYTES)
        for mesh in parts:
            found, vertices = as_table(vertex_columns(mesh, np.asarray(origin_m)))
            if len(vertices) or not properties:  # a part without vertices has no colours
                properties = found
            faces = np.empty(len(mesh), layout)
            faces['count'], faces['corners'] = 3, mesh.triangles
            file.write(vertices.view(np.uint8).data)
            rest.write(faces.view(np.uint8).data)
            num_vertices, num_faces = num_vertices + len(vertices), num_faces + len(faces)
        rest.seek(0)
        shutil.copyfileobj(rest, file)
        head = 'ply\nformat binary_little_endian 1.0\ncomment surfel_mapper, metres'
        elements = (
            f'element vertex {num_vertices}\n{properties}'
            f'element face {num_faces}\nproperty list uchar int vertex_indices\nend_header\n'
        )
        padding = HEADER_BYTES - len(head) - 1 - len(elements)
        file.seek(0)
        file.write(f'{head}{" " * padding}\n{elements}'.encode('ascii'))


def vertex_columns(mesh: Mesh, origin_m: npt.NDArray[np.float64]) -> dict[str, npt.NDArray[Any]]:
    """Return the properties of the vertices of a mesh."""
    columns = dict(zip('xyz', (mesh.vertices + origin_m).T, strict=True))
    if len(mesh.colors):
        columns.update(zip(('red', 'green', 'blue'), mesh.colors.T, strict=True))
    if len(mesh.labels):
        columns['label'] = mesh.labels
    return columns
