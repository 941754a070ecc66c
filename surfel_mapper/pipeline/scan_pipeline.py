# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
ScanPipeline: the way of a scan from its stamp to its update; ``run`` is that sequence.

Every stage is a module beside this one or a part below. All stages run in the thread that calls
``run``, one scan after the other.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
import logging
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.compilation import CompileStage
from surfel_mapper.config import Config
from surfel_mapper.counters import Counters, Laps
from surfel_mapper.errors import (
    AlignmentError,
    CloudFormatError,
    MapError,
    ScanRefusedError,
)
from surfel_mapper.geometry import compose, inverse, Transform
from surfel_mapper.layers import InsertedScan, Surroundings
from surfel_mapper.layers.sensor_models import SensorModels
from surfel_mapper.mapping.channels import missing_columns
from surfel_mapper.mapping.moments import (
    looks_like_other_unit,
    OTHER_UNIT,
    pack_keys,
    ScanMoments,
)
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.mapping.window import SlidingWindow, WindowedScan
from surfel_mapper.memory import machine_bytes
from surfel_mapper.messages.poses import StampedPose
from surfel_mapper.pipeline.drops import described, Drops, ScanOutcome
from surfel_mapper.pipeline.layer_stack import LayerStack
from surfel_mapper.pipeline.local_map import LocalMap
from surfel_mapper.pipeline.loop_closer import LoopCloser, LoopMove
from surfel_mapper.pipeline.map_origin import has_own_frame, MapOrigin
from surfel_mapper.pipeline.mapping_stages import warm_up_stages as map_stages
from surfel_mapper.pipeline.preparation import moments_at, Preparation, reduced
from surfel_mapper.pipeline.prepared import Prepared
from surfel_mapper.pipeline.scan_images import ScanImages
from surfel_mapper.pipeline.scan_poses import ScanPoses, ScanQueue
from surfel_mapper.pipeline.stamp_guard import Judged, Order, StampGuard
from surfel_mapper.pipeline.update import Update
from surfel_mapper.pipeline.window_aligner import Alignment, WindowAligner
from surfel_mapper.scan import Scan
from surfel_mapper.sensors.deskew import point_times

_log = logging.getLogger(__name__)

NO_ROWS, NO_VOXELS = np.empty(0, np.int32), np.empty((0, 3), np.int32)


class ScanPipeline:
    """
    Owns the map, its window and the layers, and takes scans into them.

    Parameters
    ----------
    config : Config
        All settings.

    Attributes
    ----------
    config, map, window, layers, counters
        See Mapper.
    arrived : deque of Scan
        Scans in order of arrival, whose stamps are not judged yet.
    loops : LoopCloser or None
        Keeps the points of all scans, with ``loops.enabled``.
    derives : bool
        Whether updates hold the surfels that changed; False leaves them empty and saves the time.

    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self.counters = Counters()
        self.drops = Drops(self.counters, config.pose.source)
        self.derives = True
        self.map = SurfelMap(config.map.voxel_size_m, columns=config.map.columns)
        self.window = SlidingWindow(self.map)
        self._set_limits()
        self.origin = MapOrigin(config, self.map)
        self.poses = ScanPoses(config, self.drops, self.origin)
        self.guard = StampGuard(config.input.reset_after_s, self.poses.transforms)
        sensors = SensorModels.configured(config, self.poses.transforms, self.poses.mount)
        around = Surroundings(surfel_map=self.map, window=self.window, sensors=sensors)
        self.aligner = WindowAligner(lambda scan, pose: moments_at(scan, pose, self.map, config))
        self.loops = LoopCloser(config, self.map, self.window) if config.loops.enabled else None
        self.layers = LayerStack(config, around, self.drops)
        wanted = self.layers.images
        self.images = ScanImages(wanted) if wanted.topics else None
        self.queue = ScanQueue(config.pose.max_waiting_scans, self.poses, self.images, self.drops)
        self.preparation = Preparation(
            config,
            self.poses,
            around,
            self.aligner,
            self.images,
            self.layers.needs_free_rays,
            self.drops,
        )
        self._local_map: LocalMap | None = None
        if self.poses.registered is not None:
            self._keep_local_map()
        fixed = config.frames.fixed
        own_frame = f'{fixed}_local' if has_own_frame(config) else fixed
        self.map_frame = config.align.map_frame or own_frame
        self.arrived: deque[Scan] = deque()
        self._unreported: tuple[int, list[npt.NDArray[np.int32]]] | None = None
        self._checks_units = True

    def run(self) -> Iterator[Update]:
        """Take the scans that arrived through all stages; yield an update of each mapped."""
        while self.arrived:  # each is used, held until the next message, or dropped
            self._settle(self.guard.judge(self.arrived.popleft()))
        for laps, T_map_fixed, ready in self._ready():
            for prepared in ready:
                inserted, update, alignment, results = None, None, None, dict[str, Any]()
                try:
                    if self.config.map.mode != 'frozen':  # which takes no scan
                        if self.aligner.T_map_fixed is not T_map_fixed:
                            prepared = self._corrected(prepared, T_map_fixed)
                        windowed = self._reduced(prepared, laps)
                        inserted = self._inserted(prepared, windowed)  # old scans are evicted
                        if self.loops is not None or self.preparation.local_map is not None:
                            self._keep(prepared.filtered, windowed)
                        laps.end('insert')
                        if self.layers.clearing:
                            inserted = self._cleared(inserted, laps)
                        if self.config.align.every_scans:
                            inserted, alignment = self._aligned(inserted, laps)
                        if self.layers.following:
                            results = self.layers.follow(inserted, laps)
                    update = self._recorded(prepared, inserted, alignment, results, laps)
                except Exception as error:  # MemoryError too: the next scan may fit
                    has_scan, times = inserted is not None, laps.milliseconds
                    self.drops.failure(prepared.scan, error, times, is_mapped=has_scan)
                if update is not None:
                    yield update
                laps = Laps()

    def _ready(self) -> Iterator[tuple[Laps, Transform, Sequence[Prepared]]]:
        """Yield scans deskewed, filtered and registered, with their times and T_map_fixed."""
        while posed := self.queue.next_posed(self.guard.newest_of, self.config.pose):
            laps = Laps()
            yield laps, self.aligner.T_map_fixed, self._prepared(*posed, laps)
        registered, aligner = self.poses.registered, self.aligner
        while registered and (joined := registered.rejoin(self.map, aligner.T_map_fixed)):
            joined = [replace(p, T_map_sensor=aligner.to_map(p.T_map_sensor)) for p in joined]
            yield Laps(), aligner.T_map_fixed, joined

    def add_scan(self, scan: Scan) -> None:
        """Take a scan that can be mapped; ``run`` judges its stamp."""
        self.queue.ended, clocks = False, self.config.input
        if not scan.frame_id:
            self.drops.scan(scan, 'empty_frame_id', 'its header has no frame_id')
        elif len(scan) == 0:
            self.drops.scan(scan, 'no_points', 'it has no points')
        elif self.map.columns and (missing := self._missing_columns(scan)):
            present = ', '.join(scan.columns) or 'none'
            reason = f'its points have no {" and no ".join(missing)} among {present}'
            self.drops.scan(scan, 'missing_column', reason)
        elif self.config.deskew.enabled or clocks.time_offset_s or clocks.time_offsets_s:
            self._add_timed(scan)
        else:
            self.arrived.append(scan)
        if len(self.arrived) + len(self.queue.waiting) > self.queue.max_scans:
            self.judge_stamps()  # no more scans may wait

    def judge_stamps(self) -> None:
        """Use the scans that arrived, hold one until the next message, or drop them."""
        while self.arrived:
            self._settle(self.guard.judge(self.arrived.popleft()))

    def add_pose(self, pose: StampedPose, *, static: bool) -> None:
        """Use a pose, hold it until the next message, or ignore it, by its stamp."""
        self.judge_stamps()  # of the scans that came before it
        if static:
            self.poses.add(*pose, static=True)
        else:
            self._settle(self.guard.judge(pose))

    def _missing_columns(self, scan: Scan) -> list[str]:
        """Return the columns that the map sums and a scan has not, nor gets from images."""
        missing = missing_columns(scan.columns, self.map.columns)
        images = self.images
        return [name for name in missing if images is None or not images.will_give(scan, name)]

    def _add_timed(self, scan: Scan) -> None:
        """Take a scan by the clock of the poses, with the times that deskewing needs."""
        deskew, offset_s = self.config.deskew, self.config.input.offset_s(scan.topic)
        if deskew.enabled:
            try:
                times = point_times(scan, deskew.field, deskew.unit, deskew.reference)
            except CloudFormatError as error:
                self.drops.scan(scan, 'no_times', str(error))
                return
            scan = scan.with_times(times)
        self.arrived.append(scan.moved_in_time(round(1e9 * offset_s)))

    def _settle(self, judged: Sequence[Judged]) -> None:
        """Queue scans and enter poses whose stamps were judged, or drop them."""
        for message, odd in judged:
            if isinstance(message, StampedPose):
                if odd:
                    text = f'pose of {message.child!r} in {message.parent!r} ignored: {odd}'
                    self.drops.message('odd_stamp', text)
                else:
                    self.poses.add(*message, static=False)
                continue
            if odd:
                order = Order('odd_stamp', odd)
            else:
                order = self.guard.order(message, takes_late=self.poses.registered is None)
            if order.cause:
                self.drops.scan(message, order.cause, order.reason)
                continue
            if order.back_s:
                self._start_anew(message, order.back_s)
            elif order.odd_ns is not None:
                self.queue.drop_odd(message, order.odd_ns)
            if message.frame_id not in self.poses.mounted:
                self.poses.mount(message.frame_id)
            self.queue.push(message)

    def _start_anew(self, scan: Scan, back_s: float) -> None:
        """Clear the map after time was set back, and drop scans and poses of the time before."""
        reset_after_s = self.config.input.reset_after_s
        _log.warning(
            'scan in frame %s: time went back by %.3f s, more than input.reset_after_s '
            '(%g s): the map is cleared',
            scan.frame_id,
            back_s,
            reset_after_s,
        )
        self.counters.resets += 1
        self.queue.drop_waiting('cleared', 'the map was cleared')
        self._clear_map()
        if self.poses.registered is not None:
            self.poses.registered.restart()
        newest_ns = self.poses.transforms.newest_ns
        if newest_ns is not None and (newest_ns - scan.stamp_ns) / 1e9 > reset_after_s:
            self.poses.transforms.clear()  # else the scan would be mapped at a pose of that time

    def _prepared(self, scan: Scan, T_fixed_sensor: Transform, laps: Laps) -> Sequence[Prepared]:
        """
        Return a scan deskewed, filtered and registered; none if it is dropped.

        None either while registration waits for the next scans to confirm its pose. The scan that
        confirms it comes with those that have waited.
        """
        ready: Sequence[Prepared] = ()
        pose = T_fixed_sensor
        if self.aligner.is_corrected:
            pose = self.aligner.to_map(T_fixed_sensor)
        try:
            ready = self.preparation.prepare(scan, pose, self.config, laps)
        except Exception as error:  # MemoryError too: the next scan may fit
            self.drops.failure(scan, error, laps.milliseconds)
        if not ready and len(laps.milliseconds) > 1:
            self.counters.add_times(laps.milliseconds)
        return ready

    def _corrected(self, prepared: Prepared, T_map_fixed: Transform) -> Prepared:
        """Return a scan corrected by the alignments since its pose, those of scans before it."""
        T_fixed_sensor = compose(inverse(T_map_fixed), prepared.T_map_sensor)
        pose = self.aligner.to_map(T_fixed_sensor)
        return replace(prepared, T_map_sensor=pose)

    def _reduced(self, prepared: Prepared, laps: Laps) -> WindowedScan:
        """Return the moments of a scan."""
        windowed = reduced(prepared.filtered, prepared.T_map_sensor, self.map, self.config)
        laps.end('reduce')
        left_out = windowed.moments.left_out
        self.counters.points_left_out.update(left_out)
        if not len(windowed.moments):
            cause = 'map_limit' if 'beyond_map' in left_out else 'no_valid_points'
            counts = (f'{name.replace("_", " ")} {number}' for name, number in left_out.items())
            raise ScanRefusedError(cause, f'points left out: {", ".join(counts)}')
        if self._checks_units:
            self._checks_units = False  # all later scans have the unit of the first
            if looks_like_other_unit(windowed.moments):
                _log.warning('scan in frame %s: %s', prepared.scan.frame_id, OTHER_UNIT)
        return windowed

    def _inserted(self, prepared: Prepared, windowed: WindowedScan) -> InsertedScan:
        """Add a scan to the map, and evict those that leave the window."""
        version, removed = self._unreported or (self.map.version, [NO_VOXELS])
        evictions = self.window.insert(windowed, self.config.map.min_points)
        self._unreported = version, removed
        num_points = windowed.moments.num_points
        self.counters.mapped += 1
        self.counters.points += num_points
        for eviction in evictions:
            removed.append(eviction.fallen)
            self.counters.evicted[eviction.limit] += 1
        return InsertedScan(
            scan=prepared.filtered,
            T_map_sensor=prepared.T_map_sensor,
            keys=windowed.moments.key,
            num_points=num_points,
            evictions=tuple(evictions),
            cleared=NO_VOXELS,
        )

    def _keep(self, scan: Scan, windowed: WindowedScan) -> None:
        """Keep a mapped scan for registration and for loops; without it loops are not closed."""
        pose = windowed.T_map_sensor
        if self.loops is not None:
            try:
                self.loops.add(scan, pose, self.config)
            except Exception as error:  # the disk is full, or out of memory
                self.drops.warn('loops', f'{described(error)}; loops are not closed')
                self.loops.clear()
                self.loops = None
        local_map = self.preparation.local_map
        if local_map is not None:  # last: it may refuse the scan, which loops must have
            T_fixed_sensor = self.aligner.to_fixed(pose)
            if not np.array_equal(pose, T_fixed_sensor):
                windowed = reduced(scan, T_fixed_sensor, local_map.surfel_map, self.config)
            local_map.add(windowed)

    def _cleared(self, inserted: InsertedScan, laps: Laps) -> InsertedScan:
        """Clear the voxels that layers want cleared after a scan."""
        cleared = self.layers.voxels_to_clear(inserted, laps)
        if not len(cleared):
            return inserted
        fallen = self.drop_voxels(cleared)
        assert self._unreported is not None, 'of the scan that was inserted'
        self._unreported[1].append(fallen)
        return replace(inserted, cleared=cleared)

    def _aligned(
        self, inserted: InsertedScan, laps: Laps
    ) -> tuple[InsertedScan, Alignment | None]:
        """Align the window every ``align.every_scans`` scans; warn if that fails."""
        if not self.aligner.is_due(self.config.align.every_scans) or len(self.window) < 2:
            return inserted, None
        try:
            alignment = self.aligner.align(self.window, self.config)
            if self.loops is not None:
                self.loops.follow_window()
        except (AlignmentError, MapError, MemoryError) as error:
            self.drops.warn('alignment', f'the window is not aligned: {described(error)}')
            return inserted, None
        _log.debug('aligned: %s', alignment)
        laps.end('align')
        return inserted.at(alignment.T_map_sensor[-1]), alignment

    def _recorded(
        self,
        prepared: Prepared,
        inserted: InsertedScan | None,
        alignment: Alignment | None,
        results: dict[str, Any],
        laps: Laps,
    ) -> Update:
        """Return the update of a scan that was mapped, or localised in a frozen map."""
        scan, T_map_sensor, num_points = prepared.scan, prepared.T_map_sensor, 0
        version, removed = self._unreported or (self.map.version, [NO_VOXELS])
        if inserted is not None:
            T_map_sensor, num_points = inserted.T_map_sensor, inserted.num_points
        if inserted is not None and self.derives:
            changed = self.map.surfels_changed(version, self.config.map.min_points)
        else:
            changed = self.map.surfels_of(NO_ROWS)
        laps.end('normals')
        outcome = ScanOutcome(
            stamp_ns=scan.stamp_ns,
            frame_id=scan.frame_id,
            topic=scan.topic,
            outcome='localised' if inserted is None else 'mapped',
            pose_source=self.drops.pose_source,
            num_points=num_points,
            milliseconds=laps.milliseconds,
        )
        update = Update(
            scan=scan,
            filtered=prepared.filtered,
            stamp_ns=scan.stamp_ns,
            frame_id=self.map_frame,
            T_map_sensor=T_map_sensor,
            num_points=num_points,
            changed=changed,
            removed_voxel_index=np.concatenate(removed)
            if alignment is None
            else removed_voxels(removed, alignment, changed),
            evictions=() if inserted is None else inserted.evictions,
            outcome=outcome,
            milliseconds=dict(outcome.milliseconds),
            layers=results,
            alignment=alignment,
            registration=prepared.registration,
            T_fixed_body=prepared.T_fixed_body,
        )
        if self.drops.outcomes is not None:
            self.drops.outcomes.append(outcome)
        self._unreported = None
        self.counters.localised += inserted is None
        self.counters.add_times(outcome.milliseconds)
        return update

    # Between two scans.

    def register(self) -> None:
        """Find the poses by registration from now on."""
        self.poses.register(self.config)
        self.drops.pose_source = 'registration'
        self._keep_local_map()

    def _keep_local_map(self) -> None:
        """Keep the map that scans are registered to, if loops are closed."""
        if self.config.loops.enabled:
            self._local_map = LocalMap(self.config)
            if not self.map.num_voxels:  # else scans are registered to the map that was loaded
                self.preparation.local_map = self._local_map

    def reconfigure(self, config: Config) -> None:
        """Take new settings; if preparation refuses them, nothing has changed."""
        self.preparation.load_filters(config.filters)
        self.config = config
        self.layers.reconfigure(config)
        self._set_limits()
        self.poses.reconfigure(config)

    def _set_limits(self) -> None:
        """Set the limits of the window."""
        wanted = self.config.map.max_bytes
        self.window.config = self.config.window
        self.window.max_total_bytes = max(wanted, 0)
        if wanted < 0 and self.window.keeps_scans:
            self.window.max_total_bytes = machine_bytes() // 2

    def finish(self) -> None:
        """End the input; see Mapper.finish."""
        self.judge_stamps()
        self._settle(self.guard.release())
        self.queue.drop_waiting('no_pose', 'no pose until the end of the input')
        if self.poses.registered is not None:
            self.poses.registered.finish()

    def clear(self) -> None:
        """Drop all scans; see Mapper.clear."""
        self.judge_stamps()
        self._settle(self.guard.release())
        self.queue.drop_waiting('cleared', 'the map was cleared')
        if self.poses.registered is not None:
            self.poses.registered.finish()
        self._clear_map()

    def _clear_map(self) -> None:
        """Empty map, window and layers, unless the map is frozen."""
        self.poses.forget_mounts()
        if self.config.map.mode != 'frozen':
            self._empty()

    def _empty(self) -> None:
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
        self._empty()
        self.map.insert(moments)
        self.window.restore(scans)
        self.preparation.local_map = None
        if self.loops is not None:
            self.drops.warn(
                'loops',
                'a map was loaded: loops are closed only among the scans that come after it',
            )

    def drop_voxels(self, voxel_index: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
        """Empty voxels for good, in all scans; see SlidingWindow.drop_voxels."""
        fallen = self.window.drop_voxels(voxel_index, self.config.map.min_points)
        if self.loops is not None:
            self.loops.drop_voxels(pack_keys(voxel_index))
        return fallen

    def close_loops(self, progress: Callable[[str], object]) -> LoopMove:
        """Find the loops and move the scans; see Mapper.close_loops."""
        if self.loops is None:
            raise AlignmentError('no points are kept to close loops with: set loops.enabled')
        with self.counters.timed('loops'):
            move = self.loops.close(self.config, progress)
        self.aligner.correct(move.correction)
        _log.debug('loops: %s', move)
        return move

    def align(self) -> Alignment:
        """Move the scans of the window to poses at which they agree; see Mapper.align."""
        with self.counters.timed('align'):
            alignment = self.aligner.align(self.window, self.config)
        if self.loops is not None:
            self.loops.follow_window()
        _log.debug('aligned: %s', alignment)
        return alignment

    def warm_up_stages(self) -> list[CompileStage]:
        """Return the stages that compile kernels; see Mapper.warm_up_stages."""
        return [
            *map_stages(self.config),
            *self.preparation.warm_up_stages(self.config),
            *self.layers.warm_up_stages(),
        ]


def removed_voxels(
    removed: Sequence[npt.NDArray[np.int32]],
    alignment: Alignment,
    changed: Surfels,
) -> npt.NDArray[np.int32]:
    """Return the voxels (K, 3) that were surfels before the alignment and are none after it."""
    gone = np.unique(np.concatenate([*removed, alignment.removed_voxel_index]), axis=0)
    voxels: npt.NDArray[np.int32] = gone[~np.isin(pack_keys(gone), pack_keys(changed.voxel_index))]
    return voxels
