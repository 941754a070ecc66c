# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Poses of the sensor in the fixed frame at the times of a scan: looked up, or registered.

Extrinsics of the configuration become static transforms when a frame is first seen, so that
lookups need only the tree of frames.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
import math
from typing import Any

from surfel_mapper.arguments import is_unit
from surfel_mapper.config import Config
from surfel_mapper.errors import PoseError
from surfel_mapper.geometry import compose, inverse, pose_matrix, Transform
from surfel_mapper.pipeline.drops import Drops
from surfel_mapper.pipeline.map_origin import MapOrigin
from surfel_mapper.pipeline.registered_poses import RegisteredPoses
from surfel_mapper.poses import MAX_TRANSFORMS, MountChanges, TransformBuffer
from surfel_mapper.poses.buffer import FrameMove
from surfel_mapper.scan import PointTimes, Scan
from surfel_mapper.sensors.deskew import deskewing

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
    registered : RegisteredPoses, optional
        The poses by registration, if ``pose.source`` is ``registration``, or auto chose it.

    """

    def __init__(self, config: Config, drops: Drops, origin: MapOrigin) -> None:
        self._config = config
        self._drops = drops
        self.origin = origin
        self._early: deque[tuple[str, str, int, Transform, bool]] = deque(maxlen=MAX_EARLY)
        self._warned_of_norm = False
        self._sensors: set[str] = set()
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
            reason = f'{number} old transforms dropped: over {MAX_TRANSFORMS} are held'
            self._drops.message('too_many_transforms', reason, number)

    def _note_move(self, move: FrameMove) -> None:
        """Log the move of a frame, if a sensor of earlier scans is mounted on it."""
        fixed, transforms = self._config.frames.fixed, self.transforms
        if self._last_ns is not None and any(
            transforms.is_between(move.child, fixed, sensor) for sensor in self._sensors
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
        fixed = self._config.frames.fixed
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
            self.transforms.add(parent, child, stamp_ns, transform, is_checked=True)

    def mount(self, frame_id: str) -> None:
        """Add the configured extrinsics of a sensor when its frame is first seen."""
        if frame_id in self._sensors:
            return
        if len(self._sensors) >= MAX_SENSORS:
            self._sensors.clear()
            self._configured.clear()
        self._sensors.add(frame_id)
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
        pose = self._at(scan.frame_id, scan.stamp_ns)
        if scan.times is not None:  # the poses of all points have to be there
            first_ns, last_ns = scan.times.first_ns, scan.times.last_ns
            if self.registered is None:
                fixed = self._config.frames.fixed
                self.transforms.check_span(fixed, scan.frame_id, first_ns, last_ns)
            else:
                self._at(scan.frame_id, first_ns)
                self._at(scan.frame_id, last_ns)
        self._last_ns = max(scan.stamp_ns, self._last_ns or 0)
        return pose

    def newest_for(self, frame_id: str) -> int | None:
        """Return the newest stamp of transforms, for the wait for the pose of a sensor."""
        return self.transforms.newest_beside(self._config.frames.fixed, frame_id)

    def deskewing(self, scan: Scan, times: PointTimes) -> Callable[[], Scan]:
        """Look up the poses within a sweep; return the function that deskews the scan."""
        fixed, sensor = self._config.frames.fixed, scan.frame_id
        stamps = self.transforms.stamps(fixed, sensor, times.first_ns, times.last_ns)
        min_range_m = self._config.input.min_range_m
        return deskewing(scan, partial(self._at, sensor), stamps, min_range_m)

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
        return self.transforms.lookup(self._config.frames.fixed, frame_id, stamp_ns)
