# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Poses out of the scans themselves: each scan is aligned to the map that those before it made.

What is followed is the base where it is known how the sensor sits on it, so that several sensors
serve one track; else the sensor itself.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from surfel_mapper.alignment.registration import Alignment, Registration
from surfel_mapper.alignment.tracking import Tracker
from surfel_mapper.config import Config
from surfel_mapper.counters import LATEST
from surfel_mapper.errors import PoseError
from surfel_mapper.geometry import compose, pose_matrix, Transform
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.poses import TransformBuffer
from surfel_mapper.scan import Scan


class RegisteredPoses:
    """
    Where the sensors are, found by registration.

    Parameters
    ----------
    config : Config
        Its ``registration``, ``input`` and ``frames``.
    transforms : TransformBuffer
        How sensors sit on the robot.

    Attributes
    ----------
    body : str
        The frame that is followed; empty before the first scan.

    """

    def __init__(self, config: Config, transforms: TransformBuffer) -> None:
        """Start where the settings say, at rest."""
        self._config = config
        self._transforms = transforms
        self._registration = Registration(config.registration, config.map.voxel_size_m)
        start = config.registration.start
        self._start = pose_matrix(start[:3], start[3:]) if start else np.eye(4)
        self._tracker = Tracker(self._registration, self._start)
        self.body = ''
        self._num_aligned = self._num_degenerate = 0
        self._fits: deque[float] = deque(maxlen=LATEST)

    def reconfigure(self, config: Config) -> None:
        """Take new settings from the next scan on."""
        self._config = config
        self._registration.config = config.registration

    def warm_up(self) -> None:
        """Compile the kernels, for both types that points may have."""
        for dtype in (np.float32, np.float64):
            points = np.random.default_rng(0).uniform(-1.0, 1.0, (100, 3)).astype(dtype)
            surfel_map = SurfelMap(self._config.map.voxel_size_m)
            surfel_map.add(points)
            cells = self._registration.cells(points)
            self._registration.align(cells, surfel_map, [np.eye(4)], 1e3, 2.0)

    def restart(self, T_fixed_body: Transform | None = None) -> None:
        """Go on from a pose, or from where the settings say."""
        self._tracker.restart(self._start if T_fixed_body is None else T_fixed_body)

    def predict(self, frame_id: str, stamp_ns: int) -> Transform:
        """
        Return T_fixed_sensor at a time; at the stamp of the last scan that is where it was.

        Raises
        ------
        PoseError
            If it is not known how the sensor sits on what is followed.

        """
        return compose(self._tracker.predict(stamp_ns), self._mount(frame_id, stamp_ns))

    def find(
        self, scan: Scan, surfel_map: SurfelMap, T_map_fixed: Transform
    ) -> Alignment | None:
        """
        Align a scan and go on from there; ``predict`` says then where its sensor was.

        Parameters
        ----------
        scan : Scan
            Deskewed and filtered.
        surfel_map : SurfelMap
            The map. While it is empty the prediction holds, and None is returned.
        T_map_fixed : (4, 4) float64
            From the frame of the poses to that of the map.

        Raises
        ------
        AlignmentError
            If the scan does not fit the map.
        PoseError
            If it is not known how the sensor sits on what is followed.

        """
        if not surfel_map.num_voxels:
            self._tracker.advance(self._tracker.predict(scan.stamp_ns), scan.stamp_ns)
            return None
        limits = self._config.input
        cells = self._registration.cells(
            scan.points, limits.min_range_m, limits.max_range_m or np.inf
        )
        mount = self._mount(scan.frame_id, scan.stamp_ns)
        cells = np.ascontiguousarray(cells @ mount[:3, :3].T + mount[:3, 3])
        found = self._tracker.track(cells, scan.stamp_ns, surfel_map, T_map_fixed)
        self._num_aligned += 1
        self._num_degenerate += len(found.degenerate) > 0
        self._fits.append(found.fit)
        return found

    def summary(self) -> dict[str, Any]:
        """Return how well scans fitted, for files and reports."""
        fits = list(self._fits) or [float('nan')]
        return {
            'body': self.body,
            'aligned': self._num_aligned,
            'degenerate': self._num_degenerate,
            'fit': {'median': float(np.median(fits)), 'min': float(np.min(fits))},
        }

    def _mount(self, frame_id: str, stamp_ns: int) -> Transform:
        """Return T_body_sensor; the first scan decides what is followed."""
        if not self.body:
            try:
                mount = self._transforms.lookup(self._config.frames.base, frame_id, stamp_ns)
            except PoseError:
                self.body = frame_id
                return np.eye(4)
            self.body = self._config.frames.base
            return mount
        return self._transforms.lookup(self.body, frame_id, stamp_ns)
