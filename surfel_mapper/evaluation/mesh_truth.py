# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Faces of a mesh as truth, for comparison.py: places are on faces, not at their corners.

Faces are cut into pieces of a few centimetres. Those of the pieces nearest to a position by their
middles are measured by trimesh, which gives the nearest place on a triangle.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from surfel_mapper.errors import FileFormatError
from surfel_mapper.evaluation.comparison import Nearest
from surfel_mapper.files import ply
from surfel_mapper.files.triangles import (
    import_trimesh,
    read_triangles,
    SUFFIXES,
)
from surfel_mapper.tsdf.mesh import Mesh

Floats = npt.NDArray[np.float64]

EDGE_M, MOST_PIECES = 0.1, 2_000_000
"""Longest edge of a piece, m; longer for a mesh of which there would be more pieces."""

MAX_HALVINGS = 24
"""Limit of the halvings of an edge: one of 1000 km."""

CANDIDATES = 24
"""Pieces that are measured for each position: those around a corner, and some beyond."""

CHUNK = 20_000
"""Positions that are measured at a time, some 50 MB."""


class MeshTruth:
    """
    Faces of a mesh.

    Parameters
    ----------
    mesh : Mesh
        Triangles; those without an area are left out.

    """

    def __init__(self, mesh: Mesh) -> None:
        trimesh = import_trimesh()
        self._closest = trimesh.triangles.closest_point
        corners = mesh.vertices[mesh.triangles]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        double_m2 = np.sqrt((cross**2).sum(axis=1))
        has_area = double_m2 > 0.0
        self._corners = corners[has_area]
        self._normal = cross[has_area] / double_m2[has_area, None]
        edge_m = max(EDGE_M, float(np.sqrt(2.0 * double_m2.sum() / MOST_PIECES)))
        vertices, pieces, self._face = trimesh.remesh.subdivide_to_size(
            mesh.vertices, mesh.triangles[has_area], edge_m, MAX_HALVINGS, return_index=True
        )
        self._middles = vertices[pieces].mean(axis=1)
        self._tree = cKDTree(self._middles)

    def nearest(self, position: Floats) -> Nearest:
        """Return the points of the faces nearest to positions (K, 3), m."""
        point, face = np.empty_like(position), np.empty(len(position), np.int64)
        number = min(CANDIDATES, len(self._middles))
        for first in range(0, len(position), CHUNK):
            some = slice(first, first + CHUNK)
            _, near = self._tree.query(position[some], k=[*range(1, number + 1)])
            faces = self._face[near]
            asked = np.repeat(position[some], number, axis=0)
            candidates = self._closest(self._corners[faces.ravel()], asked)
            off_sq = ((candidates - asked) ** 2).sum(axis=1).reshape(-1, number)
            rows = np.arange(len(faces)), off_sq.argmin(axis=1)
            point[some], face[some] = candidates.reshape(-1, number, 3)[rows], faces[rows]
        distance_m = np.sqrt(((point - position) ** 2).sum(axis=1))
        return Nearest(distance_m, distance_m, self._normal[face], point)

    def samples(self) -> Floats:
        """Return the middles of the pieces."""
        return np.asarray(self._middles, np.float64)


def load_mesh(path: Path) -> MeshTruth | None:
    """
    Return the faces in a file, PLY, OBJ, STL or glTF; None for points.

    Raises
    ------
    FileFormatError
        If the file is damaged.
    DependencyError
        If it has faces and trimesh is not installed.

    """
    suffix = path.suffix.lower()
    mesh = None
    if suffix == '.ply':
        mesh = ply.read_mesh(path)
    elif suffix in SUFFIXES:
        try:
            mesh = read_triangles(path)
        except FileFormatError:
            if suffix != '.obj':  # which may have points
                raise
    return None if mesh is None else MeshTruth(mesh)
