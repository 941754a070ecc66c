# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Inserter: one scan with its pose, all the way into the map, the window and the layers.

Prepared, reduced to moments, added; then what its coming changes: scans that leave, what has moved
away, the alignment of the window, the TSDF.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.counters import Counters, Laps
from surfel_mapper.errors import AlignmentError, CloudFormatError, MapError
from surfel_mapper.geometry import Transform
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.mapping.window import Eviction, SlidingWindow, WindowedScan
from surfel_mapper.pipeline.drops import Drops
from surfel_mapper.pipeline.look_ahead import LookAhead
from surfel_mapper.pipeline.moved_away import MovedAway
from surfel_mapper.pipeline.preparation import Preparation, Prepared
from surfel_mapper.pipeline.reduction import moments_at
from surfel_mapper.pipeline.reduction import warm_up as warm_up_reduction
from surfel_mapper.pipeline.scan_poses import ScanPoses
from surfel_mapper.pipeline.sensor_models import SensorModels
from surfel_mapper.pipeline.tsdf_layer import TsdfLayer
from surfel_mapper.pipeline.update import removed_voxels, Update
from surfel_mapper.pipeline.window_aligner import Alignment, WindowAligner
from surfel_mapper.scan import Scan

if TYPE_CHECKING:
    from surfel_mapper.pipeline.models_layer import ModelsLayer

_log = logging.getLogger(__name__)


class Inserter:
    """
    Owns the map and its window, and puts scans into them.

    Parameters
    ----------
    config : Config
        All settings; may be replaced by ``reconfigure``.
    poses : ScanPoses
        Of the sensors.
    counters : Counters
        What was done.
    drops : Drops
        What was not.

    Attributes
    ----------
    map, window, tsdf
        See Mapper.
    preparation : Preparation
        What is done to scans before.
    derives : bool
        Whether updates hold the surfels that changed; they are none where nobody looks at them.

    """

    def __init__(self, config: Config, poses: ScanPoses, counters: Counters, drops: Drops) -> None:
        """Make an empty map with the settings of a configuration."""
        self._config = config
        self._poses = poses
        self._counters = counters
        self._drops = drops
        self.derives = True
        self.map = SurfelMap(
            config.map.voxel_size_m, columns=config.map.columns, threads=config.map.threads
        )
        self.window = SlidingWindow(self.map, config.window, max_voxels=config.map.max_voxels)
        self.aligner = WindowAligner(
            lambda scan, pose: moments_at(scan, pose, self.map, self._config)
        )
        self.preparation = Preparation(
            config, poses, self.map, self.window, self.aligner, counters, drops
        )
        self._ahead = LookAhead(self.map, config.map.threads)
        sensors = SensorModels(config.tsdf)
        self.tsdf = TsdfLayer(config.tsdf, sensors) if config.tsdf.enabled else None
        self.models: ModelsLayer | None = None
        if config.models.enabled:
            from surfel_mapper.pipeline.models_layer import ModelsLayer  # 0.1 s to load

            self.models = ModelsLayer(config.models, self.map)
        self._moved: MovedAway | None = None
        if config.dynamic.clear:
            self._moved = MovedAway(config.dynamic, self.map.voxel_size_m, sensors)

    @property
    def map_frame(self) -> str:
        """The frame of the map: that of the poses, unless alignment gives it its own."""
        return self._config.align.map_frame or self._config.frames.fixed

    def reconfigure(self, config: Config) -> None:
        """Take new settings; where preparation refuses them, nothing has changed."""
        self.preparation.reconfigure(config)
        self._config = config
        self.window.config = config.window
        self.window.max_voxels = config.map.max_voxels

    def clear(self) -> None:
        """Empty map, window and layers."""
        self.window.clear()
        self.aligner.reset()
        if self.tsdf is not None:
            self.tsdf.clear()
        if self.models is not None:
            self.models.clear()
        if self._moved is not None:
            self._moved.clear()

    def align(self) -> Alignment:
        """Move the scans of the window to where they agree; see Mapper.align."""
        with self._counters.timed('align'):
            return self.aligner.align(self.window, self._config)

    def warm_up(self) -> None:
        """Compile every kernel that mapping needs, for all types that scans may have."""
        self.preparation.warm_up()
        if self._config.window.keep_points:
            self.aligner.warm_up()
        warm_up_reduction(self._config)
        if self.tsdf is not None:
            self.tsdf.warm_up()
        if self.models is not None:
            self.models.models.warm_up()
        if self._moved is not None:
            self._moved.warm_up()

    @property
    def looks_ahead(self) -> bool:
        """Whether a scan is reduced by another thread while the one before is inserted."""
        is_frozen = self._config.map.mode == 'frozen'
        return self._ahead.is_possible and self.preparation.is_trivial and not is_frozen

    def begin(self, scan: Scan, pose: Transform) -> None:
        """Have another thread reduce the scan that will be inserted next."""
        self._ahead.begin(scan, self.aligner.to_map(pose), self._config)

    def insert(
        self, scan: Scan, pose: Transform, following: tuple[Scan, Transform] | None = None
    ) -> Update | None:
        """
        Map a scan; None where it is left out.

        Parameters
        ----------
        scan : Scan
            As it came in.
        pose : (4, 4) float64
            T_map_sensor.
        following : Scan and pose, optional
            Of the next one, which another thread begins with; only where ``looks_ahead``.

        """
        laps, version = Laps(), self.map.version
        prepared = self.preparation.prepare(scan, self.aligner.to_map(pose), laps)
        if prepared is None:
            return None
        if self._config.map.mode == 'frozen':
            return self._only_posed(prepared, laps)
        scan, filtered, pose = prepared.scan, prepared.filtered, prepared.T_map_sensor
        try:
            windowed = self._ahead.reduced(filtered, pose, self._config)
            if following is not None:
                self.begin(*following)
            laps.end('reduce')
            self._counters.points_left_out.update(windowed.moments.left_out)
            if not len(windowed.moments):
                self._drops.scan(scan, 'no_valid_points', f'left out: {windowed.moments.left_out}')
                return None
            evictions = self.window.insert(windowed, self._config.map.min_points)
        except MapError as error:
            self._drops.scan(scan, 'map_limit', str(error))
            return None
        laps.end('insert')
        cleared = self._clear_moved(filtered, pose, windowed.moments.key)
        if self._moved is not None:
            laps.end('clear')
        alignment = self._align_when_due()
        if alignment is not None:
            pose = alignment.T_map_sensor[-1]
            laps.end('align')
        changed = self._changed_since(version)
        laps.end('normals')
        if self.tsdf is not None:
            self._follow(self.tsdf, filtered, pose, evictions)
            laps.end('tsdf')
        models = self.models.follow(scan.stamp_ns) if self.models else None
        if models is not None:
            laps.end('models')
        self._count(windowed, evictions, laps)
        return Update(
            scan=scan,
            stamp_ns=scan.stamp_ns,
            frame_id=self.map_frame,
            T_map_sensor=pose,
            num_points=windowed.moments.num_points,
            changed=changed,
            removed_voxel_index=removed_voxels(evictions, cleared, alignment, changed),
            evictions=tuple(evictions),
            milliseconds=laps.milliseconds,
            models=models,
            alignment=alignment,
            registration=prepared.registration,
        )

    def _only_posed(self, prepared: Prepared, laps: Laps) -> Update:
        """Say where a scan was taken; a frozen map takes none."""
        self._counters.localised += 1
        for stage, milliseconds in laps.milliseconds.items():
            self._counters.add_time(stage, milliseconds)
        return Update(
            scan=prepared.scan,
            stamp_ns=prepared.scan.stamp_ns,
            frame_id=self.map_frame,
            T_map_sensor=prepared.T_map_sensor,
            num_points=0,
            changed=self.map.surfels_changed(self.map.version),
            removed_voxel_index=np.empty((0, 3), np.int32),
            evictions=(),
            milliseconds=laps.milliseconds,
            registration=prepared.registration,
        )

    def _clear_moved(
        self,
        scan: Scan,
        pose: Transform,
        hit: npt.NDArray[np.int64],
    ) -> npt.NDArray[np.int32]:
        """Empty the voxels that scans see through by now; return the surfels that are gone."""
        if self._moved is None:
            return np.empty((0, 3), np.int32)
        try:
            empty = self._moved.look(scan, pose, self.map.keys(), hit)
        except CloudFormatError as error:
            self._drops.message('dynamic', f'scan at {scan.stamp_ns / 1e9:.6f} s: {error}')
            return np.empty((0, 3), np.int32)
        self._counters.cleared_voxels += len(empty)
        return self.window.drop_voxels(empty, self._config.map.min_points)

    def _align_when_due(self) -> Alignment | None:
        """Align the window if so many scans were mapped since; warn where that fails."""
        if not self.aligner.is_due(self._config.align.every_scans) or len(self.window) < 2:
            return None
        try:
            alignment = self.aligner.align(self.window, self._config)
        except (AlignmentError, MapError) as error:
            self._drops.warn('alignment', f'the window is not aligned: {error}')
            return None
        _log.debug('aligned: %s', alignment)
        return alignment

    def _follow(
        self,
        layer: TsdfLayer,
        scan: Scan,
        pose: Transform,
        evictions: list[Eviction],
    ) -> None:
        """Give a scan to a layer; warn where the layer cannot take it."""
        try:
            layer.follow(scan, pose, evictions)
        except (CloudFormatError, MapError) as error:
            self._drops.message('tsdf', f'scan at {scan.stamp_ns / 1e9:.6f} s: {error}')

    def _changed_since(self, version: int) -> Surfels:
        """Return the surfels of the voxels that changed after a version of the map."""
        if not self.derives:
            return self.map.surfels_changed(self.map.version)
        return self.map.surfels_changed(version, self._config.map.min_points)

    def _count(self, scan: WindowedScan, evictions: list[Eviction], laps: Laps) -> None:
        self._counters.mapped += 1
        self._counters.points += scan.moments.num_points
        self._counters.evicted.update(eviction.limit for eviction in evictions)
        for stage, milliseconds in laps.milliseconds.items():
            self._counters.add_time(stage, milliseconds)
