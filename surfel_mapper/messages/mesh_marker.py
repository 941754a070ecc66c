# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A mesh as a marker: all its triangles, coloured as they were seen or as light falls on them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.geometry import face_normals
from surfel_mapper.messages.cdr import ADD, DELETE, Marker, TRIANGLE_LIST

if TYPE_CHECKING:
    from surfel_mapper.tsdf.mesh import Mesh

LIGHT = np.array([0.3, -0.4, 0.87])
"""From where light falls on meshes without colours."""


def mesh_marker(mesh: Mesh, *, stamp_ns: int, frame_id: str) -> Marker:
    """
    Return the marker ``mesh``, which replaces the one before; of no triangles, it deletes it.

    Parameters
    ----------
    mesh : Mesh
        Without colours its triangles are shaded by their slope, as viewers light no markers.
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
        id=0,
        type=TRIANGLE_LIST,
        action=ADD if len(mesh) else DELETE,
        frame_id=frame_id,
        stamp_ns=stamp_ns,
        points=corners.reshape(-1, 3),
        colors=colors.reshape(-1, 4),
    )


def shade(corners: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Return how bright triangles (F, 3, 3) are, (F,) from 0.3 to 1."""
    normals = face_normals(corners)
    lengths = np.linalg.norm(normals, axis=1)
    towards = normals @ LIGHT / np.where(lengths > 0.0, lengths, 1.0)
    return np.asarray(0.65 + 0.35 * towards / np.linalg.norm(LIGHT), np.float32)
