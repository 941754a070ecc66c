# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
ScanPoses: poses of the sensors, looked up or registered; ScanQueue: scans that wait for theirs.

Extrinsics of the configuration become static transforms when a frame is first seen. Lookups need
only the tree of frames.

A scan older than the one before it of its topic and frame is put before that, if it still waits.

Time is the stamps of the data alone, never the clock: a bag replayed at any speed waits and drops
alike. A scan whose pose cannot come any more, or did not within ``pose.max_wait_s`` of the newest
data, is dropped and counted. The wait is longer, ``pose.max_delay_s``, while the scan is newer
than all poses: these are on the way.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import is_unit
from surfel_mapper.config import Config, PoseConfig
from surfel_mapper.errors import PoseError, PoseNotYetError, PosesLateError
from surfel_mapper.geometry import compose, inverse, pose_matrix, Transform
from surfel_mapper.pipeline.drops import Drops
from surfel_mapper.pipeline.map_origin import MapOrigin
from surfel_mapper.pipeline.registered_poses import RegisteredPoses
from surfel_mapper.pipeline.scan_images import ScanImages
from surfel_mapper.pipeline.stamp_guard import source_of
from surfel_mapper.poses import MAX_TRANSFORMS, MountChanges, TransformBuffer
from surfel_mapper.poses.buffer import FrameMove
from surfel_mapper.scan import PointTimes, Scan
from surfel_mapper.sensors.deskew import deskewed

MAX_SENSORS = 64
"""Frames of sensors that are kept; frame names may change without end."""

MAX_EARLY = 100
"""Number of poses of the fixed frame itself that wait until ``map.origin: auto`` is known."""


ROUNDING = 2e-3
"""Error of the squared norm of a quaternion above which its normalisation is reported."""


class ScanPoses:
    """
    The poses of the sensors of a pipeline.

    Parameters
    ----------
    config : Config
        Source of the poses, and mounts of the sensors.
    drops : Drops
        Counts poses that are refused.
    origin : MapOrigin
        Is subtracted from poses in the fixed frame.

    Attributes
    ----------
    transforms : TransformBuffer
        The tree of frames; the origin of the fixed frame is that of the map.
    mounts : MountChanges
        Sensors that have moved on the robot.
    fixed : str
        Name of the fixed frame.
    mounted : set of str
        The frames of sensors; extrinsics of the configuration were entered, if there are any.
    registered : RegisteredPoses, optional
        The poses by registration, if ``pose.source`` is ``registration``, or auto chose it.

    """

    def __init__(self, config: Config, drops: Drops, origin: MapOrigin) -> None:
        self._config = config
        self.fixed = config.frames.fixed
        self._drops = drops
        self.origin = origin
        self._early: deque[tuple[str, str, int, Transform, bool]] = deque(maxlen=MAX_EARLY)
        self._warned_of_norm = False
        self.mounted: set[str] = set()
        self._configured: set[str] = set()  # sensors whose mount is in the configuration
        self._last_ns: int | None = None  # stamp of the last scan that has a pose
        self.mounts = MountChanges()
        self.transforms = TransformBuffer(reset_after_s=config.input.reset_after_s)
        self._set_max_gap(config)
        self.registered: RegisteredPoses | None = None
        if config.pose.source == 'registration':
            self.register(config)

    def register(self, config: Config) -> None:
        """Find the poses by registration from now on."""
        self.registered = RegisteredPoses(config, self.transforms, self._drops)

    def reconfigure(self, config: Config) -> None:
        """Take new settings; those of frames and sources never change."""
        self._set_max_gap(config)
        if self.registered is not None:
            self.registered.reconfigure(config)

    def _set_max_gap(self, config: Config) -> None:
        self.transforms.max_gap_s = config.pose.max_gap_s or math.inf

    def add(
        self, parent: str, child: str, stamp_ns: int, xyz: Any, q_xyzw: Any, *, static: bool
    ) -> None:
        """Add the pose of one frame in another; bad ones and too many are counted and logged."""
        forgotten = self.transforms.num_forgotten
        try:
            q_xyzw = [*q_xyzw]
            self._add(parent, child, stamp_ns, pose_matrix(xyz, q_xyzw), static)
            if not self._warned_of_norm and not is_unit(q_xyzw, ROUNDING):
                self._warned_of_norm = True
                text = f'pose of {child!r} in {parent!r}: quaternion {q_xyzw} is normalised'
                self._drops.warn('bad_pose', text)
        except (PoseError, ValueError) as error:
            self._drops.message('bad_pose', f'pose of {child!r} in {parent!r} ignored: {error}')
        move, self.transforms.move = self.transforms.move, None
        if move is not None:
            self._note_move(move)
        if number := self.transforms.num_forgotten - forgotten:
            reason = f'{number} old transforms dropped: the buffer holds {MAX_TRANSFORMS}'
            self._drops.message('too_many_transforms', reason, number)

    def _note_move(self, move: FrameMove) -> None:
        """Log the move of a frame, if a sensor of earlier scans is mounted on it."""
        fixed, transforms = self._config.frames.fixed, self.transforms
        if self._last_ns is not None and any(
            transforms.is_between(move.child, fixed, sensor) for sensor in self.mounted
        ):
            self._drops.warn(f'mount {move.child}', self.mounts.add(move, self._last_ns))

    def forget_mounts(self) -> None:
        """Forget the mounts that sensors had before, as the map holds no scan of them."""
        self._last_ns = None
        self.mounts.clear()
        self.transforms.forget_former_parents()

    def _add(
        self, parent: str, child: str, stamp_ns: int, transform: Transform, static: bool
    ) -> None:
        """Add a pose, shifted by the origin of the map if it is in the fixed frame."""
        fixed = self.fixed
        if self.origin.has_own_frame and fixed in (parent, child):
            if not self.origin.is_known and child == fixed:
                self._early.append((parent, child, stamp_ns, transform, static))
                return
            if not self.origin.is_known:
                self.origin.find(transform[:3, 3])
                while self._early:
                    self._add(*self._early.popleft())
            transform = self.origin.shifted(transform, is_child=child == fixed)
        if child in self._configured:
            raise PoseError(f'frames.base_to_sensor gives the mount of {child!r}')
        if static:
            self.transforms.add_static(parent, child, transform)
        else:
            self.transforms.add(parent, child, stamp_ns, transform)

    def mount(self, frame_id: str) -> None:
        """Add the configured extrinsics of a sensor when its frame is first seen."""
        if frame_id in self.mounted:
            return
        if len(self.mounted) >= MAX_SENSORS:
            self.mounted.clear()
            self._configured.clear()
        self.mounted.add(frame_id)
        values, base = self._config.frames.mount_of(frame_id), self._config.frames.base
        if values and frame_id != base:
            self.add(base, frame_id, 0, values[:3], values[3:], static=True)
            self._configured.add(frame_id)

    def of(self, scan: Scan, following: Scan | None = None) -> Transform:
        """
        Return T_fixed_sensor at the stamp of a scan, with the origin of the map.

        Parameters
        ----------
        scan : Scan
            The scan.
        following : Scan, optional
            The next one, from which registration estimates the first velocity.

        Raises
        ------
        PoseNotYetError
            If it may still come.
        PoseError
            If it cannot come any more.

        """
        if self._config.pose.source == 'identity':
            if not self.origin.is_known:
                self.origin.find_in(scan.points)
            return self.origin.T_local_fixed
        if self.registered is not None:
            self.registered.learn_motion(scan, following)
            pose = self.registered.predict(scan.frame_id, scan.stamp_ns)
        else:
            pose = self.transforms.lookup(self.fixed, scan.frame_id, scan.stamp_ns)
        if scan.times is not None:
            self._check_sweep(scan.frame_id, scan.times)
        self._last_ns = max(scan.stamp_ns, self._last_ns or 0)
        return pose

    def _check_sweep(self, frame_id: str, times: PointTimes) -> None:
        """Raise unless the poses of all points of a scan are there."""
        if self.registered is None:
            self.transforms.check_span(self.fixed, frame_id, times.first_ns, times.last_ns)
        else:
            self.registered.predict(frame_id, times.first_ns)
            self.registered.predict(frame_id, times.last_ns)

    def deskewed(self, scan: Scan, times: PointTimes) -> Scan:
        """Return a scan deskewed by the poses within its sweep."""
        fixed, sensor = self.fixed, scan.frame_id
        stamps = self.transforms.stamps(fixed, sensor, times.first_ns, times.last_ns)
        min_range_m = self._config.input.min_range_m
        return deskewed(scan, partial(self._at, sensor), stamps, min_range_m)

    def of_base(self, scan: Scan) -> Transform | None:
        """Return T_base_sensor at the stamp of a scan; None if unknown."""
        try:
            return self.transforms.lookup(self._config.frames.base, scan.frame_id, scan.stamp_ns)
        except PoseError:
            return None

    def seen_from(self, frame_id: str, stamp_ns: int, scan: Scan) -> Transform:
        """
        Return T_frame_sensor from the sensor of a scan to a frame at another time.

        If the pose of the robot is unknown at one of the times, it is taken to have stood still.

        Raises
        ------
        PoseError
            If no transforms lead from the frame to the sensor.

        """
        if frame_id in self._config.frames.sensors:
            self.mount(frame_id)
        try:
            T_fixed_frame = self._at(frame_id, stamp_ns)
            T_fixed_sensor = self._at(scan.frame_id, scan.stamp_ns)
        except PoseError:
            return self.transforms.lookup(frame_id, scan.frame_id, scan.stamp_ns)
        return compose(inverse(T_fixed_frame), T_fixed_sensor)

    def _at(self, frame_id: str, stamp_ns: int) -> Transform:
        """Return T_fixed_sensor at a time."""
        if self.registered is not None:
            return self.registered.predict(frame_id, stamp_ns)
        return self.transforms.lookup(self.fixed, frame_id, stamp_ns)


PosedScan = tuple[Scan, Transform]
"""A scan and its T_fixed_sensor."""


class ScanQueue:
    """
    A bounded queue of scans that wait for their poses.

    Parameters
    ----------
    max_scans : int
        Scans that may wait; of more, the oldest is dropped.
    poses : ScanPoses
        The poses of the sensors.
    images : ScanImages, optional
        Scans wait for these images as well.
    drops : Drops
        Counts the scans that are dropped.

    Attributes
    ----------
    max_scans : int
        See above.
    waiting : deque of Scan
        The scans that wait for their poses.
    ended : bool
        No poses come any more: a scan without one is dropped at once, for those behind it.
    is_open : bool
        False while the source of the poses is unknown: scans wait, at most ``max_scans``.

    """

    def __init__(
        self, max_scans: int, poses: ScanPoses, images: ScanImages | None, drops: Drops
    ) -> None:
        self.max_scans = max_scans
        self._poses = poses
        self._images = images
        self._drops = drops
        self.waiting: deque[Scan] = deque()
        self.ended = False
        self.is_open = True

    def push(self, scan: Scan) -> None:
        """Add a scan, before newer ones of its source; beyond the limit the first is dropped."""
        source, row = source_of(scan), len(self.waiting)
        for at, queued in enumerate(self.waiting):
            if queued.stamp_ns > scan.stamp_ns and source_of(queued) == source:
                row = at
                break
        self.waiting.insert(row, scan)
        if len(self.waiting) > self.max_scans:
            reason = f'{self.max_scans} newer scans wait for their poses'
            self._drops.scan(self.waiting.popleft(), 'queue_full', reason)

    def drop_odd(self, scan: Scan, odd_ns: int) -> None:
        """Drop the scan of a stamp ahead of the next one of its frame, if it still waits."""
        reason = f'its stamp is {(odd_ns - scan.stamp_ns) / 1e9:.3f} s ahead of the next scan'
        for row, queued in enumerate(self.waiting):
            if (source_of(queued), queued.stamp_ns) == (source_of(scan), odd_ns):
                del self.waiting[row]
                self._drops.scan(queued, 'odd_stamp', reason)
                return
        at = f'scan at {odd_ns / 1e9:.6f} s in frame {scan.frame_id!r}'
        self._drops.warn('odd_stamp', f'{at}: {reason}, but it is mapped')

    def next_posed(
        self, newest_of: Callable[[Scan], int | None], config: PoseConfig
    ) -> PosedScan | None:
        """
        Return the next scan whose pose is there, and drop those without; None until more comes.

        Parameters
        ----------
        newest_of : callable
            Returns the newest stamp of scans that tells how long a scan has waited.
        config : PoseConfig
            Longest waits.

        """
        while self.is_open and self.waiting:
            scan = self.waiting[0]
            pose_or_reason = self._pose_of(scan, newest_of(scan), config)
            if pose_or_reason is None:
                break
            self.waiting.popleft()
            if isinstance(pose_or_reason, str):
                self._drops.scan(scan, 'no_pose', pose_or_reason)
            else:
                return scan, pose_or_reason
        return None

    def drop_waiting(self, cause: str, reason: str) -> None:
        """Drop every scan that waits for its pose."""
        while self.waiting:
            self._drops.scan(self.waiting.popleft(), cause, reason)

    def _pose_of(
        self, scan: Scan, newest_scan_ns: int | None, config: PoseConfig
    ) -> Transform | str | None:
        """Return T_fixed_sensor, the reason why it will not come, or None while it may come."""
        newest_ns = scan.stamp_ns
        newest_pose_ns = self._poses.transforms.newest_beside(self._poses.fixed, scan.frame_id)
        for stamp_ns in (newest_scan_ns, newest_pose_ns):
            if stamp_ns is not None and stamp_ns > newest_ns:
                newest_ns = stamp_ns
        waited_s = (newest_ns - scan.end_ns) / 1e9
        images = self._images if waited_s <= config.max_wait_s else None
        if images is not None and images.is_waiting(scan):
            return None
        try:
            return self._poses.of(scan, self.waiting[1] if len(self.waiting) > 1 else None)
        except PoseNotYetError as error:
            is_late = isinstance(error, PosesLateError)
            longest_s = max(config.max_wait_s, config.max_delay_s if is_late else 0.0)
            if not self.ended and waited_s <= longest_s:
                return None
            within = 'until the end of the input' if self.ended else f'within {waited_s:.3f} s'
            return f'no pose {within}: {error}'
        except PoseError as error:
            return str(error)


def viewpoint(T_map_sensor: Transform, config: Config) -> Transform | None:
    """Return the position of the sensor; None if unknown, and normals stay as they are."""
    if config.pose.source != 'identity':
        return T_map_sensor[:3, 3]
    position = standing_sensor(config)
    if position is None:
        return None
    moved: npt.NDArray[np.float64] = (T_map_sensor[:3, :3] * position).sum(axis=1)
    return moved + T_map_sensor[:3, 3]


def standing_sensor(config: Config) -> npt.NDArray[np.float64] | None:
    """
    Return where the sensor stands with ``pose.source: identity``, (3,) m in the fixed frame.

    Only ``frames.base_to_sensor`` tells: clouds in the fixed frame may be those of a sensor that
    stands in its origin, or made of the scans of one that moves.
    """
    values = config.frames.base_to_sensor
    if config.pose.source != 'identity' or config.frames.sensors or not values:
        return None
    return np.array(values[:3])
