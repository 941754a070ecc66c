# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
MapPart: a map of its own for scans whose place on the map is not certain.

After a loss scans are tracked on this part, and each is compared with the map as well. Once a
place on the map beats all others and CONFIRMING more scans agree with it, the part is joined: its
scans are reduced again at their poses on the map, so the map equals, bit for bit, one that was
made at these poses. A part that is never confirmed stays apart; one wrong place in a map would
spoil all that is mapped later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.place_search import PlaceSearch
from surfel_mapper.alignment.registration import is_near, Registration, RegistrationResult, turned
from surfel_mapper.alignment.surfel_planes import means
from surfel_mapper.alignment.tracking import FIRST_SUPPORT, Tracker
from surfel_mapper.config import Config
from surfel_mapper.errors import AlignmentError
from surfel_mapper.geometry import compose, inverse, Transform
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.pipeline.prepared import Prepared

CONFIRMING = 2
"""Number of scans that have to agree with the place of an earlier one."""

MOST_SCANS = 200
"""Number of scans that a part keeps for joining it, some 300 MB of 131,072 points each; all parts
that wait for the end of the input keep as many."""

LEAST_SCANS = 3
"""Parts of fewer scans are not kept: their scans count as dropped."""

LEAST_MATCHED = 4
"""Smaller parts are not matched as a whole: of 24 parts of three scans with a view of 90 deg at a
wrong place one would be taken, of 90 of four to eight scans none."""

REACH_M, MOST_CELLS = 60.0, 20_000
"""Distance up to which surfaces of a map count, and number of them, if parts are matched."""

MOST_APART, MOST_SEEN_THROUGH = 0.4, 0.15
"""Largest distance of the poses found both ways, in voxels, and largest share of the surfaces of
one map that the other sees through, in a match."""

LEAST_SUPPORT = 0.1
"""Minimum support of a scan on its part: a scan that hardly fits says nothing about the motion."""

SHARE_OF_USUAL = 0.5
"""Minimum support at a place on the map, as a share of the usual support before the loss."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Sighting:
    """
    A scan to be placed.

    Attributes
    ----------
    prepared : Prepared
        The scan.
    cells : (K, 3) float64, m
        Its cells, in the frame of the body.
    stamp_ns : int
        The time in the middle of its sweep.
    T_middle_body, T_body_sensor : (4, 4) float64
        Motion from the middle of the sweep to its stamp; mount of the sensor.

    """

    prepared: Prepared
    cells: npt.NDArray[np.float64]
    stamp_ns: int
    T_middle_body: Transform
    T_body_sensor: Transform


@dataclass(frozen=True, slots=True, eq=False)
class WaitingScan:
    """A scan of a part: T_part_body at its stamp, and T_part_sensor."""

    prepared: Prepared
    T_part_body: Transform
    T_part_sensor: Transform


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ApartMap:
    """
    A part that was not joined.

    Attributes
    ----------
    map : SurfelMap
        Its map; the first scan is at the origin.
    stamps_ns : tuple of int
    poses : list of (4, 4) float64
        T_part_sensor of every scan.
    reason : str
        Why its first scan was not mapped.

    """

    map: SurfelMap
    stamps_ns: tuple[int, ...]
    poses: list[Transform]
    reason: str

    def summary(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            'scans': len(self.stamps_ns),
            'first_s': self.stamps_ns[0] / 1e9,
            'last_s': self.stamps_ns[-1] / 1e9,
            'voxels': self.map.num_voxels,
            'reason': self.reason,
        }


class MapPart:
    """
    Scans apart from the map, until their place on it is confirmed.

    Parameters
    ----------
    registration : Registration
    config : Config
        All settings.
    T_map_part : (4, 4) float64
        Guess of the place of the part on the map: the prediction for its first scan.
    limits : (float, float)
        Usual support of a scan on the map, and the largest share of it that a scan sees through.
    reason : str
        Why its first scan was not mapped.

    Attributes
    ----------
    scans : list of WaitingScan
    tracker : Tracker
        Tracks the scans on the part.
    guess : (4, 4) float64
        The guess of its place.
    limits : (float, float)
        As given.
    reason : str
        Why its first scan was not mapped.
    follows_part : bool
        The scans before it were those of another part.
    is_far : bool
        Its first scan was refused because its place is far from the guess, which fits as well.

    """

    def __init__(
        self,
        registration: Registration,
        config: Config,
        T_map_part: Transform,
        limits: tuple[float, float],
        reason: str,
    ) -> None:
        self._registration = registration
        self.guess = T_map_part
        self.limits = limits
        self.reason = reason
        self._config = config
        self._map = SurfelMap(config.map.voxel_size_m)
        self._T_map_part: Transform | None = None
        self._num_agreeing = 0
        self._refusal = ''
        self.follows_part = self.is_far = False
        self.scans: list[WaitingScan] = []
        self.tracker = Tracker(registration, np.eye(4))

    @property
    def points(self) -> npt.NDArray[np.float64]:
        """One point of each voxel of the part, (N, 3) m."""
        return means(self._map.moments())

    @property
    def reasons(self) -> str:
        """Why its first scan was not mapped, and why the last one has no place."""
        return f'{self.reason}; {self._refusal}' if self._refusal else self.reason

    @property
    def has_place(self) -> bool:
        """Whether a place on the map is known that later scans have to confirm."""
        return self._T_map_part is not None

    def add(self, sighting: Sighting) -> Transform:
        """
        Track a scan on the part and add it; return T_part_middle.

        Raises
        ------
        AlignmentError
            If it does not fit the part.

        """
        if self._map.num_voxels:
            result = self.tracker.track(sighting.cells, sighting.stamp_ns, self._map, np.eye(4))
            least = FIRST_SUPPORT if result.is_found else LEAST_SUPPORT
            if result.support < least:
                raise AlignmentError(
                    f'{result.support:.0%} of its cells fit, expected {least:.0%} of a new part'
                )
        T_part_body = compose(self.tracker.pose, sighting.T_middle_body)
        T_part_sensor = compose(T_part_body, sighting.T_body_sensor)
        limits = self._config.input
        moments = self._map.reduce(
            sighting.prepared.filtered.points,
            T_part_sensor,
            origin=T_part_sensor[:3, 3],
            min_range_m=limits.min_range_m,
            max_range_m=limits.max_range_m or math.inf,
        )
        self._map.insert(moments)
        self.scans.append(WaitingScan(sighting.prepared, T_part_body, T_part_sensor))
        return self.tracker.pose

    def set_place(self, T_map_middle: Transform, T_part_middle: Transform) -> None:
        """Set a place on the map that the next scans have to confirm."""
        self._T_map_part, self._num_agreeing = compose(T_map_middle, inverse(T_part_middle)), 0

    def confirmed(
        self,
        cells: npt.NDArray[np.float64],
        surfel_map: SurfelMap,
        T_part_middle: Transform,
        candidates: Sequence[Transform] = (),
    ) -> tuple[Transform, RegistrationResult] | None:
        """
        Compare the newest scan with the map; return T_map_part once enough scans agree.

        Parameters
        ----------
        cells : (K, 3) float64, m
            Cells of the newest scan, in the frame of the body.
        surfel_map : SurfelMap
            The map.
        T_part_middle : (4, 4) float64
            Pose of the scan on the part.
        candidates : sequence of (4, 4) float64
            Poses of the scan on the map that a search found; by default the guess.

        """
        settings = self._registration.config
        start = compose(
            self.guess if self._T_map_part is None else self._T_map_part, T_part_middle
        )
        if candidates:
            result = self._registration.relocate(cells, surfel_map, [start, *candidates])
        else:
            is_lost, most_m = self._T_map_part is None, settings.max_deviation_m
            result = self._registration.align(cells, surfel_map, [start], most_m, is_lost=is_lost)
        self._refusal = self._refused(result)
        if self._refusal:
            self._T_map_part = None
            return None
        if self._T_map_part is None:
            self.set_place(result.T_map_sensor, T_part_middle)
            return None
        if not is_near(result.T_map_sensor, start, surfel_map.voxel_size_m):
            self._T_map_part = None
            return None
        self._T_map_part = compose(result.T_map_sensor, inverse(T_part_middle))
        self._num_agreeing += 1
        return (self._T_map_part, result) if self._num_agreeing >= CONFIRMING else None

    def matched(
        self, surfel_map: SurfelMap, T_map_body: Transform
    ) -> tuple[Transform, RegistrationResult] | None:
        """
        Return T_map_part if all scans together have a certain place on a map, else None.

        The smaller of the two maps is aligned to the larger, since more of it overlaps, from
        T_map_body at all headings and from the places of a search. The surroundings of the place
        found are then aligned back.
        """
        if len(self.scans) < LEAST_MATCHED:
            return None
        T_part_body, registration = self.scans[0].T_part_body, self._registration
        search = PlaceSearch(means(surfel_map.moments()), surfel_map.voxel_size_m)
        starts = turned([T_map_body], 24) + search.poses(cells_around(self._map, T_part_body))
        small, large, T_small_body = self._map, surfel_map, T_part_body
        if is_larger := self._map.num_voxels > surfel_map.num_voxels:
            small, large, T_small_body = surfel_map, self._map, T_map_body
            starts = [compose(T_part_body, compose(inverse(T), T_map_body)) for T in starts]
        result = registration.relocate(cells_around(small, T_small_body), large, starts)
        cells = cells_around(large, result.T_map_sensor)
        back = registration.align(
            cells, small, [T_small_body], registration.config.max_deviation_m
        )
        is_right = result.rival == 0.0 and registration.fits(result)
        for way in (result, back):
            is_right &= way.converged and not len(way.degenerate)
            is_right &= way.seen_through <= MOST_SEEN_THROUGH
        most_m = MOST_APART * surfel_map.voxel_size_m
        if not is_right or not is_near(back.T_map_sensor, T_small_body, most_m):
            return None
        T_small_large = compose(T_small_body, inverse(result.T_map_sensor))
        return T_small_large if is_larger else inverse(T_small_large), result

    def _refused(self, result: RegistrationResult) -> str:
        """Return why a scan has no certain place on the map; empty if it has."""
        usual_support, max_seen_through = self.limits
        fits = result.converged and self._registration.fits(result)
        if not fits or result.support < SHARE_OF_USUAL * usual_support:
            return f'no place in the map fits the last scan (the best: {result.support:.0%})'
        if result.rival > 0.0:
            return f'the last scan fits two places about equally well ({result.support:.0%})'
        if result.seen_through > max_seen_through:
            return f'the last scan sees through {result.seen_through:.0%} of the map in view'
        return ''

    def apart(self) -> ApartMap:
        """Return the part as a map that stays apart."""
        return ApartMap(
            map=self._map,
            stamps_ns=tuple(scan.prepared.scan.stamp_ns for scan in self.scans),
            poses=[scan.T_part_sensor for scan in self.scans],
            reason=self.reasons,
        )


def cells_around(surfel_map: SurfelMap, T_map_body: Transform) -> npt.NDArray[np.float64]:
    """Return one point of each voxel near a pose, as seen from there, (K, 3) m."""
    points = means(surfel_map.moments()) - T_map_body[:3, 3]
    near = points[np.hypot(points[:, 0], points[:, 1]) < REACH_M] @ T_map_body[:3, :3]
    return np.ascontiguousarray(near[:: len(near) // MOST_CELLS + 1])
