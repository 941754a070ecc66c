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
from dataclasses import replace
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.companions import companions, LEAST_ACROSS_M, LEAST_SHARE
from surfel_mapper.alignment.registration import (
    Registration,
    RegistrationResult,
    thinned,
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

MORE_SEEN_THROUGH = 0.08
"""A scan contradicts the map if it sees through more of it than the scan before, by this share."""

JUMP, BETTER_PLACE = 3.0, 1.5
"""A place that a search found that far from the prediction, in expected deviations, has to be
better than the place expected, by this factor of the score: 1.7 and more in real halls. Of 24
wrong places in simulated rooms 13 were below; 5 more explained less and were degenerate."""

CORRECTED_M = 0.2
"""A correction of the prediction that puts poses in doubt if motion is or was undetermined, m."""

FIRST_SUPPORT = 0.35
"""Minimum support before there are recent scans: real scans of a hall that a hand turned by 90 deg
fit the scan before to 0.5."""

BETTER = 0.05
"""Share of the cells that a pose without companions has to explain beyond that of all cells, if
the scan before had none."""

COMPARED_CELLS = 2000
"""Number of cells that tell the share of companions; all cells took 3 ms more a scan."""

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
    has_jumped : bool
        The last scan is far from its prediction and not certain: it or the scan before it did not
        determine all directions of motion, or the prediction fitted about as well.
    is_far : bool
        The last scan was refused because it is far from the prediction, which fits about as well.
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
        self.has_jumped = self.is_far = False
        self._has_companions = self._is_degenerate = False
        self._clear_history()

    def begin(self, stamp_ns: int, twist: npt.NDArray[np.float64]) -> None:
        """Set the initial stamp and velocity (6,), m/s and rad/s."""
        self._stamp_ns, self.twist = stamp_ns, twist

    def resume(
        self,
        T_fixed_body: Transform,
        stamp_ns: int,
        twist: npt.NDArray[np.float64],
        cells: npt.NDArray[np.float64],
        has_jumped: bool,
    ) -> None:
        """Continue from the pose of a scan with its cells and a velocity (6,), m/s and rad/s."""
        self.has_jumped = has_jumped
        self.pose, self._cells = T_fixed_body, cells
        self._clear_history()
        self.begin(stamp_ns, twist)

    def _clear_history(self) -> None:
        self._deviations: deque[float] = deque(maxlen=REMEMBERED)
        self._supports: deque[float] = deque(maxlen=REMEMBERED)

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
            If the scan does not fit the map, fits it at two places about equally well, or fits
            too poorly to be accepted at once (see ``doubtful``). The predicted velocity is halved
            then.

        """
        predicted, is_moving = self.predict(stamp_ns), self.twist.any()
        starts = [compose(T_map_fixed, predicted)]
        if self._stamp_ns is not None:
            starts.append(compose(T_map_fixed, self.pose))
        expected = self.expected_support
        result = self._registration.align(cells, surfel_map, starts, self.deviation_m, expected)
        if len(result.degenerate) and not is_moving:  # no motion is known yet
            result = self._registration.determined(result, cells, surfel_map, starts)
        result = self._without_companions(result, cells, surfel_map, starts)
        is_usual = bool(self._supports) and result.support >= expected > 0.0
        is_steady = result.converged or is_usual
        is_ambiguous = result.rival > 0.0
        self.num_ambiguous += is_ambiguous and is_steady
        pose = compose(inverse(T_map_fixed), result.T_map_sensor)
        refusal = self._refusal(result, is_steady)
        self.doubtful, self.is_far = None, False
        reach_m = math.sqrt(float((cells**2).sum()) / max(len(cells), 1))
        if not refusal:
            off_m = self._off_m(pose, stamp_ns, reach_m)
            refusal = self._doubt(result, surfel_map, T_map_fixed, off_m)
        if refusal:
            self.has_jumped = False
            self._deviations.clear()
            self.twist = 0.5 * self.twist  # after several failures the prediction is at rest
            raise AlignmentError(refusal)
        self._supports.append(result.support)
        self._has_companions = result.companions >= LEAST_SHARE
        self._cells = cells
        was_degenerate, self._is_degenerate = self._is_degenerate, len(result.degenerate) > 0
        is_undetermined = is_moving and (was_degenerate or self._is_degenerate)
        is_corrected = math.hypot(*compose(inverse(predicted), pose)[:3, 3]) >= CORRECTED_M
        is_far = off_m > self._registration.config.max_deviation_m and not self._is_better(result)
        self.has_jumped = (is_undetermined and is_corrected) or is_far
        self.advance(pose, stamp_ns, reach_m)
        return result

    def _without_companions(
        self,
        result: RegistrationResult,
        cells: npt.NDArray[np.float64],
        surfel_map: SurfelMap,
        starts: list[Transform],
    ) -> RegistrationResult:
        """
        Return the result, or a rival without the cells that move along if that explains more.

        If most surroundings move along, they agree with the map at a wrong pose. The rival goes on
        as predicted: its companions explain themselves, and the other cells have to fit the map.
        """
        some, size_m = thinned(cells, COMPARED_CELLS), surfel_map.voxel_size_m
        share = float(self._companions(some, starts, starts[0], size_m).mean())
        if share >= LEAST_SHARE:
            moves = self._companions(cells, starts, starts[0], size_m)
            share = float(moves.mean())
            standing = np.ascontiguousarray(cells[~moves])
            rival = self._registration.align(standing, surfel_map, starts[:1], self.deviation_m)
            rival = replace(rival, overlap=(1.0 - share) * rival.overlap, companions=share)
            better = 0.0 if self._has_companions else BETTER
            if rival.converged and share + rival.support > result.support + better:
                return rival
        off = compose(inverse(starts[0]), result.T_map_sensor)
        if math.hypot(*off[:3, 3], result.radius_m * rotation_angle(off)) >= LEAST_ACROSS_M:
            share = float(self._companions(some, starts, result.T_map_sensor, size_m).mean())
        return replace(result, companions=share)

    def _companions(
        self,
        cells: npt.NDArray[np.float64],
        starts: list[Transform],
        T_map_body: Transform,
        voxel_size_m: float,
    ) -> npt.NDArray[np.bool_]:
        """Return which cells move along if the body is at a pose; none without a scan before."""
        if self._cells is None or len(starts) < 2:
            return np.zeros(len(cells), bool)
        motion = compose(inverse(starts[1]), T_map_body)
        noise_m = self._registration.config.noise_m
        return companions(cells, self._cells, motion, voxel_size_m, noise_m)

    @property
    def expected_support(self) -> float:
        """Share of the cells of a scan that should fit, from recent scans."""
        if not self._supports:
            return FIRST_SUPPORT
        return EXPECTED_SUPPORT * sorted(self._supports)[len(self._supports) // 2]

    def max_seen_through(self, surfel_map: SurfelMap, T_map_fixed: Transform) -> float:
        """Return the share of the map that the last scan sees through, and MORE_SEEN_THROUGH."""
        if self._cells is None:
            return MORE_SEEN_THROUGH
        T_map_body = compose(T_map_fixed, self.pose)
        share = self._registration.seen_through(self._cells, surfel_map, T_map_body)
        return share + MORE_SEEN_THROUGH

    def _shares(self, result: RegistrationResult) -> str:
        """Return the quality of the fit of a scan, in words."""
        return (
            f'{result.overlap:.0%} of its {result.num_cells} cells meet a surfel and '
            f'{result.fit:.0%} of these fit it'
        )

    def _refusal(self, result: RegistrationResult, is_steady: bool) -> str:
        """Return the reason why a scan is rejected; empty if it is not."""
        config = self._registration.config
        said = self._shares(result)
        if result.rival > 0.0:
            return (
                f'{said}, but another place fits {result.rival / max(result.support, 1e-9):.0%} '
                'as well: its pose is ambiguous'
            )
        if not self._registration.fits(result):
            return (
                f'{said}, expected {config.min_overlap_ratio:.0%} and {config.min_fit_ratio:.0%}'
            )
        if not is_steady:
            return f'{said}, but its pose has not settled'
        return ''

    def _doubt(
        self,
        result: RegistrationResult,
        surfel_map: SurfelMap,
        T_map_fixed: Transform,
        off_m: float,
    ) -> str:
        """Return why the next scans have to agree with a place; empty if they need not."""
        expected = self.expected_support
        is_clear = result.fit >= CLEAR_FIT  # a new place has a small overlap, but fits
        is_poor = bool(self._supports) and result.support < POOR_SUPPORT * expected
        is_unusual = result.is_found and result.support < expected
        doubt = ''
        share = result.seen_through
        if share > MORE_SEEN_THROUGH and share > self.max_seen_through(surfel_map, T_map_fixed):
            doubt = f'it sees through {share:.0%} of the map in view'
        elif (is_poor or is_unusual) and not is_clear:
            doubt = f'usually {expected / EXPECTED_SUPPORT:.0%} in all'
        elif off_m > JUMP * self.deviation_m and not self._is_better(result):
            self.is_far = True
            return (
                f'{self._shares(result)}, {off_m:.2f} m from the expected pose, which fits about '
                'as well'
            )
        if not doubt:
            return ''
        self.doubtful = result.T_map_sensor
        return f'{self._shares(result)}, {doubt}: the next scans have to agree'

    def _is_better(self, result: RegistrationResult) -> bool:
        """Return whether a place is much better than the expected one, if a search found it."""
        expected = result.expected
        if expected is None or not expected.converged:
            return True
        explains_more = result.support >= expected.support or not len(result.degenerate)
        return explains_more and result.score >= BETTER_PLACE * expected.score

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
            self._deviations.append(self._off_m(T_fixed_body, stamp_ns, reach_m))
            motion = compose(inverse(self.pose), T_fixed_body)
            self.twist = se3_log(motion) / ((stamp_ns - self._stamp_ns) / 1e9)
        self.pose, self._stamp_ns = T_fixed_body, stamp_ns

    def _off_m(self, T_fixed_body: Transform, stamp_ns: int, reach_m: float) -> float:
        """Return the distance of points from the prediction at a pose, m: root mean square."""
        off = compose(inverse(self.predict(stamp_ns)), T_fixed_body)
        turned_m = 2.0 * reach_m * math.sin(0.5 * rotation_angle(off))
        return math.hypot(*off[:3, 3], turned_m)
