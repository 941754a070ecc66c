# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Mapper: the pipeline from scans and poses to a windowed map of surfels.

Node and replay drive this one class and only carry messages in and results out, so what they
map is the same to the bit. Time is the stamps of the data alone, never the clock: a scan waits
for its pose until newer data is more than ``pose.max_wait_s`` ahead of it, which a bag replayed
at any speed does alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import astuple, replace
from functools import partial
import logging
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.registration import Alignment
from surfel_mapper.config import Config, declarations
from surfel_mapper.counters import Counters, Laps
from surfel_mapper.deskew import deskewed, point_times
from surfel_mapper.deskew import warm_up as warm_up_deskewing
from surfel_mapper.errors import (
    AlignmentError,
    CloudFormatError,
    ConfigError,
    FilterError,
    MapError,
    PoseError,
    PoseNotYetError,
)
from surfel_mapper.filters.chain import Chain
from surfel_mapper.geometry import compose, inverse, pose_matrix, Transform
from surfel_mapper.mapping.channels import CHANNELS, missing_columns
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.reducer import NARROW_COUNT, within
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.mapping.window import Eviction, SlidingWindow, WindowedScan
from surfel_mapper.pipeline.drops import Drops
from surfel_mapper.pipeline.motion_gate import stands_still
from surfel_mapper.pipeline.moved_away import MovedAway
from surfel_mapper.pipeline.regions import Region
from surfel_mapper.pipeline.registered_poses import RegisteredPoses
from surfel_mapper.pipeline.scan_queue import ScanQueue
from surfel_mapper.pipeline.sensor_models import SensorModels
from surfel_mapper.pipeline.tsdf_layer import TsdfLayer
from surfel_mapper.pipeline.update import removed_voxels, Update
from surfel_mapper.pipeline.window_aligner import Aligned, WindowAligner
from surfel_mapper.poses import TransformBuffer
from surfel_mapper.scan import PointTimes, Scan

_log = logging.getLogger(__name__)


class Mapper:
    """
    Maps scans at the poses that belong to them.

    Parameters
    ----------
    config : Config, optional
        All settings; the defaults without it.

    Raises
    ------
    ConfigError
        If ``filters`` names a file that holds no chain.

    """

    def __init__(self, config: Config | None = None) -> None:
        """Make an empty map with the settings of a configuration."""
        self.config = config or Config()
        self.counters = Counters()
        self.chain = Chain.load(self.config.filters) if self.config.filters else Chain()
        self.map = SurfelMap(
            self.config.map.voxel_size_m,
            columns=self.config.map.columns,
            threads=self.config.map.threads,
        )
        self.window = SlidingWindow(
            self.map, self.config.window, max_voxels=self.config.map.max_voxels
        )
        self.transforms = TransformBuffer(reset_after_s=self.config.input.reset_after_s)
        self._aligner = WindowAligner(self._moments_at)
        self._drops = Drops(self.counters)
        self._queue = ScanQueue(self.config.pose.max_waiting_scans, self._drops)
        self._mounted: set[str] = set()
        sensors = SensorModels(self.config.tsdf)
        self.tsdf = TsdfLayer(self.config.tsdf, sensors) if self.config.tsdf.enabled else None
        self._moved: MovedAway | None = None
        if self.config.dynamic.clear:
            self._moved = MovedAway(self.config.dynamic, self.map.voxel_size_m, sensors)
        self.registered: RegisteredPoses | None = None
        if self.config.pose.source == 'registration':
            self.registered = RegisteredPoses(self.config, self.transforms)

    def add_pose(
        self,
        parent: str,
        child: str,
        stamp_ns: int,
        xyz: Any,
        q_xyzw: Any,
        *,
        static: bool = False,
    ) -> None:
        """
        Add the pose of one frame in another; a bad one is counted and warned about.

        Parameters
        ----------
        parent, child : str
            Names of the frames; the pose takes points of the child to the parent.
        stamp_ns : int
            Its time; has no meaning where it is static.
        xyz : (3,) float, m
            Position of the child in the parent.
        q_xyzw : (4,) float
            Its orientation, a unit quaternion.
        static : bool
            Whether it holds for all time.

        """
        try:
            transform = pose_matrix(xyz, q_xyzw)
            if static:
                self.transforms.add_static(parent, child, transform)
            else:
                self.transforms.add(parent, child, stamp_ns, transform)
        except (PoseError, ValueError) as error:
            self._drops.message('bad_pose', f'pose of {child!r} in {parent!r} ignored: {error}')

    def add_scan(self, scan: Scan, topic: str = '') -> None:
        """
        Queue a scan until its pose is there; ``insert_ready`` maps it.

        A scan without points or frame, or with a stamp that is not newer than the last of its
        frame, is dropped and counted. A stamp that goes back by more than
        ``input.reset_after_s`` clears the map first. The topic it came on is for the log.
        """
        self.counters.received += 1
        if topic:
            self._drops.topics[scan.frame_id] = topic
        if not scan.frame_id:
            self._drops.scan(scan, 'empty_frame_id', 'its header has no frame_id')
        elif len(scan) == 0:
            self._drops.scan(scan, 'no_points', 'it has no points')
        elif missing := missing_columns(scan.columns, self.map.columns):
            reason = f'its points have no {" and no ".join(missing)}'
            self._drops.scan(scan, 'missing_column', reason)
        elif (timed := self._timed(scan)) is not None:
            if (back_s := self._queue.back_s(scan)) > self.config.input.reset_after_s:
                self._start_anew(scan, back_s)
            self._mount(scan.frame_id)
            self._queue.push(timed)

    def _timed(self, scan: Scan) -> Scan | None:
        """Return a scan with the times that deskewing needs; None where it has none."""
        settings = self.config.deskew
        if not settings.enabled:
            return scan
        try:
            times = point_times(scan, settings.field, settings.unit, settings.reference)
        except CloudFormatError as error:
            self._drops.scan(scan, 'no_times', str(error))
            return None
        return replace(scan, times=times)

    def refuse_clouds(
        self, cause: str, topic: str, reason: str, number: int = 1, frame_id: str = ''
    ) -> None:
        """
        Count clouds that came in but never became scans: damaged, too many, unwanted.

        Parameters
        ----------
        cause : str
            What they are counted as.
        topic : str
            Where they came in.
        reason : str
            What was found, what was expected, and the remedy, for the log.
        number : int
            How many.
        frame_id : str
            Their frame, under which they are counted; without it, under their topic.

        """
        self.counters.received += number
        self.counters.drop(cause, frame_id or topic, number)
        dropped = self.counters.dropped[cause]
        self._drops.warn(
            cause, f'cloud on {topic} dropped: {reason} ({dropped} dropped for this cause)'
        )

    def ignore_message(self, cause: str, reason: str, number: int = 1) -> None:
        """Count messages other than clouds that are not used, and warn about it."""
        self._drops.message(cause, reason, number)

    def insert_ready(self) -> Iterator[Update]:
        """
        Map the waiting scans whose poses are there, in order; yield what each did.

        A scan whose pose cannot come any more, or did not in time, is dropped and counted.
        """
        while (scan := self._queue.first) is not None:
            try:
                pose = self._lookup(scan)
            except PoseNotYetError as error:
                waited_s = (self._now_ns() - scan.end_ns) / 1e9
                if waited_s <= self.config.pose.max_wait_s:
                    return
                self._queue.pop()
                self._drops.scan(scan, 'no_pose', f'no pose within {waited_s:.3f} s: {error}')
                continue
            except PoseError as error:
                self._queue.pop()
                self._drops.scan(scan, 'no_pose', str(error))
                continue
            self._queue.pop()
            update = self._insert(scan, pose)
            if update is not None:
                yield update

    def start_from(self, frame_id: str, xyz: Any, q_xyzw: Any) -> None:
        """
        Go on from a pose of the robot that somebody states, with registration; else warn.

        Parameters
        ----------
        frame_id : str
            The frame that the pose is in; has to be that of the map.
        xyz : (3,) float, m
            Position of the base, or of the sensor where it is not known how it sits on a base.
        q_xyzw : (4,) float
            Its orientation.

        """
        if self.registered is None:
            reason = f'poses come from pose.source {self.config.pose.source}'
        elif frame_id != self.map_frame:
            reason = f'it is in frame {frame_id!r}, expected {self.map_frame!r}'
        else:
            try:
                T_map_body = pose_matrix(xyz, q_xyzw)
            except ValueError as error:
                reason = str(error)
            else:
                self.registered.restart(compose(inverse(self._aligner.T_map_fixed), T_map_body))
                return
        self._drops.message('initial_pose', f'initial pose ignored: {reason}')

    def finish(self) -> None:
        """End the input: what still waits for a pose is dropped and counted."""
        self._queue.drop_all('no_pose', 'no pose until the end of the input')

    def clear(self) -> None:
        """Forget all scans, waiting ones too (counted); poses, counts and a frozen map stay."""
        self._queue.drop_all('cleared', 'the map was cleared')
        if self.config.map.mode != 'frozen':
            self._empty()

    def _empty(self) -> None:
        self.window.clear()
        self._aligner.reset()
        if self.tsdf is not None:
            self.tsdf.clear()
        if self._moved is not None:
            self._moved.clear()

    def align(self) -> Aligned:
        """
        Move the scans of the window to where they agree; see the settings ``align``.

        The map then equals, to the bit, one that was built at the corrected poses. Scans to come
        are corrected like the newest one.

        Raises
        ------
        AlignmentError
            If points are not kept (``window.keep_points``), there are fewer than two scans, or
            no poses follow. Nothing has changed then.
        MapError
            If a scan cannot be where it belongs. Nothing has changed then.

        """
        with self.counters.timed('align'):
            aligned = self._aligner.align(self.window, self.config)
        _log.info('aligned: %s', aligned)
        return aligned

    @property
    def T_map_fixed(self) -> Transform:
        """From the fixed frame of the poses that come in to the map: how alignment corrects."""
        return self._aligner.T_map_fixed

    def T_map_of(self, frame_id: str, stamp_ns: int) -> Transform:
        """
        Return where a frame is in the map at a time; 0: the newest there is.

        Raises
        ------
        PoseError
            If there is no transform.

        """
        if frame_id == self.map_frame:
            return np.eye(4)
        fixed, at_ns = self.config.frames.fixed, stamp_ns or self.transforms.newest_ns or 0
        return self._aligner.to_map(self.transforms.lookup(fixed, frame_id, at_ns))

    @property
    def map_frame(self) -> str:
        """The frame of the map: that of the poses, unless alignment gives it its own."""
        return self.config.align.map_frame or self.config.frames.fixed

    def surfels(self, level: int = 0) -> Surfels:
        """
        Return the surfels with ``map.min_points`` points.

        Parameters
        ----------
        level : int
            Of the map whose voxels are 2^level times larger.

        """
        surfel_map = self.map.coarsen(level) if level else self.map
        return surfel_map.surfels(self.config.map.min_points)

    def clear_region(self, region: Region) -> npt.NDArray[np.int32]:
        """
        Empty the voxels whose centres are in a part of space, for good.

        The scans of the window lose them too, so that what leaves later leaves exactly.

        Returns
        -------
        (E, 3) int32
            Indices of the surfels (``map.min_points``) that are gone.

        """
        voxel_index = self.map.moments().voxel_index
        centers = (voxel_index.astype(np.float64) + 0.5) * self.map.voxel_size_m
        inside = voxel_index[region.contains(centers)]
        return self.window.drop_voxels(inside, self.config.map.min_points)

    def restore(self, surfel_map: SurfelMap, scans: Iterable[WindowedScan]) -> None:
        """
        Put a saved map, and the scans of its window, in the place of what there is.

        Raises
        ------
        MapError
            If it has another voxel size, level or other columns. Nothing has changed then.

        """
        for name in ('voxel_size_m', 'level', 'columns'):
            found, expected = getattr(surfel_map, name), getattr(self.map, name)
            if found != expected:
                raise MapError(f'map with {name} {found}, expected {expected} as configured')
        self.clear()
        self._empty()
        self.map.insert(surfel_map.moments())
        self.window.restore(scans)

    def reconfigure(self, config: Config) -> None:
        """
        Take new settings while running; they hold from the next scan on.

        Raises
        ------
        ConfigError
            If a setting differs that only a new start can change, or ``filters`` names a file
            that holds no chain. Nothing has changed then.

        """
        old, new = self.config.to_mapping(), config.to_mapping()
        for declared in declarations():
            if not declared.live and old[declared.name] != new[declared.name]:
                raise ConfigError(
                    f'{declared.name}: cannot change while running; set it at the start'
                )
        if config.filters != self.config.filters:
            chain = Chain.load(config.filters) if config.filters else Chain()
            chain.warm_up()
            self.chain = chain
        self.config = config
        if self.registered is not None:
            self.registered.reconfigure(config)
        self.window.config = config.window
        self.window.max_voxels = config.map.max_voxels

    def warm_up(self) -> None:
        """Compile every kernel that mapping needs, for all types that scans may have."""
        self.chain.warm_up()
        if self.config.window.keep_points:
            self._aligner.warm_up()
        for dtype in (np.float32, np.float64):
            surfel_map = SurfelMap(self.config.map.voxel_size_m, columns=self.config.map.columns)
            one, most = ({n: np.zeros(num) for n in CHANNELS} for num in (1, NARROW_COUNT))
            moments = surfel_map.add(np.zeros((1, 3), dtype), columns=one)
            surfel_map.surfels_changed(since=0)
            surfel_map.remove(moments)
            many = surfel_map.add(np.zeros((NARROW_COUNT, 3), dtype), columns=most)  # int64 sums
            surfel_map.remove(many)
        surfel_map.digest()
        if self.config.publish.levels:
            surfel_map.coarsen(1).surfels()
        if self.config.deskew.enabled:
            warm_up_deskewing()
        if self.registered is not None:
            self.registered.warm_up()
        if self.tsdf is not None:
            self.tsdf.warm_up()
        if self._moved is not None:
            self._moved.warm_up()

    def summary(self) -> dict[str, Any]:
        """Return counts and times, and what the map is: for files, reports and diagnostics."""
        return {
            **self.counters.summary(),
            'filter_chain': self.chain.to_list(),
            **({'registration': self.registered.summary()} if self.registered else {}),
            'voxel_size_m': self.map.voxel_size_m,
            'window_scans': len(self.window),
            'voxels': self.map.num_voxels,
            'surfels': len(self.map.surfels(self.config.map.min_points)),
            'digest': self.map.digest(),
            **({'tsdf': self.tsdf.summary()} if self.tsdf else {}),
        }

    def _start_anew(self, scan: Scan, back_s: float) -> None:
        """Forget what was mapped before time was set back, and the poses of that time."""
        reset_after_s = self.config.input.reset_after_s
        _log.warning(
            'scan in frame %s: time went back by %.3f s, more than input.reset_after_s '
            '(%g s): the map is cleared',
            scan.frame_id,
            back_s,
            reset_after_s,
        )
        self.counters.resets += 1
        self.clear()
        if self.registered is not None:
            self.registered.restart()
        self._queue.forget_stamps()
        newest_pose = self.transforms.newest_ns
        if newest_pose is not None and (newest_pose - scan.stamp_ns) / 1e9 > reset_after_s:
            self.transforms.clear()  # else the scan would be mapped where the robot was then

    def _now_ns(self) -> int:
        """Return the newest stamp of all data seen."""
        stamps = (self._queue.newest_ns, self.transforms.newest_ns)
        return max(stamp for stamp in stamps if stamp is not None)

    def _mount(self, frame_id: str) -> None:
        """Enter the configured extrinsics of a sensor when its frame is first seen."""
        values, base = self.config.frames.mount_of(frame_id), self.config.frames.base
        if values and frame_id != base and frame_id not in self._mounted:
            self._mounted.add(frame_id)
            self.add_pose(base, frame_id, 0, values[:3], values[3:], static=True)

    def _lookup(self, scan: Scan) -> npt.NDArray[np.float64]:
        """Return T_fixed_sensor at the stamp of a scan."""
        if self.config.pose.source == 'identity':
            return np.eye(4)
        if self.registered is not None:
            self.registered.learn_motion(scan, self._queue.second)
        pose = self._pose_at(scan.frame_id, scan.stamp_ns)
        if scan.times is not None:  # the poses of all points have to be there
            self._pose_at(scan.frame_id, scan.times.first_ns)
            self._pose_at(scan.frame_id, scan.times.last_ns)
        return pose

    def _pose_at(self, frame_id: str, stamp_ns: int) -> npt.NDArray[np.float64]:
        """Return T_fixed_sensor at a time."""
        if self.registered is not None:
            return self.registered.predict(frame_id, stamp_ns)
        return self.transforms.lookup(self.config.frames.fixed, frame_id, stamp_ns)

    def _deskewed(self, scan: Scan, times: PointTimes) -> Scan:
        """Return a scan as seen from one place, where the sensor was at its stamp."""
        fixed, sensor = self.config.frames.fixed, scan.frame_id
        stamps = self.transforms.stamps(fixed, sensor, times.first_ns, times.last_ns)
        min_range_m = self.config.input.min_range_m
        return deskewed(scan, partial(self._pose_at, sensor), stamps, min_range_m)

    def _insert(self, scan: Scan, pose: npt.NDArray[np.float64]) -> Update | None:
        """Map a scan; None where the motion gate or the map leaves it out."""
        laps, version = Laps(), self.map.version
        prepared = self._prepare(scan, self._aligner.to_map(pose), laps)
        if prepared is None:
            return None
        scan, filtered, pose, alignment = prepared
        if self.config.map.mode == 'frozen':
            return self._only_posed(scan, pose, alignment, laps)
        try:
            windowed = self._reduce(filtered, pose)
            laps.end('reduce')
            if not len(windowed.moments):
                self._drops.scan(scan, 'no_valid_points', f'left out: {windowed.moments.left_out}')
                return None
            evictions = self.window.insert(windowed, self.config.map.min_points)
        except MapError as error:
            self._drops.scan(scan, 'map_limit', str(error))
            return None
        laps.end('insert')
        cleared = self._clear_moved(filtered, pose, windowed.moments.key)
        if self._moved is not None:
            laps.end('clear')
        aligned = self._align_when_due()
        if aligned is not None:
            pose = aligned.T_map_sensor[-1]
            laps.end('align')
        changed = self._changed_since(version)
        laps.end('normals')
        if self.tsdf is not None:
            self._follow(self.tsdf, filtered, pose, evictions)
            laps.end('tsdf')
        self._count(windowed, evictions, laps.milliseconds)
        return Update(
            scan=scan,
            stamp_ns=scan.stamp_ns,
            frame_id=self.map_frame,
            T_fixed_sensor=pose,
            num_points=windowed.moments.num_points,
            changed=changed,
            removed_voxel_index=removed_voxels(evictions, cleared, aligned, changed),
            evictions=tuple(evictions),
            milliseconds=laps.milliseconds,
            aligned=aligned,
            alignment=alignment,
        )

    def _clear_moved(
        self,
        scan: Scan,
        pose: npt.NDArray[np.float64],
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
        self.counters.cleared_voxels += len(empty)
        return self.window.drop_voxels(empty, self.config.map.min_points)

    def _follow(
        self,
        layer: TsdfLayer,
        scan: Scan,
        pose: npt.NDArray[np.float64],
        evictions: list[Eviction],
    ) -> None:
        """Give a scan to a layer; warn where the layer cannot take it."""
        try:
            layer.follow(scan, pose, evictions)
        except (CloudFormatError, MapError) as error:
            self._drops.message('tsdf', f'scan at {scan.stamp_ns / 1e9:.6f} s: {error}')

    def _changed_since(self, version: int) -> Surfels:
        """Return the surfels of the voxels that changed after a version of the map."""
        return self.map.surfels_changed(version, self.config.map.min_points)

    def _prepare(
        self, scan: Scan, pose: npt.NDArray[np.float64], laps: Laps
    ) -> tuple[Scan, Scan, npt.NDArray[np.float64], Alignment | None] | None:
        """Deskew, filter and register a scan: deskewed, filtered, its pose; None if it is left."""
        if self.registered is None and self._is_gated(pose):
            return None
        times = scan.times
        if times is not None:
            scan = self._deskewed(scan, times)
            laps.end('deskew')
        filtered: Scan | None = scan
        if len(self.chain):
            filtered = self._filter(scan, pose)
            laps.end('filter')
        if filtered is None or self.registered is None:
            return None if filtered is None else (scan, filtered, pose, None)
        try:
            pose, alignment = self.registered.find(
                filtered, times, self.map, self._aligner.T_map_fixed
            )
        except (AlignmentError, MapError, PoseError) as error:
            self._drops.scan(scan, 'not_aligned', str(error))
            return None
        laps.end('register')
        if alignment is not None and len(alignment.degenerate):
            num = len(alignment.degenerate)
            self._drops.warn(
                'degenerate',
                f'scan at {scan.stamp_ns / 1e9:.6f} s: what it sees leaves {num} of 6 directions '
                'of motion open; there the prediction is kept',
            )
        pose = self._aligner.to_map(pose)
        return None if self._is_gated(pose) else (scan, filtered, pose, alignment)

    def _is_gated(self, pose: npt.NDArray[np.float64]) -> bool:
        """Return whether the motion gate leaves out a scan at a pose, and count it."""
        last = self.window.newest
        if last is None or not stands_still(last.T_map_sensor, pose, self.config.window):
            return False
        self.counters.gated += 1
        return True

    def _only_posed(
        self,
        scan: Scan,
        pose: npt.NDArray[np.float64],
        alignment: Alignment | None,
        laps: Laps,
    ) -> Update:
        """Say where a scan was taken; a frozen map takes none."""
        self.counters.localised += 1
        for stage, milliseconds in laps.milliseconds.items():
            self.counters.add_time(stage, milliseconds)
        return Update(
            scan=scan,
            stamp_ns=scan.stamp_ns,
            frame_id=self.map_frame,
            T_fixed_sensor=pose,
            num_points=0,
            changed=self.map.surfels_changed(self.map.version),
            removed_voxel_index=np.empty((0, 3), np.int32),
            evictions=(),
            milliseconds=laps.milliseconds,
            alignment=alignment,
        )

    def _align_when_due(self) -> Aligned | None:
        """Align the window if so many scans were mapped since; warn where that fails."""
        if not self._aligner.is_due(self.config.align.every_scans) or len(self.window) < 2:
            return None
        try:
            aligned = self._aligner.align(self.window, self.config)
        except (AlignmentError, MapError) as error:
            self._drops.warn('alignment', f'the window is not aligned: {error}')
            return None
        _log.debug('aligned: %s', aligned)
        return aligned

    def _filter(self, scan: Scan, pose: npt.NDArray[np.float64]) -> Scan | None:
        """Return what the chain leaves of a scan; None where it leaves nothing, or cannot work."""
        try:
            T_base_sensor = self.transforms.lookup(
                self.config.frames.base, scan.frame_id, scan.stamp_ns
            )
        except PoseError:
            T_base_sensor = None  # the filters that need it will say so
        try:
            filtered, steps = self.chain.run(
                replace(scan, T_base_sensor=T_base_sensor, T_fixed_sensor=pose)
            )
        except FilterError as error:
            self._drops.scan(scan, 'filter', str(error))
            return None
        for step in steps:
            self.counters.add_filter(*astuple(step))
        self.counters.points_left_out['filtered'] += len(scan) - len(filtered)
        if not len(filtered):
            self._drops.scan(scan, 'filtered_out', 'the filters left none of its points')
            return None
        return filtered

    def _reduce(self, scan: Scan, pose: npt.NDArray[np.float64]) -> WindowedScan:
        """Reduce a scan to its moments."""
        limits = self.config.input
        moments = self.map.reduce(
            scan.points,
            pose,
            origin=self._origin(pose),
            min_range_m=limits.min_range_m,
            max_range_m=limits.max_range_m or np.inf,
            columns=scan.columns,
        )
        self.counters.points_left_out.update(moments.left_out)
        windowed = WindowedScan(moments=moments, stamp_ns=scan.stamp_ns, T_map_sensor=pose)
        if not self.config.window.keep_points:
            return windowed
        entered = scan.select(within(scan.points, limits.min_range_m, limits.max_range_m))
        columns = {name: entered.columns[name] for name in self.map.columns}
        return replace(windowed, points=entered.points, columns=columns)

    def _moments_at(self, scan: WindowedScan, pose: npt.NDArray[np.float64]) -> ScanMoments:
        """Return the moments of a scan of the window at another pose."""
        assert scan.points is not None, 'only scans with points are moved'
        return self.map.reduce(
            scan.points, pose, origin=self._origin(pose), columns=scan.columns
        )

    def _origin(self, pose: npt.NDArray[np.float64]) -> npt.NDArray[np.float64] | None:
        """Return where the sensor is; None where that is unknown, and normals stay unturned."""
        return None if self.config.pose.source == 'identity' else pose[:3, 3]

    def _count(
        self, scan: WindowedScan, evictions: list[Eviction], times: dict[str, float]
    ) -> None:
        self.counters.mapped += 1
        self.counters.points += scan.moments.num_points
        self.counters.evicted.update(eviction.limit for eviction in evictions)
        for stage, milliseconds in times.items():
            self.counters.add_time(stage, milliseconds)
