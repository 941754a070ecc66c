# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Tracking: the pose of scan after scan, each predicted from the previous ones.

The body that carries the sensor is assumed to continue its motion between the last two scans. The
recent errors of this prediction determine the search distance and the width of the robust kernel
of the next alignment; the recent shares of fitting cells determine whether the next result is
accepted. A place that only a search found, and that fits worse than usual, is not accepted at
once: pipeline/map_part.py waits for the next scans to agree.

Source: Vizzo et al. 2023 (KISS-ICP) for the adaptive threshold.
"""

from __future__ import annotations

from collections import deque
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.registration import (
    determines,
    Registration,
    RegistrationResult,
)
from surfel_mapper.errors import AlignmentError
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
"""Number of scans whose deviations and supports are kept."""

EXPECTED_SUPPORT = 0.85
"""Minimum support of a scan, as a share of the median support of recent scans."""

POOR_SUPPORT = 0.6
"""Share of the expected support below which a scan is not accepted at once wherever it fits."""

CLEAR_FIT = 0.8
"""A scan of small overlap that fits so well sees a new place: .97 there, .78 at wrong places."""

FIRST_SUPPORT = 0.35
"""Minimum support before there are recent scans: real scans of a hall that a hand turned by 90 deg
fit the scan before to 0.5."""

MAX_DECELERATION = 10.0
"""Deceleration of a vehicle that brakes as hard as it can, m/s^2."""

LONGEST_UNTOLD_S = 5.0
"""Time for which the velocity alone may tell the motion while much of a scan moves along, s:
the stretches among nine trucks are shorter, and errors reach 1 m in them."""

FLOOR_NOISES = 3.0
"""Minimum expected deviation, in standard deviations of a range."""


class Tracker:
    """
    Tracks a sensor, or the body that carries it, on a map.

    Parameters
    ----------
    registration : Registration
        Aligns the scans.
    start : (4, 4) float64
        Initial pose.

    Attributes
    ----------
    pose : (4, 4) float64
        The last T_fixed_body.
    twist : (6,) float64
        The last velocity, m/s and rad/s, in the frame of the body.
    num_ambiguous : int
        Number of scans that fitted the map at two places.
    doubtful : (4, 4) float64, optional
        T_map_body of the last scan, if it was refused although it fits there: a search found the
        place and it fits worse than usual, or it fits much worse than usual.

    """

    def __init__(self, registration: Registration, start: Transform) -> None:
        self._registration = registration
        self.num_ambiguous = 0
        self.doubtful: Transform | None = None
        self.restart(start)

    def restart(self, T_fixed_body: Transform) -> None:
        """Continue from a pose, at rest."""
        self.pose = T_fixed_body
        self.twist: npt.NDArray[np.float64] = np.zeros(6)
        self._stamp_ns: int | None = None
        self._cells: npt.NDArray[np.float64] | None = None
        self._clear_history()

    def begin(self, stamp_ns: int, twist: npt.NDArray[np.float64]) -> None:
        """Set the initial stamp and velocity (6,), m/s and rad/s."""
        self._stamp_ns, self.twist = stamp_ns, twist

    def resume(
        self, T_fixed_body: Transform, stamp_ns: int, twist: npt.NDArray[np.float64]
    ) -> None:
        """Continue from a pose at a stamp with a velocity (6,), m/s and rad/s."""
        self.pose = T_fixed_body
        self._clear_history()
        self.begin(stamp_ns, twist)

    def _clear_history(self) -> None:
        self._deviations: deque[float] = deque(maxlen=REMEMBERED)
        self._supports: deque[float] = deque(maxlen=REMEMBERED)
        self._told_ns: int | None = None

    @property
    def is_new(self) -> bool:
        """Whether no scan was tracked since the last restart."""
        return self._stamp_ns is None

    def predict(self, stamp_ns: int) -> Transform:
        """Return T_fixed_body at a stamp, assuming constant velocity."""
        if self._stamp_ns is None:
            return self.pose
        step = se3_exp(self.twist * ((stamp_ns - self._stamp_ns) / 1e9))
        return compose(self.pose, step)

    @property
    def deviation_m(self) -> float:
        """Expected distance of points from the prediction, m: the recent root mean square."""
        config = self._registration.config
        if not self._deviations:
            return config.max_deviation_m
        mean_sq = sum(deviation**2 for deviation in self._deviations) / len(self._deviations)
        return max(math.sqrt(mean_sq), FLOOR_NOISES * config.noise_m)

    def track(
        self,
        cells: npt.NDArray[np.float64],
        stamp_ns: int,
        surfel_map: SurfelMap,
        T_map_fixed: Transform,
    ) -> RegistrationResult:
        """
        Align a scan, and continue from its pose.

        Parameters
        ----------
        cells : (K, 3) float64, m
            Cells of the scan, in the frame of the body.
        stamp_ns : int
            Its time, after that of the previous scan.
        surfel_map : SurfelMap
            The map.
        T_map_fixed : (4, 4) float64
            From the fixed frame to the frame of the map.

        Raises
        ------
        AlignmentError
            If the scan does not fit the map, fits it at two places about equally well, needs a
            motion faster than ``max_speed_m_s``, fits too poorly to be accepted at
            once (see ``doubtful``), or if much of it moves along and for LONGEST_UNTOLD_S
            nothing else has told the motion. The predicted velocity is halved then.

        """
        starts = [compose(T_map_fixed, self.predict(stamp_ns))]
        if self._stamp_ns is not None:
            starts.append(compose(T_map_fixed, self.pose))
        expected = self.expected_support
        before = self._cells if self._surely_moves(stamp_ns) else None
        self._cells = cells
        found = self._registration.align(
            cells, surfel_map, starts, self.deviation_m, expected, before=before
        )
        is_usual = bool(self._supports) and found.support >= expected > 0.0
        is_steady = found.converged or is_usual
        is_ambiguous = found.rival > 0.0
        self.num_ambiguous += is_ambiguous and is_steady
        pose = compose(inverse(T_map_fixed), found.T_map_sensor)
        refusal = self._refusal(found, is_steady, self.speed_m_s(pose, stamp_ns))
        refusal = refusal or self._untold(found, starts, stamp_ns)
        self.doubtful = None
        is_poor = bool(self._supports) and found.support < POOR_SUPPORT * expected
        is_poor = is_poor and found.fit < CLEAR_FIT  # a new place has a small overlap, but fits
        if not refusal and (is_poor or (found.is_found and found.support < expected)):
            self.doubtful = found.T_map_sensor
            refusal = (
                f'{self._shares(found)}, usually {expected / EXPECTED_SUPPORT:.0%} in all: '
                'the next scans have to agree'
            )
        if refusal:
            self._deviations.clear()
            self.twist = 0.5 * self.twist  # after several failures the prediction is at rest
            raise AlignmentError(refusal)
        self._supports.append(found.support)
        self.advance(pose, stamp_ns, math.sqrt(float((cells**2).sum()) / max(len(cells), 1)))
        if found.has_stopped:
            self.twist = np.zeros(6)
        return found

    def _surely_moves(self, stamp_ns: int) -> bool:
        """Return whether the body moves on by a cell at least: it cannot have stopped."""
        if self._stamp_ns is None:
            return False
        since_s = (stamp_ns - self._stamp_ns) / 1e9
        least_m = max(self._registration.cell_m, MAX_DECELERATION * since_s**2)
        return float(np.linalg.norm(self.twist[:3])) * since_s >= least_m

    @property
    def expected_support(self) -> float:
        """Share of the cells of a scan that should fit, from recent scans."""
        if not self._supports:
            return FIRST_SUPPORT
        return EXPECTED_SUPPORT * sorted(self._supports)[len(self._supports) // 2]

    def speed_m_s(self, T_fixed_body: Transform, stamp_ns: int) -> float:
        """Return the speed that a pose requires since the last scan; 0 without one."""
        if self._stamp_ns is None or stamp_ns <= self._stamp_ns:
            return 0.0
        distance_m = math.dist(T_fixed_body[:3, 3], self.pose[:3, 3])
        return distance_m / ((stamp_ns - self._stamp_ns) / 1e9)

    def _shares(self, found: RegistrationResult) -> str:
        """Return the quality of the fit of a scan, in words."""
        return (
            f'{found.overlap:.0%} of its {found.num_cells} cells meet a surfel and '
            f'{found.fit:.0%} of these fit it'
        )

    def _refusal(self, found: RegistrationResult, is_steady: bool, speed_m_s: float) -> str:
        """Return the reason why a scan is rejected; empty if it is not."""
        config = self._registration.config
        said = self._shares(found)
        if found.rival > 0.0:
            return (
                f'{said}, but another place fits {found.rival / max(found.support, 1e-9):.0%} as '
                'well: its pose is ambiguous'
            )
        if not self._registration.fits(found):
            return (
                f'{said}, expected {config.min_overlap_ratio:.0%} and {config.min_fit_ratio:.0%}'
            )
        if not is_steady:
            return f'{said}, but its pose has not settled'
        if speed_m_s > config.max_speed_m_s:
            return (
                f'{said}, but {speed_m_s:.0f} m/s lead there, expected at most '
                f'{config.max_speed_m_s:g}'
            )
        return ''

    def _untold(self, found: RegistrationResult, starts: list[Transform], stamp_ns: int) -> str:
        """Return since when nothing has told the motion, as a reason; empty if not for long."""
        is_told = not found.moving_along or determines(found, starts)
        if is_told or self._told_ns is None:
            self._told_ns = stamp_ns
        since_s = (stamp_ns - self._told_ns) / 1e9
        if since_s <= LONGEST_UNTOLD_S:
            return ''
        return (
            f'{found.moving_along:.0%} of it moves along, and for {since_s:.1f} s nothing that '
            'stands has told the motion'
        )

    def advance(self, T_fixed_body: Transform, stamp_ns: int, reach_m: float = 0.0) -> None:
        """
        Continue from a known pose, and update velocity and deviations.

        Parameters
        ----------
        T_fixed_body : (4, 4) float64
            The pose.
        stamp_ns : int
            Its stamp.
        reach_m : float
            Root mean square distance of the points, which scales rotational errors.

        """
        if self._stamp_ns is not None and stamp_ns > self._stamp_ns:
            off = compose(inverse(self.predict(stamp_ns)), T_fixed_body)
            turned_m = 2.0 * reach_m * math.sin(0.5 * rotation_angle(off))
            self._deviations.append(math.hypot(*off[:3, 3], turned_m))
            motion = compose(inverse(self.pose), T_fixed_body)
            self.twist = se3_log(motion) / ((stamp_ns - self._stamp_ns) / 1e9)
        self.pose, self._stamp_ns = T_fixed_body, stamp_ns
