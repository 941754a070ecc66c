# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Viewer: shows a replay in rerun, in a window or as an .rrd file.

Every scan logs the sensor with its points, the changed surfels, and the positions of the scans in
the window. The whole map is logged when a quarter of it has changed since the last time, so a
recording holds each surfel about five times instead of once a scan.

Positions in rerun are float32, so all is shown in the frame of the map; where that has an origin
in the fixed frame, the entity ``map`` states it as ``origin_m``, three float64.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import DependencyError, FileFormatError
from surfel_mapper.layers.drawings import Drawing, MeshDrawing, RingsDrawing
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.messages.model_messages import quaternions
from surfel_mapper.tsdf.mesh import Mesh
from surfel_mapper.viz.mesh import vertex_normals
from surfel_mapper.viz.picture import sides_m, SPREAD

if TYPE_CHECKING:
    from surfel_mapper.pipeline import Mapper, Update

NEW = 0.25
"""Share of the map that has to change before the whole map is logged again."""

MAX_POINTS = 20_000
"""Limit of the points logged of a scan; larger scans are subsampled."""

POINT_RADIUS_M = 0.02

PORT = 9876
"""Port of the window, that of rerun; one that is open there already is used."""

LOOPBACK = '127.0.0.1'
"""Address on which the window listens; rerun's own default is every interface."""

RED, ORANGE = (219, 41, 33), (240, 150, 40)


class Viewer:
    """
    Shows a replay in rerun; a context manager.

    Parameters
    ----------
    mapper : Mapper
        The mapper of the replay.
    path : str or Path, optional
        The .rrd file to write; by default a window opens.

    Raises
    ------
    DependencyError
        If rerun is not installed.
    FileFormatError
        If the file cannot be written.

    """

    def __init__(self, mapper: Mapper, path: str | Path | None = None) -> None:
        self._mapper = mapper
        self._rerun = import_rerun()
        self._positions: list[npt.NDArray[np.float64]] = []
        self._logged_voxels = self._removed = 0
        self._stream: Any = self._rerun.RecordingStream('surfel_mapper')
        if path is None:
            import rerun_bindings  # spawn of rerun itself takes no address

            rerun_bindings.spawn(port=PORT, extra_args=['--bind', LOOPBACK])
            self._stream.connect_grpc(f'rerun+http://{LOOPBACK}:{PORT}/proxy')
        else:
            check_writable(Path(path))
            self._stream.save(str(path))
        self._stream.log('map', self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def __enter__(self) -> Viewer:
        """Return the viewer, which closes at the end of the block."""
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        """Log the final map and close."""
        if kind is None and self._positions:
            self._log_map()
        self._stream.flush()
        self._stream.disconnect()

    def add(self, update: Update) -> None:
        """Log a scan and its changes of the map."""
        rerun, pose = self._rerun, update.T_map_sensor
        origin_m = self._mapper.map.origin_m
        if not self._positions and origin_m.any():
            self._stream.log('map', rerun.AnyValues(origin_m=origin_m), static=True)
        self._positions.append(pose[:3, 3])
        self._stream.set_time('stamp', timestamp=np.datetime64(update.stamp_ns, 'ns'))
        self._stream.log(
            'map/sensor', rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
        )
        self._stream.log(
            'map/sensor/scan',
            rerun.Points3D(picked(update.scan.points), radii=POINT_RADIUS_M),
        )
        self._stream.log('map/trajectory', rerun.LineStrips3D([self._way()], colors=[RED]))
        window = np.array([scan.T_map_sensor[:3, 3] for scan in self._mapper.window])
        self._stream.log(
            'map/window', rerun.Points3D(window.reshape(-1, 3), radii=0.15, colors=[ORANGE])
        )
        self._log_surfels('map/changed', update.changed)
        self._removed += len(update.removed_voxel_index)
        num_voxels = self._mapper.map.num_voxels
        if abs(num_voxels - self._logged_voxels) + self._removed > NEW * num_voxels:
            self._log_map()

    def _way(self) -> npt.NDArray[np.float64]:
        """Return the trajectory of the sensor, at most a thousand positions and the last."""
        step = max(len(self._positions) // 1000, 1)
        return np.array([*self._positions[::step], self._positions[-1]])

    def _log_map(self) -> None:
        """Log all surfels and the active layers."""
        mapper = self._mapper
        self._log_surfels('map/surfels', mapper.map.surfels(mapper.config.map.min_points))
        self._logged_voxels, self._removed = mapper.map.num_voxels, 0
        drawings = [drawing for layer in mapper.layers.values() for drawing in layer.drawings()]
        for group in {drawing.name.partition('/')[0] for drawing in drawings}:
            self._stream.log(f'map/{group}', self._rerun.Clear(recursive=True))
        for drawing in drawings:
            self._log_drawing(f'map/{drawing.name}', drawing)

    def _log_drawing(self, name: str, drawing: Drawing) -> None:
        """Log the shapes of a layer."""
        rerun = self._rerun
        if isinstance(drawing, MeshDrawing):
            self._log_mesh(name, drawing.mesh)
        elif isinstance(drawing, RingsDrawing):
            lines = rerun.LineStrips3D(
                [np.concatenate([ring, ring[:1]]) for ring in drawing.rings],
                colors=drawing.colors,
                labels=list(drawing.labels),
                show_labels=False,
            )
            self._stream.log(name, lines)
        else:
            ellipsoids = rerun.Ellipsoids3D(
                centers=drawing.centers,
                half_sizes=drawing.half_sizes_m,
                quaternions=quaternions(drawing.R_map_axes),
                colors=[drawing.color] * len(drawing.centers),
                fill_mode='solid',
            )
            self._stream.log(name, ellipsoids)

    def _log_mesh(self, name: str, mesh: Mesh) -> None:
        """Log a mesh, in its colours if it has any."""
        if len(mesh):
            self._stream.log(
                name,
                self._rerun.Mesh3D(
                    vertex_positions=mesh.vertices.astype(np.float32),
                    triangle_indices=mesh.triangles.astype(np.uint32),
                    vertex_normals=vertex_normals(mesh),
                    vertex_colors=mesh.colors if len(mesh.colors) else None,
                ),
            )

    def _log_surfels(self, name: str, surfels: Surfels) -> None:
        """Log surfels as points of the size of their discs, coloured by planarity."""
        from matplotlib import colormaps

        valid = surfels.select(np.isfinite(surfels.planarity))
        colours = np.rint(colormaps['viridis'](valid.planarity)[:, :3] * 255.0).astype(np.uint8)
        points = self._rerun.Points3D(
            valid.position, radii=0.5 * SPREAD * sides_m(valid), colors=colours
        )
        self._stream.log(name, points)


def picked(points: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the finite points, subsampled to at most MAX_POINTS."""
    finite = points[np.isfinite(points).all(axis=1)]
    return np.ascontiguousarray(finite[:: max(-(-len(finite) // MAX_POINTS), 1)])


def check_writable(path: Path) -> None:
    """Raise FileFormatError for a file that cannot be written; rerun would only log it."""
    try:
        with open(path, 'wb'):
            pass
    except OSError as error:
        raise FileFormatError(f'{path}: cannot be written: {error.strerror}') from error


def import_rerun() -> Any:
    """Return the module rerun, or raise DependencyError with the command to install it."""
    try:
        import rerun
    except ImportError as error:
        raise DependencyError(
            f'rerun cannot be loaded ({error}). It shows replays; install it with '
            "`pip install 'surfel_mapper[viewer]'` or `pip install rerun-sdk`"
        ) from error
    return rerun
