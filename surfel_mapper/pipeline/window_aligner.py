# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Alignment of the window: scans mapped at drifting poses are moved to poses at which they agree.

A scan is reduced again at its corrected pose and replaces its moments in the map, so the map
equals, bit for bit, one built at the corrected poses. The oldest scan does not move. The
correction of the newest scan holds for later scans too: it is the transform from the fixed frame
of the poses, which drifts, to the map, which jumps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment import align_scans, Samples, WindowAlignment
from surfel_mapper.alignment.window import extent
from surfel_mapper.arguments import Record
from surfel_mapper.config import AlignConfig, Config
from surfel_mapper.errors import AlignmentError, counted
from surfel_mapper.geometry import compose, inverse, Transform
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import SlidingWindow, WindowedScan

IDENTITY = np.eye(4)

MIN_POINTS = 6
"""Surfels of fewer points of one scan are not matched."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Alignment(Record):
    """
    The result of an alignment of the window.

    Attributes
    ----------
    solution : WindowAlignment
        The poses found, and the residuals.
    stamps_ns : (S,) int64
        Stamps of the scans of the window, oldest first.
    T_map_sensor : (S, 4, 4) float64
        Their poses in the map now; those that hardly changed are as before.
    T_map_fixed : (4, 4) float64
        From the fixed frame of the poses that come in to the map.
    num_moved : int
        Scans that were moved.
    largest_m, largest_deg : float
        Largest translation and rotation of a scan.
    removed_voxel_index : (K, 3) int32
        Voxels that were surfels and have too few points now.

    """

    solution: WindowAlignment
    stamps_ns: npt.NDArray[np.int64]
    T_map_sensor: npt.NDArray[np.float64]
    T_map_fixed: Transform
    num_moved: int
    largest_m: float
    largest_deg: float
    removed_voxel_index: npt.NDArray[np.int32]

    def summary(self) -> dict[str, Any]:
        """Return the result as plain numbers, with a sentence."""
        gaps = [gap for gap in self.solution.residuals.values() if math.isfinite(gap)]
        return {
            'scans': len(self.stamps_ns),
            'moved': self.num_moved,
            'largest_m': self.largest_m,
            'largest_deg': self.largest_deg,
            'settled': self.solution.settled,
            'rounds': self.solution.rounds,
            'compared': len(self.solution.residuals),
            'dropped': len(self.solution.dropped),
            'unconnected': len(self.solution.unconnected),
            'median_gap_m': float(np.median(gaps)) if gaps else None,
            'text': str(self),
        }

    def __str__(self) -> str:
        settled = 'settled' if self.solution.settled else 'not settled'
        return (
            f'{self.num_moved} of {len(self.stamps_ns)} scans moved, by at most '
            f'{self.largest_m:.3f} m and {self.largest_deg:.3f} deg; {settled} after '
            f'{counted(self.solution.rounds, "round")}'
        )


class WindowAligner:
    """
    Moves the scans of a window, and keeps the correction for later scans.

    Parameters
    ----------
    moments_at : callable
        Takes a scan with its points and a pose; returns its moments there.

    Attributes
    ----------
    T_map_fixed : (4, 4) float64
        From the fixed frame of the poses that come in, shifted by the origin of the map, to the
        map; the identity at first.
    is_corrected : bool
        Whether it is not the identity.

    """

    def __init__(self, moments_at: Callable[[WindowedScan, Transform], ScanMoments]) -> None:
        self._moments_at = moments_at
        self.reset()

    def reset(self) -> None:
        """Drop the correction, as for an empty map."""
        self.T_map_fixed: Transform = np.eye(4)
        self.is_corrected = False
        self._samples: dict[int, tuple[object, Samples]] = {}
        self._num_new = 0

    def to_map(self, T_fixed_sensor: Transform) -> Transform:
        """Return the pose in the map of a sensor whose pose in the fixed frame is given."""
        if not self.is_corrected:
            return T_fixed_sensor  # to the bit
        return compose(self.T_map_fixed, T_fixed_sensor)

    def to_fixed(self, T_map_sensor: Transform) -> Transform:
        """Return the pose in the fixed frame of a sensor whose pose in the map is given."""
        if not self.is_corrected:
            return T_map_sensor  # to the bit
        return compose(inverse(self.T_map_fixed), T_map_sensor)

    def correct(self, T_after_before: Transform) -> None:
        """Correct later scans as the newest one was moved in the map."""
        if not np.array_equal(T_after_before, IDENTITY):
            self.T_map_fixed = compose(T_after_before, self.T_map_fixed)
            self.is_corrected = not np.array_equal(self.T_map_fixed, IDENTITY)

    def is_due(self, every_scans: int) -> bool:
        """Count a scan, and return whether it is time to align."""
        self._num_new += 1
        return 0 < every_scans <= self._num_new

    def align(self, window: SlidingWindow, config: Config) -> Alignment:
        """
        Align the scans of a window and move them.

        Raises
        ------
        AlignmentError
            If there are fewer than two scans, points are not kept, or no poses follow. Nothing
            has changed then.
        MapError
            If the map refuses a scan at its new pose. Nothing has changed then.

        """
        self._num_new = 0
        scans = list(window)
        self._check(len(window), scans, config.map.columns)
        old_poses = np.array([scan.T_map_sensor for scan in scans]).reshape(-1, 4, 4)
        samples = self._samples_of(scans, config.align.voxel_size_m)
        frames = [scan.frame_id for scan in scans]
        alignment = align_scans(samples, old_poses, config.align, frames)
        rows, largest_m, largest_deg = moved_rows(old_poses, alignment.T_map_sensor, config.align)
        moved = {}
        for row in rows:
            scan, pose = scans[row], alignment.T_map_sensor[row]
            moments = self._moments_at(scan, pose)
            moved[row] = replace(scan, moments=moments, T_map_sensor=pose)
        fallen = window.move(moved, config.map.min_points)
        new_poses = np.array([scan.T_map_sensor for scan in window])
        if len(scans) - 1 in moved:
            self.correct(compose(new_poses[-1], inverse(old_poses[-1])))
        return Alignment(
            solution=alignment,
            stamps_ns=np.array([scan.stamp_ns for scan in scans], np.int64),
            T_map_sensor=new_poses,
            T_map_fixed=self.T_map_fixed,
            num_moved=len(moved),
            largest_m=largest_m,
            largest_deg=largest_deg,
            removed_voxel_index=fallen,
        )

    def _check(self, num_scans: int, scans: list[WindowedScan], columns: tuple[str, ...]) -> None:
        num_kept = sum(
            scan.points is not None and scan.columns.keys() >= set(columns) for scan in scans
        )
        if num_kept < num_scans:
            raise AlignmentError(
                f'{num_kept} of {num_scans} scans have their points and mapped columns, which '
                'alignment needs: set window.keep_points from the start'
            )
        if num_scans < 2:
            raise AlignmentError(f'{counted(num_scans, "scan")} in the map, expected two or more')

    def _samples_of(self, scans: list[WindowedScan], voxel_size_m: float) -> list[Samples]:
        """Return the surfels of each scan in its own frame, made once per scan."""
        kept: dict[int, tuple[object, Samples]] = {}
        for scan in scans:
            cached = self._samples.get(id(scan.points))  # alive, as it is kept here
            kept[id(scan.points)] = cached or (scan.points, _samples(scan, voxel_size_m))
        self._samples = kept
        return [kept[id(scan.points)][1] for scan in scans]


def moved_rows(
    old: npt.NDArray[np.float64], new: npt.NDArray[np.float64], limits: AlignConfig
) -> tuple[list[int], float, float]:
    """Return the rows of poses (S, 4, 4) that move, and their largest motion, m and deg."""
    pairs = zip(old, new, strict=True)
    extents = enumerate(extent(compose(inverse(T_old), T_new)) for T_old, T_new in pairs)
    moved = {row: e for row, e in extents if e[0] > limits.move_m or e[1] > limits.move_deg}
    largest_m, largest_deg = np.max([(0.0, 0.0), *moved.values()], axis=0).tolist()
    return list(moved), largest_m, largest_deg


def _samples(scan: WindowedScan, voxel_size_m: float) -> Samples:
    surfel_map = SurfelMap(voxel_size_m)
    assert scan.points is not None, 'checked before'
    # add refuses points out of reach, and smaller voxels than those of the map reach less far
    surfel_map.insert(surfel_map.reduce(scan.points, origin=np.zeros(3)))
    return Samples.of_surfels(surfel_map.surfels(MIN_POINTS))
