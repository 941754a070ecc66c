# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Poses by registration: each scan is aligned to the map of the scans before it.

The track is that of the base if the mount of the sensor on it is known, so that several sensors
share one track; otherwise that of the sensor itself.
"""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.registration import Registration, RegistrationResult
from surfel_mapper.alignment.tracking import Tracker
from surfel_mapper.config import Config
from surfel_mapper.counters import LATEST
from surfel_mapper.errors import AlignmentError, PoseError, PoseNotYetError
from surfel_mapper.geometry import compose, inverse, pose_matrix, Transform
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.poses import TransformBuffer
from surfel_mapper.scan import PointTimes, Scan


class RegisteredPoses:
    """
    The poses of the sensors, found by registration.

    Parameters
    ----------
    config : Config
        Its ``registration``, ``input`` and ``frames``.
    transforms : TransformBuffer
        Mounts of the sensors on the robot.

    Attributes
    ----------
    body : str
        The tracked frame; empty before the first scan.
    T_fixed_body : (4, 4) float64
        Its pose at the stamp of the last scan.

    """

    def __init__(self, config: Config, transforms: TransformBuffer) -> None:
        self._config = config
        self._transforms = transforms
        self._registration = Registration(config.registration, config.map.voxel_size_m)
        start = config.registration.start
        self._start = pose_matrix(start[:3], start[3:]) if start else np.eye(4)
        self._tracker = Tracker(self._registration, self._start)
        self.body = ''
        self.T_fixed_body = self._start
        self._num_aligned = self._num_degenerate = 0
        self._fits: deque[float] = deque(maxlen=LATEST)

    def reconfigure(self, config: Config) -> None:
        """Take new settings from the next scan on."""
        self._config = config
        self._registration.config = config.registration

    @property
    def twist(self) -> npt.NDArray[np.float64]:
        """Velocity of the tracked frame, (6,) m/s and rad/s, in that frame."""
        return self._tracker.twist

    def warm_up(self) -> None:
        """Compile the kernels, for both types that points may have."""
        for dtype in (np.float32, np.float64):
            points = np.random.default_rng(0).uniform(-1.0, 1.0, (100, 3)).astype(dtype)
            surfel_map = SurfelMap(self._config.map.voxel_size_m)
            surfel_map.add(points)
            cells = self._registration.cells(points)
            self._registration.align(cells, surfel_map, [np.eye(4)], 1e3, 2.0)

    def restart(self, T_fixed_body: Transform | None = None) -> None:
        """Go on from a pose, by default the one of registration.start."""
        self._tracker.restart(self._start if T_fixed_body is None else T_fixed_body)

    def learn_motion(self, scan: Scan, following: Scan | None) -> None:
        """
        Estimate the velocity for deskewing the first scan, from the scan after it.

        Both are skewed alike, so the motion between them is right; but if the first were mapped
        without deskewing, later scans would not fit it.

        Raises
        ------
        PoseNotYetError
            If the scan after it is not there yet.

        """
        if scan.times is None or not self._tracker.is_new:
            return
        if following is None:
            raise PoseNotYetError('the first scan waits for the next, to be deskewed')
        surfel_map = SurfelMap(self._config.map.voxel_size_m)
        surfel_map.insert(self._moments(scan, surfel_map))
        trial = Tracker(self._registration, np.eye(4))
        trial.advance(np.eye(4), scan.stamp_ns)
        with suppress(AlignmentError, PoseError):  # else it is taken to be at rest
            trial.track(self._cells(following), following.stamp_ns, surfel_map, np.eye(4))
        self._tracker.begin(scan.stamp_ns, trial.twist)

    def predict(self, frame_id: str, stamp_ns: int) -> Transform:
        """
        Return T_fixed_sensor at a time, if the motion goes on as before.

        Raises
        ------
        PoseError
            If the mount of the sensor on the tracked frame is unknown.

        """
        return compose(self._tracker.predict(stamp_ns), self._mount(frame_id, stamp_ns))

    def find(
        self,
        scan: Scan,
        times: PointTimes | None,
        surfel_map: SurfelMap,
        T_map_fixed: Transform,
    ) -> tuple[Transform, RegistrationResult | None]:
        """
        Align a scan to the map, and continue the track from its pose.

        Parameters
        ----------
        scan : Scan
            Deskewed and filtered.
        times : PointTimes, optional
            Times of its points, if it was deskewed.
        surfel_map : SurfelMap
            The map; if it is empty the prediction is used.
        T_map_fixed : (4, 4) float64
            From the frame of the poses to that of the map.

        Returns
        -------
        T_fixed_sensor : (4, 4) float64
            Pose of the sensor at the stamp.
        registration : RegistrationResult or None
            None if the map is empty and the prediction is used.

        Raises
        ------
        AlignmentError
            If the scan does not fit the map.
        PoseError
            If the mount of the sensor on the tracked frame is unknown.

        """
        tracker = self._tracker
        # Deskewed by a velocity that is off, a sweep is right in its middle and off at both
        # ends: followed at its stamp, which is one of them, pose and velocity would swing.
        middle_ns = (times.first_ns + times.last_ns) // 2 if times else scan.stamp_ns
        T_fixed_middle = tracker.predict(middle_ns)
        T_middle_body = compose(inverse(T_fixed_middle), tracker.predict(scan.stamp_ns))
        if surfel_map.num_voxels:
            cells = transformed(T_middle_body, self._cells(scan))
            registration = tracker.track(cells, middle_ns, surfel_map, T_map_fixed)
            self._num_aligned += 1
            self._num_degenerate += len(registration.degenerate) > 0
            self._fits.append(registration.fit)
        else:
            registration = None
            tracker.advance(T_fixed_middle, middle_ns)
        self.T_fixed_body = compose(tracker.pose, T_middle_body)
        pose = compose(self.T_fixed_body, self._mount(scan.frame_id, scan.stamp_ns))
        return pose, registration

    def summary(self) -> dict[str, Any]:
        """Return figures of the fit of the scans, for files and reports."""
        fits = list(self._fits) or [float('nan')]
        return {
            'body': self.body,
            'aligned': self._num_aligned,
            'degenerate': self._num_degenerate,
            'ambiguous': self._tracker.num_ambiguous,
            'fit': {'median': float(np.median(fits)), 'min': float(np.min(fits))},
        }

    def _cells(self, scan: Scan) -> npt.NDArray[np.float64]:
        """Return the cells of a scan in the tracked frame."""
        limits = self._config.input
        cells = self._registration.cells(
            scan.points, limits.min_range_m, limits.max_range_m or np.inf
        )
        return transformed(self._mount(scan.frame_id, scan.stamp_ns), cells)

    def _moments(self, scan: Scan, surfel_map: SurfelMap) -> ScanMoments:
        """Return the moments of a scan in a map about the tracked frame."""
        limits = self._config.input
        return surfel_map.reduce(
            scan.points,
            self._mount(scan.frame_id, scan.stamp_ns),
            min_range_m=limits.min_range_m,
            max_range_m=limits.max_range_m or np.inf,
        )

    def _mount(self, frame_id: str, stamp_ns: int) -> Transform:
        """Return T_body_sensor; the first scan decides which frame is tracked."""
        if not self.body:
            try:
                mount = self._transforms.lookup(self._config.frames.base, frame_id, stamp_ns)
            except PoseError:
                self.body = frame_id
                return np.eye(4)
            self.body = self._config.frames.base
            return mount
        return self._transforms.lookup(self.body, frame_id, stamp_ns)


def transformed(T_a_b: Transform, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return points (K, 3) in frame a."""
    return np.ascontiguousarray(points @ T_a_b[:3, :3].T + T_a_b[:3, 3])
