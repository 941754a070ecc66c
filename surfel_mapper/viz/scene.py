# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Scene: discs, meshes, lines and poses in rerun, in a window, a browser or an .rrd file.

A disc is a hexagon of a mesh, which rerun shades and draws fast, and is seen from the side of its
normal only: from above, rooms have no roof. A point of one pixel at its middle, in its colour, can
be picked and has the values of the surfel. Rerun draws in float32, so positions are given
in the frame of the map; where that has an origin in the fixed frame, the entity ``map`` states it
as ``origin_m``, and discs that are picked have the coordinates of the fixed frame, as
``fixed_x_m`` and so on.

Servers listen on loopback only: what is shown is not protected by a password.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.tsdf.mesh import Mesh
from surfel_mapper.viz.discs import Colouring, CORNERS, DrawnDiscs
from surfel_mapper.viz.mesh import GREY, vertex_normals
from surfel_mapper.viz.recording_file import RecordingFile
from surfel_mapper.viz.server import (
    end_group,
    free_port,
    import_rerun,
    LOOPBACK,
    Server,
    started_server,
    WHOLE,
)

Array = npt.NDArray[np.float64]

PORT = 9876
"""Port of the window, that of rerun; one that is open there already is used."""

PICKED, SENSOR_RADIUS = -0.5, -4.0
"""Radii of the point that is picked and of a sensor, which rerun takes as pixels since they are
negative: in metres the sensor would be large in a room, or small in a street."""

POINT_RADIUS_M = 0.02

AROUND_M = 12.0
"""Half of the side of the place that is looked at around a sensor, m."""

NORMAL = ('normal_x', 'normal_y', 'normal_z')

FIXED = ('fixed_x_m', 'fixed_y_m', 'fixed_z_m')
"""Names of the coordinates in the fixed frame, shown for a disc that is picked."""

RED, ORANGE = (219, 41, 33), (240, 150, 40)


class Scene:
    """
    Entities shown in rerun; a context manager.

    Parameters
    ----------
    stream : rerun.RecordingStream
        As ``to_window``, ``to_browser`` and ``to_file`` open it.
    address : str, optional
        Address of the page in a browser.
    server : Server, optional
        The server of the page, which ends with the scene.
    file : RecordingFile, optional
        The file that is written, which gets its name with the end of the scene.

    Attributes
    ----------
    rerun : module
        Its archetypes are the shapes that ``log`` takes.

    """

    def __init__(
        self,
        stream: Any,
        address: str = '',
        server: Server | None = None,
        *,
        file: RecordingFile | None = None,
    ) -> None:
        self.address = address
        self._file = file
        self.colouring = Colouring()
        self.origin_m: Array = np.zeros(3)
        self.rerun = import_rerun()
        self._stream = stream
        self._server = server
        has_sides = hasattr(self.rerun.components, 'MeshFaceRendering')  # not of old versions
        self._from_front: dict[str, Any] = {'face_rendering': 'Front'} if has_sides else {}
        stream.log('map', self.rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    @classmethod
    def to_file(cls, path: str | Path) -> Scene:
        """Write to an .rrd file; raises FileFormatError if that is not possible."""
        rerun = import_rerun()
        file = RecordingFile(path)
        stream = rerun.RecordingStream('surfel_mapper')
        stream.save(file.pipe)
        return cls(stream, file=file)

    @classmethod
    def to_window(cls, port: int | None = None) -> Scene:
        """Open a window, or use the one that is open at the port, by default that of rerun."""
        rerun = import_rerun()
        import rerun_bindings  # spawn of rerun itself takes no address

        port = port or PORT
        stream = rerun.RecordingStream('surfel_mapper')
        rerun_bindings.spawn(port=port, extra_args=['--bind', LOOPBACK])
        stream.connect_grpc(f'rerun+http://{LOOPBACK}:{port}/proxy')
        return cls(stream)

    @classmethod
    def to_browser(cls, port: int = 0, memory: str = WHOLE) -> Scene:
        """
        Serve a page for a browser, on loopback only, until the scene is closed.

        Parameters
        ----------
        port : int
            Port of the page, and one less than that of its data; 0: free ones.
        memory : str
            Of its server: WHOLE, or LIVE for a running node.

        Raises
        ------
        DependencyError
            If rerun is not installed.
        SurfelMapperError
            If the server does not start.

        """
        rerun = import_rerun()
        data_port = port + 1 if port else free_port()
        port = port or free_port()
        server = started_server(port, data_port, memory)
        stream = rerun.RecordingStream('surfel_mapper')
        stream.connect_grpc(f'rerun+http://{LOOPBACK}:{data_port}/proxy')
        source = f'rerun%2Bhttp%3A%2F%2F{LOOPBACK}%3A{data_port}%2Fproxy'
        return cls(stream, f'http://{LOOPBACK}:{port}/?url={source}', server)

    def __enter__(self) -> Scene:
        """Return the scene, which closes at the end of the block."""
        return self

    def __exit__(
        self, kind: object = None, error: BaseException | None = None, _: object = None
    ) -> None:
        """Send what is left and close; the page in a browser ends, a file gets its name."""
        with suppress(Exception):  # a window that was closed is no error
            self._stream.flush()
        with suppress(Exception):
            self._stream.disconnect()
        if self._server is not None:
            end_group(self._server)
        if self._file is not None:
            self._file.close(error)

    @property
    def is_watched(self) -> bool:
        """Whether a window or page shows things as they come, and no file is written."""
        return self._file is None

    def wait(self) -> None:
        """Return when the server of the page ends; at once if there is none."""
        if self._server is not None:
            self._server.wait()

    def has_ended(self) -> bool:
        """Return whether the server of the page has ended."""
        return self._server is not None and self._server.poll() is not None

    def flush(self) -> None:
        """Send everything logged so far; raises FileFormatError if a file cannot be written."""
        self._stream.flush()
        if self._file is not None:
            self._file.check()

    def set_stamp(self, stamp_ns: int) -> None:
        """Put what is logged from now on at a time of the time line ``stamp``."""
        self._stream.set_time('stamp', timestamp=np.datetime64(stamp_ns, 'ns'))

    def set_origin(self, origin_m: npt.ArrayLike) -> None:
        """State the place of the frame of the map in the fixed frame, (3,) m."""
        self.origin_m = np.asarray(origin_m, np.float64)
        if self.origin_m.any():
            about = self.rerun.AnyValues(origin_m=self.origin_m)
            self._stream.log('map', about, static=True)

    def look(
        self,
        low: Array,
        high: Array,
        target: Array,
        level: Array,
        hidden: Sequence[str] = (),
    ) -> None:
        """
        Look at a target from obliquely above, as far away as a box, (3,) m each, needs.

        Up is the third row of a rotation ``level``. Hidden paths are shown once their eye in the
        panel is clicked.
        """
        import rerun.blueprint as blueprint

        size_m = np.abs(level @ (high - low))
        across = 1 if size_m[0] > size_m[1] else 0
        back = np.array([0.0, 0.0, 0.55])
        back[across] = -0.75
        eye = target + level.T @ back * max(math.hypot(*size_m[:2]), 2.0) * 0.6
        controls = blueprint.EyeControls3D(position=eye, look_target=target, eye_up=level[2])
        name = 'map'
        if self.origin_m.any():
            name = 'map, m from ' + ' '.join(f'{value:.10g}' for value in self.origin_m)
        invisible = blueprint.EntityBehavior(visible=False)
        view = blueprint.Spatial3DView(
            origin='/map',
            name=name,
            eye_controls=controls,
            overrides=dict.fromkeys(hidden, invisible),
        )
        self._stream.send_blueprint(
            blueprint.Blueprint(
                view,
                blueprint.BlueprintPanel(state='collapsed'),
                blueprint.SelectionPanel(state='collapsed'),
                blueprint.TimePanel(state='expanded'),
            ),
            make_active=True,
            make_default=True,
        )

    def discs(self, path: str, discs: DrawnDiscs, *, static: bool = False) -> None:
        """Show discs in place of those that the path has had; none clears it."""
        if not len(discs):
            self.clear(path, static=static)
            return
        rerun, colours = self.rerun, self.colouring.of(discs)
        corners, triangles = discs.triangles()
        mesh = rerun.Mesh3D(
            vertex_positions=corners,
            triangle_indices=triangles,
            vertex_colors=np.repeat(colours, CORNERS, axis=0),
            **self._from_front,
        )
        self.log(f'{path}/discs', mesh, static=static)
        values = dict(discs.values)
        values.update(zip(NORMAL, discs.normal.T.astype(np.float32), strict=True))
        if self.origin_m.any():
            values.update(zip(FIXED, (discs.position + self.origin_m).T, strict=True))
        points = rerun.Points3D(discs.position, radii=PICKED, colors=colours)
        self.log(path, points, rerun.AnyValues(**values), static=static)

    def log(self, path: str, *shapes: Any, static: bool = False) -> None:
        """Show shapes, archetypes of rerun, in place of those that the path has had."""
        self._stream.log(path, *shapes, static=static)

    def clear(self, path: str, *, static: bool = False) -> None:
        """Show nothing at a path and below."""
        self.log(path, self.rerun.Clear(recursive=True), static=static)

    def mesh(self, path: str, mesh: Mesh, *, static: bool = False) -> None:
        """Show a mesh, in its colours or grey: rerun's white is lost on the light background."""
        if not len(mesh):
            self.clear(path, static=static)
            return
        shown = self.rerun.Mesh3D(
            vertex_positions=mesh.vertices.astype(np.float32),
            triangle_indices=mesh.triangles.astype(np.uint32),
            vertex_normals=vertex_normals(mesh),
            vertex_colors=mesh.colors if len(mesh.colors) else None,
            albedo_factor=None if len(mesh.colors) else GREY,
        )
        self.log(path, shown, static=static)

    def poses(self, path: str, stamp_ns: npt.NDArray[np.int64], xyz: Array, turns: Array) -> None:
        """Move a path along poses on the time line: positions (S, 3), quaternions (S, 4)."""
        rerun = self.rerun
        times = rerun.TimeColumn('stamp', timestamp=stamp_ns.astype('datetime64[ns]'))
        columns = rerun.Transform3D.columns(translation=xyz, quaternion=turns)
        self._stream.send_columns(path, indexes=[times], columns=columns)
