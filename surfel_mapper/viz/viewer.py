# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Viewer: shows the map of a mapper in rerun while it grows.

Every scan logs the sensor with its points, the changed surfels, and the positions of the scans in
the window. The whole map is logged when a quarter of it has changed since the last time, so a
recording holds each surfel about five times instead of once a scan.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.geometry import quaternions
from surfel_mapper.layers.drawings import Drawing, MeshDrawing, RingsDrawing
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.viz.discs import Colouring, DrawnDiscs
from surfel_mapper.viz.framing import levelled
from surfel_mapper.viz.scene import (
    AROUND_M,
    ORANGE,
    POINT_RADIUS_M,
    RED,
    Scene,
    SENSOR_RADIUS,
)

if TYPE_CHECKING:
    from surfel_mapper.pipeline import Mapper, Update

NEW = 0.25
"""Share of the map that has to change before the whole map is logged again."""

MAX_POINTS = 20_000
"""Limit of the points logged of a scan; larger scans are subsampled."""


class Viewer:
    """
    Shows a mapper at work; a context manager.

    Parameters
    ----------
    mapper : Mapper
        The mapper of the replay.
    scene : Scene, str or Path, optional
        Where it is shown; a path is an .rrd file to write; by default a window opens.
    colouring : str
        Colours of the surfels, one of discs.COLOURINGS.

    Raises
    ------
    DependencyError
        If rerun is not installed.
    FileFormatError
        If the file cannot be written.

    """

    def __init__(
        self, mapper: Mapper, scene: Scene | str | Path | None = None, colouring: str = 'normal'
    ) -> None:
        self._mapper = mapper
        self._colouring = colouring
        self._positions: list[npt.NDArray[np.float64]] = []
        self._shown_voxels = self._removed = 0
        self._last: Update | None = None
        self._is_placed = False
        self._cut = mapper.map.adaptive_cut(mapper.config.map.min_points)
        if scene is None:
            scene = Scene.to_window()
        self._scene = scene if isinstance(scene, Scene) else Scene.to_file(scene)

    def __enter__(self) -> Viewer:
        """Return the viewer, which closes at the end of the block."""
        return self

    def __exit__(self, kind: object, error: BaseException | None, _: object) -> None:
        """Log the final map and close; a file that is incomplete is removed."""
        try:
            if kind is None:
                self.finish()
        except BaseException as failed:
            error = failed
            raise
        finally:
            self._scene.__exit__(None, error)

    def finish(self) -> None:
        """Show the whole map once more."""
        if self._last is not None:
            self._show(self._last, whole=True)
        self._scene.flush()

    def add(self, update: Update) -> None:
        """Show a scan and its changes of the map; all surfels if a quarter has changed."""
        self._positions.append(update.T_map_sensor[:3, 3])
        self._last = update
        num_voxels = self._mapper.map.num_voxels
        self._removed += len(update.removed_voxel_index)
        change = abs(num_voxels - self._shown_voxels) + self._removed
        self._show(update, whole=change > NEW * num_voxels)

    def _show(self, update: Update, *, whole: bool) -> None:
        """Show a scan, its changes of the map, and the whole map if it is due."""
        scene, rerun = self._scene, self._scene.rerun
        position = update.T_map_sensor[:3, 3]
        if not self._is_placed:
            self._is_placed = True
            scene.set_origin(self._mapper.map.origin_m)
            level = levelled(self._discs(update.changed))
            scene.look(position - AROUND_M, position + AROUND_M, position, level)
        scene.set_stamp(update.stamp_ns)
        pose = rerun.Transform3D(translation=position, mat3x3=update.T_map_sensor[:3, :3])
        scene.log('map/sensor', pose)
        scan = rerun.Points3D(picked(update.scan.points), radii=POINT_RADIUS_M)
        scene.log('map/sensor/scan', scan)
        scene.log('map/trajectory', rerun.LineStrips3D([self._way()], colors=[RED]))
        window = np.array([scan.T_map_sensor[:3, 3] for scan in self._mapper.window])
        poses = rerun.Points3D(window.reshape(-1, 3), radii=SENSOR_RADIUS, colors=[ORANGE])
        scene.log('map/window', poses)
        if whole:
            self._show_map()
        scene.discs('map/changed', self._discs(update.changed))

    def _show_map(self) -> None:
        """Show all surfels, and the shapes of the layers."""
        self._shown_voxels, self._removed = self._mapper.map.num_voxels, 0
        surfels = self._discs(self._surfels())
        self._scene.colouring = Colouring.over(self._colouring, [surfels])
        self._scene.discs('map/surfels', surfels)
        layers = self._mapper.layers.values()
        drawings = [drawing for layer in layers for drawing in layer.drawings()]
        for group in {drawing.name.partition('/')[0] for drawing in drawings}:
            self._scene.clear(f'map/{group}')
        for drawing in drawings:
            self._log_drawing(f'map/{drawing.name}', drawing)

    def _way(self) -> npt.NDArray[np.float64]:
        """Return the trajectory of the sensor, at most a thousand positions and the last."""
        step = max(len(self._positions) // 1000, 1)
        return np.array([*self._positions[::step], self._positions[-1]])

    def _log_drawing(self, name: str, drawing: Drawing) -> None:
        """Log the shapes of a layer."""
        if isinstance(drawing, MeshDrawing):
            self._scene.mesh(name, drawing.mesh)
        elif isinstance(drawing, RingsDrawing):
            lines = [np.concatenate([ring, ring[:1]]) for ring in drawing.rings]
            texts = {'labels': list(drawing.labels), 'show_labels': False}
            rings = self._scene.rerun.LineStrips3D(lines, colors=drawing.colors, **texts)
            self._scene.log(name, rings)
        else:
            ellipsoids = self._scene.rerun.Ellipsoids3D(
                centers=drawing.centers,
                half_sizes=drawing.half_sizes_m,
                quaternions=quaternions(drawing.R_map_axes),
                colors=[drawing.color] * len(drawing.centers),
                fill_mode='solid',
            )
            self._scene.log(name, ellipsoids)

    def _surfels(self) -> Surfels:
        """Return the adaptive surfels; those of voxels if ages are shown, which voxels have."""
        if self._colouring == 'age':
            return self._mapper.map.surfels(self._mapper.config.map.min_points)
        self._cut.refresh()
        return self._cut.surfels()

    def _discs(self, surfels: Surfels) -> DrawnDiscs:
        """Return surfels as discs; with their ages if these are shown."""
        scans = list(self._mapper.window) if self._colouring == 'age' else []
        return DrawnDiscs.of(surfels, scans)


def picked(points: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the finite points, subsampled to at most MAX_POINTS."""
    finite = points[np.isfinite(points).all(axis=1)]
    return np.ascontiguousarray(finite[:: max(-(-len(finite) // MAX_POINTS), 1)])
