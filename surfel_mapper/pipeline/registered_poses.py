# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Poses by registration: each scan is aligned to the map of the scans before it.

The track is that of the base if the mount of the sensor on it is known, so that several sensors
share one track; otherwise that of the sensor itself.

A scan without a certain place begins a part of the map of its own (map_part); later scans are
tracked on that part until their place on the map is confirmed, and are then mapped all together.
Tracking, waiting and joining share the state of one track, so they are one module.
"""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.companions import LEAST_SHARE
from surfel_mapper.alignment.place_search import PlaceSearch
from surfel_mapper.alignment.registration import is_near, Registration, RegistrationResult
from surfel_mapper.alignment.surfel_planes import means
from surfel_mapper.alignment.tracking import MORE_SEEN_THROUGH, Tracker
from surfel_mapper.config import Config
from surfel_mapper.counters import LATEST
from surfel_mapper.errors import AlignmentError, PoseError, PoseNotYetError
from surfel_mapper.geometry import compose, inverse, pose_matrix, Transform
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.pipeline.drops import Drops
from surfel_mapper.pipeline.map_part import ApartMap, LEAST_SCANS, MapPart, MOST_SCANS, Sighting
from surfel_mapper.pipeline.mapping_stages import expected_type
from surfel_mapper.pipeline.prepared import Prepared
from surfel_mapper.pipeline.surroundings import SurroundingMotion
from surfel_mapper.poses import TransformBuffer
from surfel_mapper.scan import PointTimes, Scan

MOST_PARTS = 20
"""Number of parts whose maps are kept; of more, the oldest are forgotten."""

STATES = ('lost', 'unconfirmed', 'ambiguous', 'degenerate', 'jumped', 'surrounded', 'rejoined')
"""States of tracking; jumped: far from the prediction, and uncertain; surrounded: most of a scan
seems to move along; rejoined: its part was matched to the map at the end of the input."""

UNKNOWN_START = 'its initial pose is unknown, and searched for in the map'

MAX_STEP_S = 10.0
"""Longest time between two scans that counts for a state, s; more is a gap of the recording."""


class StateTimes:
    """Scans and seconds in each state of tracking."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._spent: dict[str, dict[str, float]] = {
            state: {'scans': 0, 'seconds': 0.0} for state in STATES
        }

    def add(self, stamp_ns: int, states: list[str]) -> None:
        """Count a scan, and the time since the one before, under its states."""
        step_s = 0.0 if self._last_ns is None else (stamp_ns - self._last_ns) / 1e9
        self._last_ns = stamp_ns
        for state in states:
            spent = self._spent[state]
            spent['scans'] += 1
            spent['seconds'] += min(max(step_s, 0.0), MAX_STEP_S)
            spent.setdefault('first_s', stamp_ns / 1e9)
            spent['last_s'] = stamp_ns / 1e9

    def summary(self) -> dict[str, dict[str, float]]:
        """Return scans and seconds by state, with the stamps of its first and last scan."""
        return {
            state: {**spent, 'seconds': round(spent['seconds'], 3)}
            for state, spent in self._spent.items()
        }


class RegisteredPoses:
    """
    The poses of the sensors, found by registration.

    Parameters
    ----------
    config : Config
        Its ``registration``, ``input`` and ``frames``.
    transforms : TransformBuffer
        Mounts of the sensors on the robot.
    drops : Drops
        Counts the scans whose place is never confirmed.

    Attributes
    ----------
    body : str
        The tracked frame; empty before the first scan.
    apart : list of ApartMap
        The latest parts that were not joined, at most MOST_PARTS.
    scans_ended : bool
        No scan follows those that came in.

    """

    def __init__(self, config: Config, transforms: TransformBuffer, drops: Drops) -> None:
        self._config = config
        self._transforms = transforms
        self._drops = drops
        self._map_part: MapPart | None = None
        self._ended_parts: list[MapPart] = []
        self.apart: list[ApartMap] = []
        self._states = StateTimes()
        self._surroundings = SurroundingMotion()
        self._registration = Registration(config.registration, config.map.voxel_size_m)
        start = config.registration.start
        self._start = pose_matrix(start[:3], start[3:]) if start else np.eye(4)
        self._searches_start = config.map.mode == 'frozen' and not start
        self._knows_start = not self._searches_start
        self._search: tuple[tuple[int, int], PlaceSearch] | None = None
        self._tracker = Tracker(self._registration, self._start)
        self.body = ''
        self.scans_ended = False
        self._num_aligned = self._num_degenerate = self._num_parts = 0
        self._fits: deque[float] = deque(maxlen=LATEST)

    def reconfigure(self, config: Config) -> None:
        """Take new settings from the next scan on."""
        self._config = config
        self._registration.config = config.registration

    @property
    def twist(self) -> npt.NDArray[np.float64]:
        """Velocity of the tracked frame, (6,) m/s and rad/s, in that frame."""
        return self._active.twist

    @property
    def _active(self) -> Tracker:
        """The tracker of the newest scan: that of a part, if there is one."""
        return self._tracker if self._map_part is None else self._map_part.tracker

    def warm_up(self) -> None:
        """Compile the kernels."""
        points = np.random.default_rng(0).uniform(-1.0, 1.0, (100, 3))
        points = points.astype(expected_type(self._config))
        surfel_map = SurfelMap(self._config.map.voxel_size_m)
        surfel_map.add(points)
        cells = self._registration.cells(points)
        self._registration.align(cells, surfel_map, [np.eye(4)], 1e3, 2.0)

    def restart(self, T_fixed_body: Transform | None = None) -> None:
        """Go on from a pose, by default the one of registration.start."""
        self.finish()
        self._knows_start = T_fixed_body is not None or not self._searches_start
        self._tracker.restart(self._start if T_fixed_body is None else T_fixed_body)

    def learn_motion(self, scan: Scan, following: Scan | None) -> None:
        """
        Estimate the velocity for deskewing the first scan, from the scan after it.

        Both are skewed alike, so the motion between them is right; but if the first were mapped
        without deskewing, later scans would not fit it. A single scan is taken to be at rest.

        Raises
        ------
        PoseNotYetError
            If the scan after it is not there yet.

        """
        if scan.times is None or not self._tracker.is_new:
            return
        if following is None and self.scans_ended:
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
        return compose(self._active.predict(stamp_ns), self._mount(frame_id, stamp_ns))

    def align(
        self,
        prepared: Prepared,
        times: PointTimes | None,
        surfel_map: SurfelMap,
        T_map_fixed: Transform,
    ) -> list[Prepared]:
        """
        Align a scan to the map; return the scans whose places are certain now.

        Parameters
        ----------
        prepared : Prepared
            The scan, deskewed and filtered.
        times : PointTimes, optional
            Times of its points, if it was deskewed.
        surfel_map : SurfelMap
            The map; if it is empty the prediction is used.
        T_map_fixed : (4, 4) float64
            From the frame of the poses to that of the map.

        Returns
        -------
        list of Prepared
            The scan itself; none if its place is not certain; if it confirms the place of a part,
            all scans of the part. Their poses, ``T_map_sensor``, are in the fixed frame.
            ``registration`` is None if the map is empty.

        Raises
        ------
        MapError
            If a coarser level of the map would hold too many points in a voxel.
        PoseError
            If the mount of the sensor on the tracked frame is unknown.

        """
        scan = prepared.filtered
        if not surfel_map.num_voxels:
            self.finish()  # nothing is left that a part could be joined to
        # Deskewed by a velocity that is off, a sweep is right in its middle and off at both
        # ends: followed at its stamp, which is one of them, pose and velocity would swing.
        middle_ns = (times.first_ns + times.last_ns) // 2 if times else scan.stamp_ns
        T_active_middle = self._active.predict(middle_ns)
        T_middle_body = compose(inverse(T_active_middle), self._active.predict(scan.stamp_ns))
        if not surfel_map.num_voxels:
            self._tracker.advance(T_active_middle, middle_ns)
            return [self._placed(prepared, T_middle_body, None)]
        sighting = Sighting(
            prepared=prepared,
            cells=transformed(T_middle_body, self._cells(scan)),
            stamp_ns=middle_ns,
            T_middle_body=T_middle_body,
            T_body_sensor=self._mount(scan.frame_id, scan.stamp_ns),
        )
        if self._map_part is None:
            placed = self._track(sighting, surfel_map, T_map_fixed)
        else:
            placed = self._recover(sighting, self._map_part, surfel_map, T_map_fixed)
        if placed:
            self.finish()  # scans are mapped in order
        is_surrounded = self._is_surrounded(sighting, placed, surfel_map)
        self._count_state(scan.stamp_ns, placed, is_surrounded)
        return placed

    def rejoin(self, surfel_map: SurfelMap, T_map_fixed: Transform) -> list[Prepared]:
        """
        Return the scans of the next part that as a whole has a certain place; none at the end.

        They come after the scans of the map, and none do while further scans may follow.
        """
        if not self.scans_ended or self._config.map.mode == 'frozen' or not surfel_map.num_voxels:
            return []
        self._end_part(waits=True)
        while self._ended_parts:
            map_part = self._ended_parts.pop(0)
            T_map_body = compose(T_map_fixed, self._tracker.pose)
            if match := map_part.matched(surfel_map, T_map_body):
                T_fixed_part = compose(inverse(T_map_fixed), match[0])
                self._tracker.restart(compose(T_fixed_part, map_part.scans[-1].T_part_body))
                for waiting in map_part.scans:
                    self._states.add(waiting.prepared.scan.stamp_ns, ['rejoined'])
                return self._joined(map_part, T_fixed_part, match[1])
            self._leave_apart(map_part)
        return []

    def finish(self) -> None:
        """End the parts whose places were not confirmed: they stay apart."""
        self._end_part(waits=False)

    def _end_part(self, *, waits: bool) -> None:
        """End the newest part; some may wait for the end of the input, if loops are closed."""
        if self._map_part is not None:
            self._ended_parts.append(self._map_part)
            self._map_part = None
        most = MOST_SCANS if waits and self._config.loops.enabled else 0
        while sum(len(ended.scans) for ended in self._ended_parts) > most:
            self._leave_apart(self._ended_parts.pop(0))

    def _leave_apart(self, map_part: MapPart) -> None:
        """Drop the scans of a part, and keep its map."""
        is_kept = len(map_part.scans) >= LEAST_SCANS
        for waiting in map_part.scans:
            cause = 'apart' if is_kept else 'not_aligned'
            self._drops.scan(waiting.prepared.scan, cause, map_part.reasons)
        if is_kept:
            self.apart = [*self.apart, map_part.apart()][-MOST_PARTS:]
            self._num_parts += 1

    @property
    def problem(self) -> str:
        """Why the newest scans have no certain place on the map; empty if they have."""
        map_part = self._map_part
        if map_part is None:
            return ''
        return (
            f'the newest {len(map_part.scans)} scans have no certain place on the map: '
            f'{map_part.reasons}; publish the pose of the robot on /initialpose'
        )

    def summary(self) -> dict[str, Any]:
        """Return figures of the fit of the scans, for files and reports."""
        fits = list(self._fits) or [float('nan')]
        return {
            'body': self.body,
            'aligned': self._num_aligned,
            'degenerate': self._num_degenerate,
            'ambiguous': self._tracker.num_ambiguous,
            'fit': {'median': float(np.median(fits)), 'min': float(np.min(fits))},
            'tracking': self._states.summary(),
            'parts_apart': self._num_parts,
            'apart': [apart.summary() for apart in self.apart],
        }

    def _track(
        self, sighting: Sighting, surfel_map: SurfelMap, T_map_fixed: Transform
    ) -> list[Prepared]:
        """Align a scan at its expected pose; if its place is uncertain, begin a part with it."""
        T_map_middle = compose(T_map_fixed, self._tracker.predict(sighting.stamp_ns))
        twist = self._tracker.twist
        if not self._knows_start:
            limits = self._tracker.expected_support, MORE_SEEN_THROUGH
            self._begin_part(sighting, T_map_middle, twist, limits, UNKNOWN_START)
            return []
        try:
            fit = self._tracker.track(sighting.cells, sighting.stamp_ns, surfel_map, T_map_fixed)
        except AlignmentError as error:
            limits = (
                self._tracker.expected_support,
                self._tracker.max_seen_through(surfel_map, T_map_fixed),
            )
            map_part = self._begin_part(sighting, T_map_middle, twist, limits, str(error))
            map_part.is_far = self._tracker.is_far
            if self._tracker.doubtful is not None:
                map_part.set_place(self._tracker.doubtful, np.eye(4))
            return []
        return [self._placed(sighting.prepared, sighting.T_middle_body, fit)]

    def _begin_part(
        self,
        sighting: Sighting,
        T_map_middle: Transform,
        twist: npt.NDArray[np.float64],
        limits: tuple[float, float],
        reason: str,
    ) -> MapPart:
        """Begin a part with a scan, predicted at a pose with a velocity; see MapPart."""
        map_part = MapPart(self._registration, self._config, T_map_middle, limits, reason)
        map_part.tracker.begin(sighting.stamp_ns, twist)
        map_part.add(sighting)
        self._map_part = map_part
        self._drops.warn(
            'lost', f'scan at {sighting.stamp_ns / 1e9:.6f} s has no certain place: {reason}'
        )
        return map_part

    def _recover(
        self, sighting: Sighting, map_part: MapPart, surfel_map: SurfelMap, T_map_fixed: Transform
    ) -> list[Prepared]:
        """Track a scan on the part, and join the part once its place on the map is confirmed."""
        twist = map_part.tracker.twist
        try:
            T_part_middle = map_part.add(sighting)
        except AlignmentError:
            return self._leave(sighting, map_part, twist, surfel_map, T_map_fixed)
        candidates = self._candidates(map_part, surfel_map, T_part_middle)
        confirmed = None
        if self._knows_start or candidates or map_part.has_place:
            confirmed = map_part.confirmed(sighting.cells, surfel_map, T_part_middle, candidates)
        if confirmed is None:
            if len(map_part.scans) >= MOST_SCANS:
                self._end_part(waits=True)
            return []
        T_map_part, result = confirmed
        self._map_part, self._knows_start = None, True
        T_fixed_part = compose(inverse(T_map_fixed), T_map_part)
        T_fixed_middle = compose(T_fixed_part, T_part_middle)
        twist = map_part.tracker.twist
        has_jumped = map_part.is_far and not is_near(
            T_map_part, map_part.guess, self._config.registration.max_deviation_m
        )
        self._tracker.resume(T_fixed_middle, sighting.stamp_ns, twist, sighting.cells, has_jumped)
        return self._joined(map_part, T_fixed_part, result)

    def _joined(
        self, map_part: MapPart, T_fixed_part: Transform, result: RegistrationResult
    ) -> list[Prepared]:
        """Return the scans of a part at their poses, and count them."""
        self._num_aligned += len(map_part.scans)
        self._fits.append(result.fit)
        return [
            self._at(waiting.prepared, compose(T_fixed_part, waiting.T_part_body), result)
            for waiting in map_part.scans
        ]

    def _candidates(
        self, map_part: MapPart, surfel_map: SurfelMap, T_part_middle: Transform
    ) -> list[Transform]:
        """
        Return places of a part in a whole frozen map, for its newest scan.

        The search takes longer than a scan: it is made for the 2nd, 4th, 8th ... scan.
        """
        number = len(map_part.scans)
        is_due = self._config.map.mode == 'frozen' and not number & (number - 1)
        if map_part.has_place or not is_due:
            return []
        version = id(surfel_map), surfel_map.version
        if self._search is None or self._search[0] != version:
            points = means(surfel_map.moments())
            self._search = version, PlaceSearch(points, surfel_map.voxel_size_m)
        return self._search[1].poses(transformed(inverse(T_part_middle), map_part.points))

    def _leave(
        self,
        sighting: Sighting,
        map_part: MapPart,
        twist: npt.NDArray[np.float64],
        surfel_map: SurfelMap,
        T_map_fixed: Transform,
    ) -> list[Prepared]:
        """
        End a part that a scan does not fit; the scan is tracked on the map or begins the next.

        A single scan that fits nothing is no loss: the next one may continue the track, unless
        the single one came after a part of several.
        """
        self._end_part(waits=True)
        if len(map_part.scans) > 1 or map_part.follows_part:
            guess = compose(map_part.guess, map_part.tracker.predict(sighting.stamp_ns))
            limits, reason = map_part.limits, map_part.reason
            self._begin_part(sighting, guess, twist, limits, reason).follows_part = True
            return []
        return self._track(sighting, surfel_map, T_map_fixed)

    def _placed(
        self,
        prepared: Prepared,
        T_middle_body: Transform,
        registration: RegistrationResult | None,
    ) -> Prepared:
        """Return a scan at the pose of the track, and count its registration."""
        if registration is not None:
            self._num_aligned += 1
            self._num_degenerate += len(registration.degenerate) > 0
            self._fits.append(registration.fit)
        T_fixed_body = compose(self._tracker.pose, T_middle_body)
        return self._at(prepared, T_fixed_body, registration)

    def _at(
        self,
        prepared: Prepared,
        T_fixed_body: Transform,
        registration: RegistrationResult | None,
    ) -> Prepared:
        """Return a scan at a pose of the tracked frame, in the fixed frame."""
        scan = prepared.filtered
        T_fixed_sensor = compose(T_fixed_body, self._mount(scan.frame_id, scan.stamp_ns))
        return replace(
            prepared,
            T_map_sensor=T_fixed_sensor,
            registration=registration,
            T_fixed_body=T_fixed_body,
        )

    def _is_surrounded(
        self, sighting: Sighting, placed: list[Prepared], surfel_map: SurfelMap
    ) -> bool:
        """Return whether most of what a scan on the track sees seems to move along; warn then."""
        if self._config.map.mode == 'frozen':  # its map lacks what came later
            return False
        if len(placed) != 1 or placed[0].registration is None:
            self._surroundings.clear()
            return False
        T_map_middle = placed[0].registration.T_map_sensor
        moves = self._surroundings.move_along(sighting.cells, T_map_middle, surfel_map)
        moves |= placed[0].registration.companions >= LEAST_SHARE
        if moves:
            self._drops.warn(
                'surrounded',
                f'scan at {sighting.stamp_ns / 1e9:.6f} s: most surfaces seem to move with '
                'the sensor: the pose may be wrong',
            )
        return moves

    def _count_state(self, stamp_ns: int, placed: list[Prepared], is_surrounded: bool) -> None:
        """Count the time since the scan before under the states of this one."""
        states = ['surrounded'] if is_surrounded else []
        if self._map_part is not None:
            states.append('unconfirmed' if self._map_part.has_place else 'lost')
            states += ['ambiguous'] if 'ambiguous' in self._map_part.reason else []
        elif placed and placed[-1].registration is not None:
            result = placed[-1].registration
            states += ['degenerate'] if len(result.degenerate) else []
            states += ['jumped'] if self._tracker.has_jumped else []
        self._states.add(stamp_ns, states)

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
