# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Inserter: the way of one scan through the pipeline, once its pose is there.

Prepare, reduce, insert, layers, derive: ``insert`` is that sequence, and every stage is a module
beside this one or a part below.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
import logging

import numpy as np
import numpy.typing as npt

from surfel_mapper.compilation import CompileStage
from surfel_mapper.config import Config
from surfel_mapper.counters import Laps
from surfel_mapper.errors import AlignmentError, MapError, PoseError
from surfel_mapper.geometry import compose, inverse, Transform
from surfel_mapper.layers import InsertedScan, Surroundings
from surfel_mapper.layers.sensor_models import SensorModels
from surfel_mapper.mapping.moments import (
    looks_like_millimetres,
    MILLIMETRES,
    pack_keys,
    ScanMoments,
)
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.mapping.window import SlidingWindow, WindowedScan
from surfel_mapper.memory import machine_bytes
from surfel_mapper.pipeline.drops import described, Drops
from surfel_mapper.pipeline.layer_stack import LayerStack
from surfel_mapper.pipeline.local_map import LocalMap
from surfel_mapper.pipeline.loop_closer import LoopCloser, LoopMove
from surfel_mapper.pipeline.map_origin import has_own_frame
from surfel_mapper.pipeline.preparation import Preparation
from surfel_mapper.pipeline.prepared import Prepared
from surfel_mapper.pipeline.reduction import moments_at, Reduction
from surfel_mapper.pipeline.reduction import warm_up_stages as reduction_stages
from surfel_mapper.pipeline.scan_images import ScanImages
from surfel_mapper.pipeline.scan_poses import ScanPoses
from surfel_mapper.pipeline.update import Update
from surfel_mapper.pipeline.window_aligner import Alignment, WindowAligner
from surfel_mapper.scan import Scan

_log = logging.getLogger(__name__)

NO_ROWS, NO_VOXELS = np.empty(0, np.int32), np.empty((0, 3), np.int32)


class Inserter:
    """
    Owns the map, its window and the layers, and inserts scans into them.

    Parameters
    ----------
    config : Config
        All settings; later ones are passed to each call.
    surfel_map : SurfelMap
        The map, empty.
    poses : ScanPoses
        The poses of the sensors.
    drops : Drops
        Counts the scans that are left out.

    Attributes
    ----------
    map, window, layers
        See Mapper.
    loops : LoopCloser or None
        Keeps the points of all scans, with ``loops.enabled``.
    preparation : Preparation
        The stages before reduction.
    images : ScanImages or None
        The images that scans are joined with, if a layer wants any.
    derives : bool
        Whether updates hold the surfels that changed; False leaves them empty and saves the time.

    """

    def __init__(
        self, config: Config, surfel_map: SurfelMap, poses: ScanPoses, drops: Drops
    ) -> None:
        self._drops = drops
        self.derives = True
        self._warned_of_units = False
        self.map = surfel_map
        self.window = SlidingWindow(self.map)
        self._set_limits(config)
        sensors = SensorModels.configured(config, poses.transforms, poses.mount)
        around = Surroundings(surfel_map=self.map, window=self.window, sensors=sensors)
        self.aligner = WindowAligner(lambda scan, pose: moments_at(scan, pose, self.map, config))
        self.loops = LoopCloser(config, self.map, self.window) if config.loops.enabled else None
        self._local_map: LocalMap | None = None
        self.layers = LayerStack(config, around, drops)
        wanted = self.layers.images
        self.images = ScanImages(wanted) if wanted.topics else None
        self.preparation = Preparation(
            config,
            poses,
            around,
            self.aligner,
            self.images,
            self.layers.needs_free_rays,
            drops,
        )
        if poses.registered is not None:
            self.register(config)
        self._reduction = Reduction(self.map, config.map.threads or 1)
        self._unreported: tuple[int, list[npt.NDArray[np.int32]]] | None = None

    def register(self, config: Config) -> None:
        """Keep the map that scans are registered to, if loops are closed."""
        if config.loops.enabled:
            self._local_map = LocalMap(config)
            if not self.map.num_voxels:  # else scans are registered to the map that was loaded
                self.preparation.local_map = self._local_map

    def reconfigure(self, config: Config) -> None:
        """Take new settings; if preparation refuses them, nothing has changed."""
        self.preparation.load_filters(config.filters)
        self.layers.reconfigure(config)
        self._set_limits(config)

    def _set_limits(self, config: Config) -> None:
        """Set the limits of the window."""
        self.window.config = config.window
        self.window.max_total_bytes = max(config.map.max_bytes, 0)
        if config.map.max_bytes < 0 and self.window.keeps_scans:
            self.window.max_total_bytes = machine_bytes() // 2

    def clear(self) -> None:
        """Empty map, window and layers."""
        self.window.clear()
        self.aligner.reset()
        self.layers.clear()
        for kept in (self.loops, self._local_map):
            if kept is not None:
                kept.clear()
        self.preparation.local_map = self._local_map

    def restore(self, moments: ScanMoments, scans: list[WindowedScan]) -> None:
        """Replace map and window by saved ones, which scans are registered to until cleared."""
        self.clear()
        self.map.insert(moments)
        self.window.restore(scans)
        self.preparation.local_map = None
        if self.loops is not None:
            self._drops.warn(
                'loops',
                'a map was loaded: loops are closed only among the scans that come after it',
            )

    def drop_voxels(
        self, voxel_index: npt.NDArray[np.int32], min_points: int
    ) -> npt.NDArray[np.int32]:
        """Empty voxels for good, in all scans; see SlidingWindow.drop_voxels."""
        fallen = self.window.drop_voxels(voxel_index, min_points)
        if self.loops is not None:
            self.loops.drop_voxels(pack_keys(voxel_index))
        return fallen

    def close_loops(self, config: Config, progress: Callable[[str], object]) -> LoopMove:
        """Find the loops and move the scans; see Mapper.close_loops."""
        if self.loops is None:
            raise AlignmentError('no points are kept to close loops with: set loops.enabled')
        with self._drops.counters.timed('loops'):
            move = self.loops.close(config, progress)
        self.aligner.correct(move.correction)
        return move

    def align(self, config: Config) -> Alignment:
        """Move the scans of the window to poses at which they agree; see Mapper.align."""
        with self._drops.counters.timed('align'):
            alignment = self.aligner.align(self.window, config)
        if self.loops is not None:
            self.loops.follow_window()
        return alignment

    def warm_up_stages(self, config: Config) -> list[CompileStage]:
        """Return the stages that compile kernels; see Mapper.warm_up_stages."""
        return [
            *reduction_stages(config),
            *self.preparation.warm_up_stages(config),
            *self.layers.warm_up_stages(),
        ]

    def runs_ahead(self, config: Config) -> bool:
        """Return whether another thread prepares the next scan while one is inserted."""
        can_run_ahead = config.map.mode != 'frozen' and self.preparation.runs_ahead()
        return can_run_ahead and self._reduction.runs_ahead

    def begin(self, scan: Scan, pose: Transform, config: Config) -> None:
        """
        Begin to prepare and reduce a scan that is inserted soon, in another thread.

        Without the poses of its sweep nothing is begun; ``insert`` counts the scan then.
        """
        place = self.aligner.to_map(pose)
        with suppress(PoseError):
            self._reduction.begin(scan, place, config, self.preparation.ahead)

    def insert(
        self,
        scan: Scan,
        pose: Transform,
        config: Config,
        following: tuple[Scan, Transform] | None = None,
    ) -> Iterator[Update]:
        """
        Map a scan, and those before it that waited for it; yield the update of each.

        Parameters
        ----------
        scan : Scan
            As it came in.
        pose : (4, 4) float64
            T_fixed_sensor.
        config : Config
            All settings.
        following : Scan and pose, optional
            The next scan, which another thread begins to prepare; only if it prepares any ahead.

        """
        laps = Laps()
        T_map_fixed, place = self.aligner.T_map_fixed, self.aligner.to_map(pose)
        begun = self._reduction.begun(scan, place, config)
        found = self.preparation.prepare(scan, place, config, laps, begun)
        if not found and len(laps.milliseconds) > 1:
            self._drops.counters.add_times(laps.milliseconds)
        for prepared in found:
            num_used = self._num_used
            try:
                corrected = self._corrected(prepared, T_map_fixed)
                update = self._insert(corrected, config, following, laps)
            except Exception as error:  # MemoryError too: the next scan may fit
                self._drops.failure(prepared.scan, error, is_used=self._num_used > num_used)
                update = None
            if update is not None:
                yield update
            laps = Laps()

    def _corrected(self, prepared: Prepared, T_map_fixed: Transform) -> Prepared:
        """Return a scan corrected by the alignments since its pose, those of scans before it."""
        if self.aligner.T_map_fixed is T_map_fixed:
            return prepared
        T_fixed_sensor = compose(inverse(T_map_fixed), prepared.T_map_sensor)
        return replace(prepared, T_map_sensor=self.aligner.to_map(T_fixed_sensor))

    @property
    def _num_used(self) -> int:
        """Number of scans so far that were mapped, or aligned to a frozen map."""
        return self._drops.counters.mapped + self._drops.counters.localised

    def _insert(
        self,
        prepared: Prepared,
        config: Config,
        following: tuple[Scan, Transform] | None,
        laps: Laps,
    ) -> Update | None:
        """Insert a prepared scan; None if the map refuses it."""
        if config.map.mode == 'frozen':
            return self._localised(prepared, config, laps)
        version = self.map.version
        added = self._add_to_map(prepared, following, config, laps)
        if added is None:
            return None
        inserted, windowed = added
        self._count(inserted)
        version, removed = self._to_report(version, inserted)
        self._keep(prepared.filtered, windowed, config)
        laps.end('insert')
        cleared = self.layers.voxels_to_clear(inserted, laps)
        if len(cleared):
            inserted = replace(inserted, cleared=cleared)
            removed.append(self.drop_voxels(cleared, config.map.min_points))
        alignment = self._align_when_due(config)
        if alignment is not None:
            inserted = inserted.at(alignment.T_map_sensor[-1])
            laps.end('align')
        results = self.layers.follow(inserted, laps)
        changed = self._changed_since(version, config)
        self._unreported = None
        laps.end('normals')
        milliseconds = laps.milliseconds
        self._drops.counters.add_times(milliseconds)
        return Update(
            scan=prepared.scan,
            filtered=prepared.filtered,
            stamp_ns=prepared.scan.stamp_ns,
            frame_id=map_frame(config),
            T_map_sensor=inserted.T_map_sensor,
            num_points=inserted.num_points,
            changed=changed,
            removed_voxel_index=removed_voxels(removed, alignment, changed),
            evictions=inserted.evictions,
            milliseconds=milliseconds,
            layers=results,
            alignment=alignment,
            registration=prepared.registration,
            T_fixed_body=prepared.T_fixed_body,
        )

    def _add_to_map(
        self,
        prepared: Prepared,
        following: tuple[Scan, Transform] | None,
        config: Config,
        laps: Laps,
    ) -> tuple[InsertedScan, WindowedScan] | None:
        """Reduce a scan and insert it into the window; None if the map refuses it."""
        scan, pose = prepared.filtered, prepared.T_map_sensor
        try:
            windowed = self._reduction.reduce(scan, pose, config)
            if following is not None:
                self.begin(*following, config)
            laps.end('reduce')
            left_out = windowed.moments.left_out
            self._drops.counters.points_left_out.update(left_out)
            if not len(windowed.moments):
                cause = 'map_limit' if 'beyond_map' in left_out else 'no_valid_points'
                self._drops.scan(scan, cause, f'left out: {left_out}')
                return None
            if not self._warned_of_units and looks_like_millimetres(windowed.moments):
                self._warned_of_units = True
                _log.warning('scan in frame %s: %s', scan.frame_id, MILLIMETRES)
            evictions = self.window.insert(windowed, config.map.min_points)
        except MapError as error:
            self._drops.scan(scan, 'map_limit', str(error))
            return None
        inserted = InsertedScan(
            scan=scan,
            T_map_sensor=pose,
            keys=windowed.moments.key,
            num_points=windowed.moments.num_points,
            evictions=tuple(evictions),
        )
        return inserted, windowed

    def _keep(self, scan: Scan, windowed: WindowedScan, config: Config) -> None:
        """Keep a mapped scan for registration and for loops; without it loops are not closed."""
        pose = windowed.T_map_sensor
        if self.loops is not None:
            try:
                self.loops.add(scan, pose, config)
            except Exception as error:  # the disk is full, or out of memory
                self._drops.warn('loops', f'{described(error)}; loops are not closed')
                self.loops.clear()
                self.loops = None
        local_map = self.preparation.local_map
        if local_map is not None:  # last: it may refuse the scan, which loops must have
            local_map.add(scan, windowed, self.aligner.to_fixed(pose), config)

    def _localised(self, prepared: Prepared, config: Config, laps: Laps) -> Update:
        """Return the pose of a scan in a frozen map, which takes no scan."""
        milliseconds = laps.milliseconds
        self._drops.counters.localised += 1
        self._drops.counters.add_times(milliseconds)
        return Update(
            scan=prepared.scan,
            filtered=prepared.filtered,
            stamp_ns=prepared.scan.stamp_ns,
            frame_id=map_frame(config),
            T_map_sensor=prepared.T_map_sensor,
            num_points=0,
            changed=self.map.surfels_of(NO_ROWS),
            removed_voxel_index=np.empty((0, 3), np.int32),
            evictions=(),
            milliseconds=milliseconds,
            registration=prepared.registration,
            T_fixed_body=prepared.T_fixed_body,
        )

    def _align_when_due(self, config: Config) -> Alignment | None:
        """Align the window every ``align.every_scans`` scans; warn if that fails."""
        if not self.aligner.is_due(config.align.every_scans) or len(self.window) < 2:
            return None
        try:
            alignment = self.aligner.align(self.window, config)
            if self.loops is not None:
                self.loops.follow_window()
        except (AlignmentError, MapError, MemoryError) as error:
            self._drops.warn('alignment', f'the window is not aligned: {described(error)}')
            return None
        _log.debug('aligned: %s', alignment)
        return alignment

    def _to_report(
        self, version: int, inserted: InsertedScan
    ) -> tuple[int, list[npt.NDArray[np.int32]]]:
        """
        Return the version after which changes are to be reported, and the voxels that left.

        With those of scans before it whose updates failed, as of this one if its update fails.
        """
        removed = [NO_VOXELS, *(eviction.fallen for eviction in inserted.evictions)]
        if self._unreported is not None:
            version = self._unreported[0]
            removed += self._unreported[1]
        self._unreported = version, removed
        return self._unreported

    def _changed_since(self, version: int, config: Config) -> Surfels:
        """Return the surfels of the voxels that changed after a version of the map."""
        if not self.derives:
            return self.map.surfels_of(NO_ROWS)
        return self.map.surfels_changed(version, config.map.min_points)

    def _count(self, inserted: InsertedScan) -> None:
        """Count a scan that was mapped, and the scans that left."""
        counters = self._drops.counters
        counters.mapped += 1
        counters.points += inserted.num_points
        counters.evicted.update(eviction.limit for eviction in inserted.evictions)


def map_frame(config: Config) -> str:
    """Return the frame of the map: that of the poses, unless it is given its own; see Mapper."""
    fixed = config.frames.fixed
    return config.align.map_frame or (f'{fixed}_local' if has_own_frame(config) else fixed)


def removed_voxels(
    removed: Sequence[npt.NDArray[np.int32]],
    alignment: Alignment | None,
    changed: Surfels,
) -> npt.NDArray[np.int32]:
    """Return the voxels (K, 3) that were surfels before the scan and are none after it."""
    if alignment is None:
        return np.concatenate(removed)
    gone = np.unique(np.concatenate([*removed, alignment.removed_voxel_index]), axis=0)
    left: npt.NDArray[np.int32] = gone[~np.isin(pack_keys(gone), pack_keys(changed.voxel_index))]
    return left
