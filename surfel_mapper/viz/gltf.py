# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A scene as a glTF file (.glb), for Blender, web pages, game engines and presentations.

Every tile of a map, mesh and trajectory is a node with its name. glTF has y upwards, so the root
turns the frame of the map, and colours are linear. Values and times have no place in glTF: for
these there are files of rerun.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.triangles import import_trimesh, write_scene, Y_UP
from surfel_mapper.tsdf.mesh import Mesh
from surfel_mapper.viz.discs import Colouring, CORNERS, DrawnDiscs
from surfel_mapper.viz.mesh import GREY

Array = npt.NDArray[np.float64]


class GltfScene:
    """
    Collects what ``show_contents`` shows, and writes it at ``flush``.

    Parameters
    ----------
    path : str or Path
        The file, ending in .glb.

    Raises
    ------
    DependencyError
        If trimesh is not installed.
    FileFormatError
        If the file has another ending.

    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if self.path.suffix != '.glb':
            raise FileFormatError(f'{path}: expected a name ending in .glb')
        self.colouring = Colouring()
        self._trimesh = import_trimesh()
        self._scene = self._trimesh.Scene(base_frame='map')

    def set_origin(self, origin_m: npt.ArrayLike) -> None:
        """State the place of the frame of the map in the fixed frame, (3,) m, in ``extras``."""
        self._scene.metadata['origin_m'] = np.asarray(origin_m, np.float64).tolist()

    def look(self, low: Array, high: Array, target: Array, hidden: Sequence[str] = ()) -> None:
        """Leave the eye to the program that opens the file."""

    def discs(self, path: str, discs: DrawnDiscs, *, static: bool = True) -> None:
        """Add discs; they are seen from the side of their normal."""
        if not len(discs):
            return
        corners, triangles = discs.triangles()
        colours = np.repeat(self.colouring.of(discs), CORNERS, axis=0)
        self._add(path, corners, triangles, colours)

    def mesh(self, path: str, mesh: Mesh, *, static: bool = True) -> None:
        """Add a mesh, in its colours if it has any."""
        if not len(mesh):
            return
        grey = np.broadcast_to(GREY, mesh.vertices.shape)
        colours = mesh.colors if len(mesh.colors) else grey
        self._add(path, mesh.vertices, mesh.triangles, colours)

    def points(
        self,
        path: str,
        points: Array,
        radius_m: float,
        colour: Sequence[int] | None = None,
        *,
        static: bool = True,
    ) -> None:
        """Add points (N, 3), m; glTF has no size of points."""
        colours = np.broadcast_to(linear(np.array(GREY if colour is None else colour)), (1, 3))
        geometry = self._trimesh.PointCloud(points, np.repeat(colours, len(points), axis=0))
        self._add_geometry(path, geometry)

    def lines(
        self,
        path: str,
        lines: Sequence[Array],
        colours: Any,
        labels: Sequence[str] | None = None,
        *,
        static: bool = True,
    ) -> None:
        """Add lines, (M, 3) m each."""
        for line in lines:
            if len(line) > 1:
                self._add_geometry(path, self._trimesh.load_path(line))

    def poses(self, path: str, stamp_ns: npt.NDArray[np.int64], xyz: Array, turns: Array) -> None:
        """Leave out poses over time."""

    def flush(self) -> None:
        """
        Write the file, whole or not at all.

        Raises
        ------
        FileFormatError
            If nothing was shown, or the file cannot be written.

        """
        write_scene(self.path, self._scene)

    def _add(self, path: str, vertices: Any, triangles: Any, colours: Any) -> None:
        mesh = self._trimesh.Trimesh(
            vertices, triangles, vertex_colors=linear(colours), process=False
        )
        mesh.vertex_normals  # noqa: B018, glTF has only normals that were computed
        self._add_geometry(path, mesh)

    def _add_geometry(self, path: str, geometry: Any) -> None:
        self._scene.add_geometry(geometry, node_name=path, geom_name=path, transform=Y_UP)


def linear(colours: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """Return colours of the screen (sRGB), 0 to 255, as the linear ones of glTF."""
    shares = colours / 255.0
    low = shares <= 0.04045
    values = np.where(low, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    return np.rint(255.0 * values).astype(np.uint8)
