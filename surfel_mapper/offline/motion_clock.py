# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Offset between the clocks of clouds and of poses, by motion.

Record times do not show it if they are of the same clock as the stamps, or if the poses are in a
file. Pairs of scans from all over a replay are aligned to each other. The poses have the same
motions, at times that are shifted by the offset. A shift is certain only if all others fit worse:
a drive straight on at constant speed has the same motion at all times.
"""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, replace
import logging
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from surfel_mapper.alignment.registration import Registration
from surfel_mapper.files.trajectory import Trajectory
from surfel_mapper.geometry import compose, inverse, Transform
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.offline.pose_sources import PoseTopics
from surfel_mapper.pipeline import Mapper, Update
from surfel_mapper.poses import ClockOffset

if TYPE_CHECKING:
    from surfel_mapper.offline.recording import Recording

_log = logging.getLogger(__name__)

FloatArray = npt.NDArray[np.float64]

PAIRS, LEAST_PAIRS = 24, 12
"""Number of pairs of scans that are aligned, 10 ms each, and the least that tell an offset."""

APART_NS = 950_000_000
"""Least time between the scans of a pair, ns; motions of 0.1 s are hardly above the noise."""

VOXEL_M = 0.5
"""Voxel size of the maps of single scans, m."""

LEAST_OFFSET_S, MOST_OFFSET_S = 0.15, 60.0
"""Limits of an offset, s; scans that are not deskewed are half their duration late."""

STEP_S, FINE_STEP_S = 0.05, 0.005
"""Steps of the search, s."""

ANGLE_RAD, DISTANCE_M, SHARE = 0.005, 0.03, 0.02
"""Standard deviations of the difference of a motion by registration and by odometry, and the share
of the motion that adds to both: odometry has errors of scale."""

MOST_MISFIT = 5.0
"""Limit of the misfit of a motion, in standard deviations, for those that went wrong."""

LEAST_SHARE = 0.67
"""Share of the pairs that the poses have to cover at a shift."""

BETTER = 1.2
"""Least ratio of the misfit without a shift to that with the best."""

SIGMAS, LEAST_WORSE = 4.0, 0.05
"""A shift is worse than the best if the mean difference of their misfits exceeds this number of
its standard errors, and this value, for motions that repeat exactly."""

WRONG, LEAST_WRONG = 3.0, 6
"""Misfit from which on poses have not the motion of their scans, if half of at least this number
of pairs reach it: with right poses a hall has up to 0.4, with a mount turned by 20 deg all 5."""

SAME_S = 1.0
"""Largest difference of shifts that are the same offset, s, if that is less than half of it."""


class MotionClock:
    """
    Motions of the first sensor of a replay, by registration and by poses.

    Parameters
    ----------
    mapper : Mapper
        Maps the scans.
    recording : Recording
        The scans and the poses.

    Attributes
    ----------
    doubt : str
        That the poses have other motions than the scans, at any shift; empty if not.
    is_used : bool
        Whether poses with times come in; not with depth images.

    """

    def __init__(self, mapper: Mapper, recording: Recording) -> None:
        self._mapper, self._recording = mapper, recording
        self.doubt = ''
        poses = recording.poses
        self._path = poses.path if isinstance(poses, PoseTopics) else poses
        config = mapper.config
        is_timed = self._path is None or self._path.has_stamps
        is_given = config.pose.source not in ('identity', 'registration')
        self.is_used = is_timed and is_given and config.input.kind == 'cloud'
        self._registration = Registration(replace(config.registration, search_deg=0.0), VOXEL_M)
        self._every = max(recording.num_scans // PAIRS, 1)
        self._topic = self._frame_id = ''
        self._stamps_ns: list[int] = []
        self._poses: list[Transform] = []
        self._starts: deque[tuple[int, SurfelMap]] = deque()
        self._pairs: list[tuple[int, int]] = []
        self._motions: list[Transform] = []

    def add(self, update: Update) -> None:
        """Note the pose of a scan, and align it to an earlier one if a pair is due."""
        scan, row = update.filtered, len(self._stamps_ns)
        if not self.is_used or update.registration is not None:
            return
        if not row:
            self._topic, self._frame_id = scan.topic, scan.frame_id
        elif scan.frame_id != self._frame_id or update.stamp_ns <= self._stamps_ns[-1]:
            return
        self._stamps_ns.append(update.stamp_ns)
        self._poses.append(update.T_map_sensor)
        while self._starts and self._age_ns(self._starts[0]) >= APART_NS:
            self._align(*self._starts.popleft(), scan.points)
        is_due = not self._starts or self._age_ns(self._starts[-1]) >= APART_NS // 2
        if is_due and row % self._every == 0:
            surfel_map = SurfelMap(VOXEL_M)
            low_m, high_m = self._range_m
            moments = surfel_map.reduce(scan.points, min_range_m=low_m, max_range_m=high_m)
            surfel_map.insert(moments)
            self._starts.append((row, surfel_map))

    def _age_ns(self, start: tuple[int, SurfelMap]) -> int:
        """Return the time from the first scan of a pair to the newest scan, ns."""
        return self._stamps_ns[-1] - self._stamps_ns[start[0]]

    @property
    def _range_m(self) -> tuple[float, float]:
        """Range of the points that are mapped, m."""
        limits = self._mapper.config.input
        return limits.min_range_m, limits.max_range_m or np.inf

    def _align(self, start: int, surfel_map: SurfelMap, points: npt.NDArray[np.float32]) -> None:
        """Align the newest scan to the map of an earlier one; keep a motion that is certain."""
        cells = self._registration.cells(points, *self._range_m)
        guess = compose(inverse(self._poses[start]), self._poses[-1])
        result = self._registration.align(cells, surfel_map, [guess], VOXEL_M)
        is_certain = result.converged and self._registration.fits(result) and not result.rival
        if is_certain and not len(result.degenerate):
            self._pairs.append((start, len(self._poses) - 1))
            self._motions.append(result.T_map_sensor)

    def offsets(self) -> list[dict[str, Any]]:
        """Return the offsets by record times, else that by motion, for the summary."""
        described = self._recording.describe()
        by_times: list[dict[str, Any]] = described.get('clock_offsets', [])
        if by_times or len(self._pairs) < LEAST_WRONG:
            return by_times
        posed = self._posed_motions()
        shift_s = posed.shift_s() if len(self._pairs) >= LEAST_PAIRS else None
        if shift_s is None:
            num_wrong = int((posed.misfits(np.zeros(1))[0] >= WRONG).sum())
            if 2 * num_wrong >= len(self._pairs):
                self.doubt = (
                    f'by registration, {num_wrong} of {len(self._pairs)} motions of '
                    f'{self._topic or "the scans"} differ from those of their poses: are poses, '
                    'the mount of the sensor or its clock wrong?'
                )
            return by_times
        poses, added_s = self._recording.poses, self._mapper.config.input.time_offset_s
        if isinstance(poses, PoseTopics):
            added_s = poses.offsets_ns.get(self._topic, 0) / 1e9
        reference = described['poses'] or described['pose_topics'][0]
        clouds = self._topic or 'the scans'
        offset = ClockOffset(clouds, reference, -shift_s, 'motion of the scans', added_s)
        _log.warning('%s', offset)
        return [{**asdict(offset), 'text': str(offset)}]

    def _posed_motions(self) -> PosedMotions:
        """Return the motions of the scans, to be compared with those of the poses."""
        stamps_ns, motions = np.array(self._stamps_ns), np.array(self._motions)
        if self._path is None:
            path = Trajectory.from_matrices(np.array(self._poses), stamps_ns)
        else:
            path, base = self._path.trajectory, self._mapper.config.frames.base
            mount = self._mapper.transforms.lookup(base, self._frame_id, self._stamps_ns[0])
            motions = mount @ motions @ inverse(mount)
        return PosedMotions(path, stamps_ns[np.array(self._pairs)], motions)


def path_shift_s(
    path: Trajectory, stamps_ns: npt.NDArray[np.int64], poses: FloatArray
) -> float | None:
    """
    Return the shift of stamps by which a path has the motions of poses; None if unknown.

    Spans of time that do not overlap are compared from their first stamps on.
    """
    assert path.stamp_ns is not None, 'poses by number have no clock'
    rows = np.unique(np.linspace(0, len(poses) - 1, 4 * PAIRS).astype(np.int64))
    ends = np.searchsorted(stamps_ns, stamps_ns[rows] + APART_NS)
    rows, ends = rows[ends < len(poses)], ends[ends < len(poses)]
    if len(rows) < LEAST_PAIRS:
        return None
    is_apart = stamps_ns[0] > path.stamp_ns[-1] or stamps_ns[-1] < path.stamp_ns[0]
    start_ns = int(path.stamp_ns[0] - stamps_ns[0]) if is_apart else 0
    spans_ns = np.stack([stamps_ns[rows], stamps_ns[ends]], axis=1)
    motions = np.linalg.inv(poses[rows]) @ poses[ends]
    return PosedMotions(path, spans_ns, motions).shift_s(start_ns / 1e9)


class PosedMotions:
    """
    Motions of scans, to be compared with those of poses at other times.

    Parameters
    ----------
    path : Trajectory
        The poses.
    spans_ns : (K, 2) int64
        Stamps of the first and the last scan of each motion.
    motions : (K, 4, 4) float64
        Poses at the last in the frame at the first.

    """

    def __init__(
        self, path: Trajectory, spans_ns: npt.NDArray[np.int64], motions: FloatArray
    ) -> None:
        assert path.stamp_ns is not None, 'poses by number have no clock'
        first_ns = path.stamp_ns[0]
        self._times_s = (path.stamp_ns - first_ns) / 1e9
        self._turns = Slerp(self._times_s, Rotation.from_quat(path.q_xyzw))
        self._xyz = path.xyz
        self._spans_s = (spans_ns - first_ns) / 1e9
        self._motions = motions

    def misfits(self, shifts_s: npt.NDArray[np.floating[Any]]) -> FloatArray:
        """Return the misfit of each motion at shifts (S,), (S, K); nan without poses."""
        times_s = self._spans_s + shifts_s[:, None, None]
        is_posed = ((times_s >= 0.0) & (times_s <= self._times_s[-1])).all(axis=2)
        times_s = np.clip(times_s, 0.0, self._times_s[-1]).reshape(-1, 2)
        starts, ends = self._turns(times_s[:, 0]).inv(), self._turns(times_s[:, 1])
        columns = [np.interp(times_s, self._times_s, column) for column in self._xyz.T]
        ways = starts.apply(np.diff(columns, axis=2)[:, :, 0].T)
        motions = np.tile(self._motions, (len(shifts_s), 1, 1))
        turns, moves = Rotation.from_matrix(motions[:, :3, :3]), motions[:, :3, 3]
        turned = (turns.inv() * starts * ends).magnitude()
        moved_m = np.linalg.norm(ways - moves, axis=1)
        turned /= ANGLE_RAD + SHARE * turns.magnitude()
        moved_m /= DISTANCE_M + SHARE * np.linalg.norm(moves, axis=1)
        misfits = np.minimum(np.hypot(turned, moved_m), MOST_MISFIT)
        return np.where(is_posed, misfits.reshape(is_posed.shape), np.nan)

    def shift_s(self, start_s: float = 0.0) -> float | None:
        """
        Return the shift of the stamps by which the poses have the motions; None if unknown.

        It is sought up to ``MOST_OFFSET_S`` from a start. Without a shift there may be no poses.
        """
        shifts_s = start_s + np.arange(-MOST_OFFSET_S, MOST_OFFSET_S + STEP_S, STEP_S)
        misfits = self.misfits(shifts_s)
        is_posed = np.isfinite(misfits).mean(axis=1) >= LEAST_SHARE
        if not is_posed.any():
            return None
        shifts_s, misfits = shifts_s[is_posed], misfits[is_posed]
        coarse_s = float(shifts_s[np.nanmean(misfits, axis=1).argmin()])
        fine_s = coarse_s + np.arange(-STEP_S, STEP_S, FINE_STEP_S)
        fine = self.misfits(fine_s)
        row = np.nanmean(fine, axis=1).argmin()
        shift_s, best = float(fine_s[row]), fine[row]
        worse = misfits - best
        errors = np.nanstd(worse, axis=1) / np.sqrt(np.isfinite(worse).sum(axis=1))
        rivals_s = shifts_s[np.nanmean(worse, axis=1) <= SIGMAS * errors + LEAST_WORSE]
        most_s = min(0.5 * abs(shift_s), SAME_S)
        is_unique = np.abs(rivals_s - shift_s).max(initial=0.0) <= most_s
        unshifted = np.nan_to_num(self.misfits(np.zeros(1))[0], nan=MOST_MISFIT)
        is_better = np.nanmean(unshifted - best) >= (BETTER - 1.0) * np.nanmean(best)
        return shift_s if abs(shift_s) >= LEAST_OFFSET_S and is_unique and is_better else None
