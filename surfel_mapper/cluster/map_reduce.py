# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Bags to one map in tiles: shards are mapped until each continues the one before, then merged.

By induction from the first shard of a recording, which starts with an empty state, shards that
agree at all borders are equal to the work of a single process.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
import logging
from pathlib import Path
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.cluster.executors import Executor, never
from surfel_mapper.cluster.shards import LEAD_GROWTH, map_shard, Shard, ShardResult
from surfel_mapper.cluster.tiles import (
    merge_parts,
    OnDone,
    parts_by_tile,
    TiledMap,
    work_directory,
)

log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True)
class MapReduceResult:
    """
    Result of all shards.

    Attributes
    ----------
    map : TiledMap
    results : list of ShardResult
        In the order of the shards.
    repeated : int
        Shards that were mapped again because they had begun too late.
    interrupted : bool
        Whether shards are missing because it was stopped.
    merge_s : float
        Seconds in which they were merged.

    """

    map: TiledMap
    results: list[ShardResult]
    repeated: int
    interrupted: bool
    merge_s: float

    def trajectory(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """Return stamps (S,), ns, and T_map_sensor (S, 4, 4) of all scans, by ascending stamp."""
        stamps_ns = np.concatenate([result.stamps_ns for result in self.results])
        order = np.argsort(stamps_ns, kind='stable')
        return stamps_ns[order], np.concatenate([result.poses for result in self.results])[order]

    def counts(self) -> dict[str, Any]:
        """Return the counts of all shards together, as Counters.summary has them."""
        total: dict[str, Any] = {}
        for result in self.results:
            total = added(total, result.counts)
        return total


def map_bags(
    shards: Sequence[Shard],
    executor: Executor,
    directory: Path,
    on_done: OnDone = lambda kind, amount: None,
    stopped: Callable[[], bool] = never,
) -> MapReduceResult:
    """
    Map shards into a dataset of tiles.

    Parameters
    ----------
    shards : sequence of Shard
        All of each bag, in order.
    executor : Executor
        Runs the tasks.
    directory : Path
        The output directory; the tiles are in ``map`` inside it.
    on_done : callable
        Called after every shard and tile, for progress.
    stopped : callable
        Asked again and again; once it returns True, no more shards are begun.

    Raises
    ------
    MapError
        If no scan was mapped, or a voxel would hold too many points.
    BagError, FileFormatError, ClusterError
        If a bag cannot be read, a file cannot be written, or the workers are lost.

    """
    with work_directory(directory) as work:
        run = ShardRun(dict(enumerate(shards)), executor, work, on_done)
        is_whole = run.all(stopped)
        results = run.ordered()
        mapped_s = time.perf_counter()
        parts = parts_by_tile(result.parts for result in results)
        tiled = merge_parts(parts, executor, directory, shards[0].config.map.min_points, on_done)
    return MapReduceResult(
        map=tiled,
        results=results,
        repeated=run.repeated,
        interrupted=not is_whole,
        merge_s=time.perf_counter() - mapped_s,
    )


@dataclass(slots=True)
class ShardRun:
    """Maps shards, again if one began too late, until each continues the one before it."""

    shards: dict[int, Shard]
    """By number; a bag that becomes one shard keeps its first number."""

    executor: Executor
    work: Path
    on_done: OnDone
    repeated: int = 0
    results: dict[int, ShardResult] = field(default_factory=dict)

    def all(self, stopped: Callable[[], bool]) -> bool:
        """Map all shards, after a stop keep the consistent ones; return whether all are done."""
        wanted = list(self.shards)
        while wanted:
            paths = [str(self.work / f'shard-{number}.parquet') for number in wanted]
            tasks = [(self.shards[n], path) for n, path in zip(wanted, paths, strict=True)]
            for done, result in self.executor.run(map_task, tasks, stopped):
                if not self.repeated:  # the first round covers the recordings
                    self.on_done('map', result.recorded_s)
                self.results[wanted[done]] = result
            if stopped():
                self.keep_consistent()
                return self.results.keys() == self.shards.keys()
            wanted = self.set_back() or self.begun_too_late()
            self.repeated += len(wanted)
        return True

    def keep_consistent(self) -> None:
        """Keep the leading shards of every recording that continue each other, without a gap."""
        self.set_back()
        for number, shard in self.shards.items():
            if shard.start_ns is not None and not self.continues(number):
                self.results.pop(number, None)

    def ordered(self) -> list[ShardResult]:
        """Return the results in the order of the shards."""
        return [self.results[number] for number in sorted(self.results)]

    def begun_too_late(self) -> list[int]:
        """Return the shards that do not continue the one before; they begin earlier next time."""
        late = []
        for number, shard in self.shards.items():
            if shard.start_ns is None or number not in self.results:
                continue
            if not self.continues(number):
                late.append(number)
                self.shards[number] = replace(shard, lead_s=shard.lead_s * LEAD_GROWTH)
        return late

    def continues(self, number: int) -> bool:
        """Return whether a shard starts with the state in which the one before it ended."""
        before, after = self.results.get(number - 1), self.results.get(number)
        return before is not None and after is not None and after.before == before.after

    def set_back(self) -> list[int]:
        """
        Return the first shards of bags in which time was set back: each becomes its bag.

        The other shards of such a bag, and the results of all of them, are dropped.
        """
        again = []
        for number, shard in list(self.shards.items()):
            parts = [n for n, other in self.shards.items() if other.request is shard.request]
            if shard.start_ns is not None or shard.stop_ns is None:
                continue
            if any(self.results[n].resets for n in parts if n in self.results):
                path = shard.request.path
                log.warning('%s: its stamps jump back; it is mapped as one shard', path)
                for part in parts:
                    del self.shards[part]
                    self.results.pop(part, None)
                self.shards[number] = replace(shard, stop_ns=None)
                again.append(number)
        return again


def map_task(task: tuple[Shard, str]) -> ShardResult:
    """Map a shard to a file."""
    return map_shard(*task)


def added(first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    """Return the sums of counts; of the times of stages, the larger."""
    total = dict(first)
    for name, value in second.items():
        if isinstance(value, dict):
            total[name] = added(total.get(name, {}), value)
        elif name in ('median', 'p99'):
            total[name] = max(total.get(name, 0.0), value)
        else:
            total[name] = total.get(name, 0) + value
    return total
