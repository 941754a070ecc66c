# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Search for loops in a drive, and poses of all its scans at which they close.

Keyframes follow the path at a distance. Around a keyframe the scans of some metres of the path,
and no others, are reduced to one local map, so that a place seen twice has two local maps however
large the drift between them is. Local maps that show one place are recognised, or near each other
by their poses; the cells of one are then registered to the surfels of the other, and only
candidates that fit become loops. The graph of odometry and loops is solved robustly
(alignment/loops.py); at the poses found more keyframes are near each other, and so on.
A loop that no second one near it confirms is refused, however well it fits.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import logging
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.correspondences import loop_candidates, path_lengths
from surfel_mapper.alignment.loops import Loop, LoopSolution, solve_loops
from surfel_mapper.alignment.recognition import Recognition
from surfel_mapper.alignment.registration import Registration, RegistrationResult
from surfel_mapper.alignment.surfel_planes import means, PlaneLevels
from surfel_mapper.alignment.window import carried
from surfel_mapper.config import LoopsConfig, RegistrationConfig
from surfel_mapper.errors import counted, DependencyError
from surfel_mapper.geometry import compose, inverse
from surfel_mapper.mapping.surfel_map import SurfelMap

_log = logging.getLogger(__name__)

Floats = npt.NDArray[np.float64]

SCANS_A_MAP = 12
"""Maximum number of scans of a local map, evenly spaced on its part of the path."""

LOCAL_SHARE = 0.25
"""Maximum length of a local map, as a share of the path. A loop is at least two of them long, and
a walk through a hall is shorter than two of a street."""

REACH_M = 60.0
"""Points of a local map farther from their sensor are left out, m: their drift is largest."""

COARSE_LEVELS = 3
"""Levels of registration: voxels of 4 m at 0.5 m, which candidates 2 m off need."""

DEVIATION_M = 1.5
"""Expected error of a candidate, m."""

CACHED_MAPS = 64
"""Local maps kept in memory, about 3 MB each."""

NEAR_KEYS = 3
"""Loops whose ends are at most this many keyframes apart confirm each other."""


class ScanPoints(Protocol):
    """The points of the scans of a drive, by number."""

    def __len__(self) -> int:
        """Return the number of scans."""

    def points(self, number: int) -> npt.NDArray[Any]:
        """Return the points of a scan in the frame of its sensor, (N, 3) m."""


@dataclass(frozen=True, slots=True, eq=False)
class Refusal:
    """A candidate that did not become a loop, and the reason."""

    candidate: Loop
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosure:
    """
    Poses at which the loops of a drive close.

    Attributes
    ----------
    T_map_sensor : (S, 4, 4) float64
        Poses of all scans; the first is unchanged.
    keys : tuple of int
        Scans that are keyframes.
    loops : tuple of Loop
        Accepted loops, by numbers of keyframes.
    refusals : tuple of Refusal
        Candidates that were refused.
    recognises : bool
        Whether places were recognised; otherwise only poses gave candidates.

    """

    T_map_sensor: Floats
    keys: tuple[int, ...]
    loops: tuple[Loop, ...]
    refusals: tuple[Refusal, ...]
    recognises: bool


class LoopSearch:
    """
    Finds the loops of a drive and closes them.

    Parameters
    ----------
    scans : ScanPoints
        The points of all scans.
    T_map_sensor : (S, 4, 4) float64
        Their poses by odometry.
    settings : LoopsConfig
        Its settings.
    registration : RegistrationConfig
        Settings of the registration that verifies candidates.
    voxel_size_m : float
        Edge of the voxels of local maps.
    frame_ids : sequence of str, optional
        Frames of the sensors of the scans, by default all the same; distances travelled are those
        of scans of one frame.

    """

    def __init__(
        self,
        scans: ScanPoints,
        T_map_sensor: Floats,
        settings: LoopsConfig,
        registration: RegistrationConfig,
        voxel_size_m: float,
        frame_ids: Sequence[str] | None = None,
    ) -> None:
        self._scans = scans
        self._initial = np.asarray(T_map_sensor, np.float64)
        self._settings = settings
        self._voxel_size_m = voxel_size_m
        verifying = replace(registration, coarse_levels=COARSE_LEVELS, search_deg=0.0)
        self._registration = Registration(verifying, voxel_size_m)
        self._path_m = path_lengths(self._initial, frame_ids)
        self._local_map_m = min(settings.local_map_m, LOCAL_SHARE * float(self._path_m[-1]))
        self.keys = key_numbers(self._path_m, settings.key_distance_m)
        self._maps: OrderedDict[int, SurfelMap] = OrderedDict()
        self._loops: dict[tuple[int, int], Loop] = {}
        self._own_overlap: dict[int, float] = {}
        self._refusals: dict[tuple[int, int], Refusal] = {}

    def close(self, progress: Callable[[str], object] = lambda text: None) -> LoopClosure:
        """
        Return the poses at which the loops close.

        Parameters
        ----------
        progress : callable
            Called with a line of text at each stage.

        """
        recognises = self._recognise()
        number = len(self._loops) + len(self._refusals)
        progress(f'{len(self._loops)} of {number} recognised places fit')
        solution = self._solve()
        for _ in range(self._settings.max_rounds):
            num_before = len(self._loops)
            for candidate in self._near(solution.T_map_key):
                self._verify(candidate)
            if len(self._loops) == num_before:
                break
            solution = self._solve()
            progress(counted(len(self._loops), 'loop'))
        self._refuse_unconfirmed()
        solution = self._solve()
        verified = list(zip(self._ordered, solution.is_kept.tolist(), strict=True))
        for loop, is_kept in verified:
            if not is_kept:
                self._refuse(loop, 'it contradicts odometry and the other loops')
        kept = tuple(loop for loop, is_kept in verified if is_kept)
        poses = carried(self._initial, self.keys, solution.T_map_key) if kept else self._initial
        return LoopClosure(
            T_map_sensor=poses.copy(),
            keys=tuple(self.keys),
            loops=kept,
            refusals=tuple(self._refusals.values()),
            recognises=recognises,
        )

    @property
    def _ordered(self) -> list[Loop]:
        return list(self._loops.values())

    def _solve(self) -> LoopSolution:
        return solve_loops(self._initial[self.keys], self._ordered, self._settings.drift_ratio)

    def _recognise(self) -> bool:
        """Verify the places that are recognised; return False if that is not installed."""
        try:
            recognition = Recognition(self._settings.min_votes)
        except DependencyError as error:
            _log.warning('only loops whose ends are near each other are found: %s', error)
            return False
        apart = max(round(self._settings.recognise_distance_m / self._settings.key_distance_m), 1)
        for key in range(0, len(self.keys), apart):
            for candidate in recognition.add(key, means(self._local_map(key).moments())):
                if self._path_between(candidate.source, candidate.target) > self._least_loop_m:
                    self._verify(candidate)
        return True

    @property
    def _least_loop_m(self) -> float:
        """Minimum length of the path of a loop, m: local maps of its ends share no scan."""
        return 2.0 * self._local_map_m

    def _path_between(self, source: int, target: int) -> float:
        return float(self._path_m[self.keys[source]] - self._path_m[self.keys[target]])

    def _near(self, T_map_key: Floats) -> list[Loop]:
        """Return the keyframes near each other, with their pose by the present solution."""
        candidates = []
        sources: set[int] = set()
        distance_m = self._settings.near_distance_m
        path_m = self._path_m[self.keys]
        pairs = loop_candidates(T_map_key, distance_m, path_m, self._least_loop_m)
        pairs.sort(
            key=lambda p: float(np.linalg.norm(T_map_key[p[0]][:3, 3] - T_map_key[p[1]][:3, 3]))
        )
        for source, target in pairs:
            is_done = (source, target) in self._loops or (source, target) in self._refusals
            if source in sources:
                continue
            sources.add(source)
            if not is_done:
                T = compose(inverse(T_map_key[target]), T_map_key[source])
                candidates.append(Loop(source, target, T))
        return sorted(candidates, key=lambda candidate: (candidate.source, candidate.target))

    def _verify(self, candidate: Loop) -> None:
        """Register the local map of one keyframe to that of the other; keep or refuse the loop."""
        ends = (candidate.source, candidate.target)
        if ends in self._loops:
            return
        result = self.register(candidate)
        reason = self.reason_against(candidate.source, result)
        if reason:
            self._refuse(candidate, reason)
            return
        self._refusals.pop(ends, None)
        self._loops[ends] = Loop(*ends, result.T_map_sensor, result.support, candidate.votes)

    def register(self, candidate: Loop) -> RegistrationResult:
        """Return the pose of the source of a candidate on the local map of its target."""
        cells = self._cells(candidate.source)
        target = self._local_map(candidate.target)
        return self._registration.align(cells, target, [candidate.T_target_source], DEVIATION_M)

    def overlap(self, source: int, result: RegistrationResult) -> float:
        """
        Return the share of a local map that overlaps, of that which can.

        Few of the cells of a sparse lidar meet a usable surfel, even in their own map.
        """
        if source not in self._own_overlap:
            cells, local = self._cells(source), self._local_map(source)
            levels = PlaneLevels(self._registration.config, local, cells, [np.eye(4)])
            equations = levels.planes(0).equations(cells, np.eye(4), self._voxel_size_m)
            self._own_overlap[source] = max(equations[2], 1e-9)
        return min(result.overlap / self._own_overlap[source], 1.0)

    def reason_against(self, source: int, result: RegistrationResult) -> str:
        """Return why a registration is no loop; empty if it is one."""
        settings = self._settings
        if not result.converged:
            return 'its registration does not settle'
        overlap = self.overlap(source, result)
        if overlap < settings.min_overlap_ratio or result.fit < settings.min_fit_ratio:
            return (
                f'{overlap:.0%} of it overlaps and {result.fit:.0%} of that fits, expected '
                f'{settings.min_overlap_ratio:.0%} and {settings.min_fit_ratio:.0%}'
            )
        if len(result.degenerate):
            return f'{len(result.degenerate)} of 6 directions are not determined'
        return ''

    def _refuse(self, candidate: Loop, reason: str) -> None:
        self._refusals[candidate.source, candidate.target] = Refusal(candidate, reason)

    def _refuse_unconfirmed(self) -> None:
        """Refuse loops with no other loop between keyframes near both of their ends."""
        alone = [
            loop
            for loop in self._ordered
            if not any(confirms(witness, loop) for witness in self._ordered)
        ]
        for loop in alone:
            del self._loops[loop.source, loop.target]
            self._refuse(loop, 'no loop between keyframes next to it confirms it')

    def _cells(self, key: int) -> Floats:
        """Return means of the surfels around a keyframe, at most RegistrationConfig.max_cells."""
        cells = means(self._local_map(key).moments())
        step = -(-len(cells) // self._registration.config.max_cells) or 1
        return np.ascontiguousarray(cells[::step])

    def _local_map(self, key: int) -> SurfelMap:
        """Return the map of the scans of the path around a keyframe, in its frame."""
        if key in self._maps:
            self._maps.move_to_end(key)
            return self._maps[key]
        centre = self.keys[key]
        half_m = 0.5 * self._local_map_m
        around = np.flatnonzero(np.abs(self._path_m - self._path_m[centre]) <= half_m)
        local = SurfelMap(self._voxel_size_m)
        T_key_map = inverse(self._initial[centre])
        for number in spaced(self._path_m, around, centre):
            T_key_sensor = compose(T_key_map, self._initial[number])
            local.insert(
                local.reduce(
                    self._scans.points(number),
                    T_key_sensor,
                    origin=T_key_sensor[:3, 3],
                    max_range_m=REACH_M,
                )
            )
        self._maps[key] = local
        while len(self._maps) > CACHED_MAPS:
            self._maps.popitem(last=False)
        return local


def key_numbers(path_m: Floats, distance_m: float) -> list[int]:
    """Return the scans that are keyframes, by the path travelled; the first and last are."""
    keys = [0]
    for number in range(1, len(path_m)):
        if path_m[number] - path_m[keys[-1]] >= distance_m:
            keys.append(number)
    if keys[-1] != len(path_m) - 1:
        keys.append(len(path_m) - 1)
    return keys


def spaced(path_m: Floats, numbers: npt.NDArray[np.int64], centre: int) -> list[int]:
    """Return at most SCANS_A_MAP of some scans, evenly along the path, with the centre."""
    wanted = np.linspace(path_m[numbers[0]], path_m[numbers[-1]], SCANS_A_MAP)
    nearest = np.searchsorted(path_m[numbers], wanted).clip(0, len(numbers) - 1)
    return sorted({*numbers[nearest].tolist(), centre})


def confirms(witness: Loop, loop: Loop) -> bool:
    """Return whether a loop connects keyframes next to both ends of another."""
    is_other = (witness.source, witness.target) != (loop.source, loop.target)
    apart = max(abs(witness.source - loop.source), abs(witness.target - loop.target))
    return is_other and apart <= NEAR_KEYS
