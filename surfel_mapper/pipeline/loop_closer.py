# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LoopCloser: keeps the points of all scans on disk, and moves the scans once loops are found.

A moved scan is reduced again from its points at both poses, removed at the old one and added at
the new one, so the map equals, bit for bit, one built at the corrected poses. Memory holds a pose
and some 200 bytes for each scan.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.loop_search import LoopClosure, LoopSearch, Refusal
from surfel_mapper.arguments import Record
from surfel_mapper.config import Config
from surfel_mapper.errors import AlignmentError, counted
from surfel_mapper.files.scan_spool import ScanSpool
from surfel_mapper.geometry import compose, inverse, Transform
from surfel_mapper.mapping.channels import summed_columns
from surfel_mapper.mapping.moments import point_keys, ScanMoments, unpack_keys
from surfel_mapper.mapping.reducer import within
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import SlidingWindow
from surfel_mapper.pipeline.scan_poses import viewpoint
from surfel_mapper.pipeline.window_aligner import moved_rows
from surfel_mapper.scan import Scan

LISTED = 20
"""Maximum number of refused loops in a summary."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class LoopMove(Record):
    """
    The loops of a drive and the motion of its scans.

    Attributes
    ----------
    closure : LoopClosure
        Loops, refusals and poses.
    stamps_ns : (S,) int64
        Stamps of all scans.
    num_moved : int
        Scans that were moved.
    largest_m, largest_deg : float
        The most that a scan was moved and turned by.
    correction : (4, 4) float64
        Motion of the last scan in the map; exactly the identity if it did not move.
    removed_voxel_index : (K, 3) int32
        Voxels that were surfels and have too few points now.

    """

    closure: LoopClosure
    stamps_ns: npt.NDArray[np.int64]
    num_moved: int
    largest_m: float
    largest_deg: float
    correction: Transform
    removed_voxel_index: npt.NDArray[np.int32]

    def summary(self) -> dict[str, Any]:
        """Return it as plain numbers and as a sentence."""
        closure = self.closure
        return {
            'found': len(closure.loops) + len(closure.refusals),
            'accepted': len(closure.loops),
            'recognised': sum(loop.votes > 0 for loop in closure.loops),
            'refused': len(closure.refusals),
            'refusals': [self._described(refusal) for refusal in closure.refusals[:LISTED]],
            'keyframes': len(closure.keys),
            'moved': self.num_moved,
            'largest_m': self.largest_m,
            'largest_deg': self.largest_deg,
            'recognises_places': closure.recognises,
            'text': str(self),
        }

    def _described(self, refusal: Refusal) -> dict[str, Any]:
        keys, candidate = self.closure.keys, refusal.candidate
        source, target = (
            float(self.stamps_ns[keys[key]] / 1e9) for key in (candidate.source, candidate.target)
        )
        return {'at_s': source, 'with_s': target, 'reason': refusal.reason}

    def __str__(self) -> str:
        closure = self.closure
        if not closure.loops and not closure.refusals:
            return 'no loops found'
        recognised = sum(loop.votes > 0 for loop in closure.loops)
        return (
            f'{counted(len(closure.loops), "loop")} accepted ({recognised} found by place '
            f'recognition), {len(closure.refusals)} refused; '
            f'{self.num_moved} of {len(self.stamps_ns)} scans moved, '
            f'by at most {self.largest_m:.3f} m and {self.largest_deg:.3f} deg'
        )


class LoopCloser:
    """
    The scans of a drive on disk, with their poses.

    Parameters
    ----------
    config : Config
        ``loops`` and the settings of the map.
    surfel_map : SurfelMap
        The map that holds the scans.
    window : SlidingWindow
        Its window. Both end with the same scan; the window may begin with scans of a loaded map,
        and need not keep old scans that no limit can evict.

    Raises
    ------
    FileFormatError
        If no file can be made for the points.

    """

    def __init__(self, config: Config, surfel_map: SurfelMap, window: SlidingWindow) -> None:
        self._map = surfel_map
        self._window = window
        self._spool = ScanSpool(config.loops.directory)
        self._stamps_ns: list[int] = []
        self._frames: list[str] = []
        self._poses: list[Transform] = []
        self._emptied = [Emptied()]
        self._poses_before: list[list[Transform]] = []

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self._poses)

    @property
    def stamps_ns(self) -> list[int]:
        """Stamps of all scans."""
        return list(self._stamps_ns)

    @property
    def T_map_sensor(self) -> npt.NDArray[np.float64]:
        """Present poses of all scans, (S, 4, 4)."""
        return np.array(self._poses).reshape(-1, 4, 4)

    def add(self, scan: Scan, T_map_sensor: Transform, config: Config) -> None:
        """Keep the points of a scan that entered the map."""
        limits = config.input
        entered = scan.select(within(scan.points, limits.min_range_m, limits.max_range_m))
        self._spool.append(entered.points, summed_columns(entered.columns, self._map.columns))
        self._stamps_ns.append(scan.stamp_ns)
        self._frames.append(scan.frame_id)
        self._poses.append(T_map_sensor)

    def follow_window(self) -> None:
        """Take over the poses of the scans of the window, which were moved in the map."""
        self._begin_emptied()
        newest_first = zip(reversed(range(len(self))), reversed(list(self._window)), strict=False)
        for number, scan in newest_first:
            self._poses[number] = scan.T_map_sensor

    def drop_voxels(self, keys: npt.NDArray[np.int64]) -> None:
        """Note that voxels were emptied: the points of the scans so far in them stay removed."""
        self._emptied[-1].add(keys, len(self))

    def clear(self) -> None:
        """Drop all scans."""
        self._spool.clear()
        self._stamps_ns.clear()
        self._frames.clear()
        self._poses.clear()
        self._emptied = [Emptied()]
        self._poses_before.clear()

    def close(
        self, config: Config, progress: Callable[[str], object] = lambda text: None
    ) -> LoopMove:
        """
        Find the loops and move the scans.

        Raises
        ------
        AlignmentError
            If the map does not hold all scans any more, or there are fewer than two.
        FileFormatError, OSError
            If points cannot be read. Nothing has changed then.
        MapError
            If the map refuses a scan at its new pose. Nothing has changed then.

        """
        if len(self._window) < len(self):
            raise AlignmentError(
                f'the map holds {len(self._window)} of {len(self)} scans; loops are closed '
                'between scans of the map: the window must not evict any'
            )
        if len(self) < 2:
            raise AlignmentError(
                f'{counted(len(self), "scan")} since the map was cleared or loaded, '
                'expected two or more'
            )
        poses = self.T_map_sensor
        search = LoopSearch(
            self._spool,
            poses,
            config.loops,
            config.registration,
            config.map.voxel_size_m,
            self._frames,
        )
        return self.move(search.close(progress), config)

    def move(self, closure: LoopClosure, config: Config) -> LoopMove:
        """Move all scans to the poses of a closure; an error leaves all at their poses before."""
        previous = self.T_map_sensor
        moved, largest_m, largest_deg = moved_rows(previous, closure.T_map_sensor, config.align)
        full = self._map.keys(config.map.min_points)
        self._begin_emptied()
        self._move_all(moved, closure.T_map_sensor, config)
        still_full = self._map.keys(config.map.min_points)
        has_moved = not np.array_equal(self._poses[-1], previous[-1])
        return LoopMove(
            closure=closure,
            stamps_ns=np.array(self._stamps_ns, np.int64),
            num_moved=len(moved),
            largest_m=largest_m,
            largest_deg=largest_deg,
            correction=compose(self._poses[-1], inverse(previous[-1])) if has_moved else np.eye(4),
            removed_voxel_index=unpack_keys(np.setdiff1d(full, still_full)),
        )

    def _begin_emptied(self) -> None:
        """Keep the poses before a move with the voxels that were emptied until then."""
        if len(self._emptied[-1]):
            self._poses_before.append(list(self._poses))
            self._emptied.append(Emptied())

    def _move_all(
        self, moved: list[int], T_map_sensor: npt.NDArray[np.float64], config: Config
    ) -> None:
        """Move scans in the map; those that the window keeps, last and in the window too."""
        kept = list(self._window)
        num_settled = len(self) - len(kept)  # negative with scans of a loaded map
        with ExitStack() as undo:
            for number in moved:
                if number < num_settled:
                    T_before = self._poses[number]
                    self._move_settled(number, T_map_sensor[number], config)
                    undo.callback(self._move_settled, number, T_before, config)
            self._window.move(
                {
                    number - num_settled: replace(
                        kept[number - num_settled],
                        moments=self._moments(number, T_map_sensor[number], config),
                        T_map_sensor=T_map_sensor[number],
                    )
                    for number in moved
                    if number >= num_settled
                }
            )
            undo.pop_all()
        for number in moved:
            self._poses[number] = T_map_sensor[number]

    def _move_settled(self, number: int, T_map_sensor: Transform, config: Config) -> None:
        """
        Move a scan that the window does not keep, in the map and in the poses.

        The poses follow scan by scan: if the points of a scan stay unreadable, its move cannot be
        undone, and its pose has to be the one in the map.
        """
        new = self._moments(number, T_map_sensor, config)
        old = self._moments(number, self._poses[number], config)
        with ExitStack() as undo:
            self._map.insert(new)
            undo.callback(self._map.remove, new)
            self._map.remove(old)
            undo.pop_all()
        self._poses[number] = T_map_sensor

    def _moments(self, number: int, T_map_sensor: Transform, config: Config) -> ScanMoments:
        """Return the moments of a scan at a pose, without the points of voxels emptied since."""
        points, columns = self._spool.points(number), self._spool.columns(number)
        stay = np.ones(len(points), bool)
        epochs = zip(self._emptied, [*self._poses_before, self._poses], strict=True)
        for emptied, poses in epochs:
            if number < emptied.num_scans:
                keys = point_keys(points, poses[number], config.map.voxel_size_m)
                stay &= ~emptied.contains(keys, number)
        if not stay.all():
            points = np.asfortranarray(points[stay])
            columns = {name: column[stay] for name, column in columns.items()}
        return self._map.reduce(
            points, T_map_sensor, origin=viewpoint(T_map_sensor, config), columns=columns
        )


class Emptied:
    """Voxels that were emptied, and the number of scans at the last time; see drop_voxels."""

    def __init__(self) -> None:
        self._batches: list[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]] = []
        self.num_scans = 0

    def __len__(self) -> int:
        """Return the number of voxels that were noted."""
        return sum(len(keys) for keys, _ in self._batches)

    def add(self, keys: npt.NDArray[np.int64], num_scans: int) -> None:
        """Note that voxels were emptied after a number of scans."""
        if len(keys):
            self._batches.append((keys, np.full(len(keys), num_scans, np.int64)))
            self.num_scans = num_scans

    def contains(self, keys: npt.NDArray[np.int64], number: int) -> npt.NDArray[np.bool_]:
        """Return which voxels of a scan were emptied after it."""
        emptied, last = self._merged()
        at = np.minimum(np.searchsorted(emptied, keys), len(emptied) - 1)
        return np.asarray((emptied[at] == keys) & (last[at] > number))

    def _merged(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return each voxel once, sorted, with the last number of scans."""
        if len(self._batches) > 1:
            keys, last = (np.concatenate(arrays) for arrays in zip(*self._batches, strict=True))
            order = np.lexsort((last, keys))
            keys, last = keys[order], last[order]
            ends = np.append(keys[1:] != keys[:-1], True)
            self._batches = [(keys[ends], last[ends])]
        elif self._batches:
            keys, last = self._batches[0]
            order = np.argsort(keys)
            self._batches = [(keys[order], last[order])]
        return self._batches[0]
