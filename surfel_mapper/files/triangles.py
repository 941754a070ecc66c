# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Triangles in files of other programs: OBJ, STL and glTF, read and written by trimesh.

glTF has y upwards, so its triangles are turned on the way in and out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np

from surfel_mapper.budget import open_regular
from surfel_mapper.errors import FileFormatError, refusing
from surfel_mapper.files.atomic import replace_file
from surfel_mapper.libraries import library

if TYPE_CHECKING:
    from surfel_mapper.tsdf.mesh import Mesh

GLTF = ('.glb', '.gltf')

SUFFIXES = ('.obj', '.stl', *GLTF)

Y_UP = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Turns a frame with z upwards to one with y upwards."""


def read_triangles(path: Path) -> Mesh:
    """
    Return the triangles of a file (OBJ, STL, GLB, glTF) in a frame with z upwards.

    Raises
    ------
    FileFormatError
        If the file cannot be read, or has no triangles.
    DependencyError
        If trimesh is not installed.

    """
    from surfel_mapper.tsdf.mesh import Mesh

    trimesh = import_trimesh()
    with refusing(path), open_regular(path):  # a pipe would block
        scene = trimesh.load_scene(path, process=False)
        mesh = scene.to_mesh() if scene.geometry else trimesh.Trimesh()
    if not len(mesh.faces):
        raise FileFormatError(f'{path}: no triangles')
    if path.suffix.lower() in GLTF:
        mesh.apply_transform(Y_UP.T)
    return Mesh(
        vertices=np.asarray(mesh.vertices, np.float64),
        triangles=np.asarray(mesh.faces, np.int32),
        colors=vertex_colors(mesh.visual),
    )


def vertex_colors(visual: Any) -> Any:
    """Return the colours of vertices, (V, 3) uint8, textures included; (0, 3) without."""
    if visual.kind == 'texture':
        visual = visual.to_color()
    if visual.kind is None:
        return np.empty((0, 3), np.uint8)
    return np.asarray(visual.vertex_colors[:, :3], np.uint8)


def write_scene(path: Path, scene: Any) -> None:
    """
    Write a scene of trimesh in the format of the file's ending, whole or not at all.

    Raises
    ------
    FileFormatError
        If the scene is empty, or the file cannot be written.

    """
    if not scene.geometry:
        raise FileFormatError(f'{path}: nothing to write')
    content = scene.export(file_type=path.suffix[1:])
    with replace_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def import_trimesh() -> Any:
    """Return the module trimesh, or raise DependencyError."""
    purpose, package = 'reads and writes OBJ, STL and glTF', "'surfel_mapper[meshes]'"
    library('trimesh.path', purpose, package)
    return library('trimesh', purpose, package)
