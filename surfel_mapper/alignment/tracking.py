# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Tracking: the pose of scan after scan, each predicted from those before.

The sensor is taken to go on as it moved between the last two scans. By how much that was wrong
lately decides how far the next alignment looks and how much of what is off it believes.

Source: Vizzo et al. 2023 (KISS-ICP) for the threshold out of deviations.
"""

from __future__ import annotations

from collections import deque
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.registration import Alignment, Registration
from surfel_mapper.geometry import (
    compose,
    inverse,
    rotation_angle,
    se3_exp,
    se3_log,
    Transform,
)
from surfel_mapper.mapping.surfel_map import SurfelMap

REMEMBERED = 10
"""Deviations of so many scans are remembered."""

EXPECTED_FIT = 0.85
"""A scan that fits less than this share of what is usual may be in the wrong place."""

FLOOR_NOISES = 3.0
"""No deviation is taken to be less than so many standard deviations of a range."""


class Tracker:
    """
    Follows a sensor on a map.

    Parameters
    ----------
    registration : Registration
        Aligns the scans.
    start : (4, 4) float64
        T_map_sensor of the first scan.

    """

    def __init__(self, registration: Registration, start: Transform) -> None:
        """Begin at a pose, with nothing known of the motion."""
        self._registration = registration
        self.restart(start)

    def restart(self, T_map_sensor: Transform) -> None:
        """Go on from a pose, with nothing known of the motion."""
        self._pose = T_map_sensor
        self._stamp_ns: int | None = None
        self._twist = np.zeros(6)
        self._deviations: deque[float] = deque(maxlen=REMEMBERED)
        self._fits: deque[float] = deque(maxlen=REMEMBERED)

    def predict(self, stamp_ns: int) -> Transform:
        """Return where the sensor is at a stamp, if it goes on as before."""
        if self._stamp_ns is None:
            return self._pose
        step = se3_exp(self._twist * ((stamp_ns - self._stamp_ns) / 1e9))
        return compose(self._pose, step)

    @property
    def deviation_m(self) -> float:
        """How far from the prediction points may be: what it lately was."""
        config = self._registration.config
        if not self._deviations:
            return config.max_deviation_m
        mean_sq = sum(deviation**2 for deviation in self._deviations) / len(self._deviations)
        return max(math.sqrt(mean_sq), FLOOR_NOISES * config.noise_m)

    def align(
        self, cells: npt.NDArray[np.float64], stamp_ns: int, surfel_map: SurfelMap
    ) -> Alignment:
        """
        Return where a scan belongs, without going on; see Registration.align.

        Parameters
        ----------
        cells : (K, 3) float64, m
            Of the scan, in the sensor frame.
        stamp_ns : int
            Its time.
        surfel_map : SurfelMap
            The map.

        """
        starts = [self.predict(stamp_ns)]
        if self._stamp_ns is not None:
            starts.append(self._pose)
        usual = sorted(self._fits)[len(self._fits) // 2] if self._fits else 0.0
        expected = EXPECTED_FIT * usual
        return self._registration.align(cells, surfel_map, starts, self.deviation_m, expected)

    def advance(
        self, T_map_sensor: Transform, stamp_ns: int, reach_m: float = 0.0, fit: float = 0.0
    ) -> None:
        """
        Go on from where a scan was found.

        Parameters
        ----------
        T_map_sensor : (4, 4) float64
            Its pose.
        stamp_ns : int
            Its time.
        reach_m : float
            How far away what it saw is, by which a wrong turn counts.
        fit : float
            Of its alignment.

        """
        if self._stamp_ns is not None:
            self._fits.append(fit)
            off = compose(inverse(self.predict(stamp_ns)), T_map_sensor)
            turned_m = 2.0 * reach_m * math.sin(0.5 * rotation_angle(off))
            self._deviations.append(math.hypot(*off[:3, 3], turned_m))
            motion = compose(inverse(self._pose), T_map_sensor)
            self._twist = se3_log(motion) / ((stamp_ns - self._stamp_ns) / 1e9)
        self._pose, self._stamp_ns = T_map_sensor, stamp_ns
