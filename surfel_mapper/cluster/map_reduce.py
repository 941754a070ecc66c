# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Shards of bags to one map: those of a bag are added up when each continues the one before.

By induction from the first shard, which starts with an empty state, such shards are equal to the
work of a single process. A bag of other shards is mapped again as one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count, takewhile
import logging
from typing import Any

import numpy as np

from surfel_mapper.cluster.shards import continues, map_shard, Shard, ShardResult
from surfel_mapper.cluster.workers import never, Workers
from surfel_mapper.errors import MapError
from surfel_mapper.pipeline import Mapper, ScanOutcome

log = logging.getLogger(__name__)

OnDone = Callable[[float], object]
"""Called with the seconds of a recording that are done."""


@dataclass(slots=True)
class MappedBags:
    """
    The sum of shards.

    Attributes
    ----------
    mapper : Mapper
        Its map is the sum.
    counts : dict
        Sums of ``Counters.summary``.
    stamps_ns : list of int
    poses : list of (4, 4) float64
        T_map_sensor of each mapped scan.
    outcomes : list of ScanOutcome
        Outcomes of the scans.
    num_shards, repeated : int
        Shards added up, and bags that were mapped again as one.
    core_s : float
        Processor time of mapping, s.
    interrupted : bool
        Whether shards are missing because it was stopped.

    """

    mapper: Mapper
    counts: dict[str, Any] = field(default_factory=dict)
    stamps_ns: list[int] = field(default_factory=list)
    poses: list[Any] = field(default_factory=list)
    outcomes: list[ScanOutcome] = field(default_factory=list)
    num_shards: int = 0
    repeated: int = 0
    core_s: float = 0.0
    interrupted: bool = False

    def add(self, results: Sequence[ShardResult]) -> None:
        """Add the shards of a bag."""
        for result in results:
            self.mapper.map.merge(result.map)
            self.counts = added(self.counts, result.counts)
            self.stamps_ns += result.stamps_ns.tolist()
            self.poses += list(result.poses)
            self.outcomes += result.outcomes
            self.core_s += result.core_s
        self.num_shards += len(results)

    def sort_scans(self) -> None:
        """Sort the scans by stamp."""
        order = np.argsort(self.stamps_ns, kind='stable').tolist()
        self.stamps_ns = [self.stamps_ns[row] for row in order]
        self.poses = [self.poses[row] for row in order]


def map_bags(
    bags: Sequence[Sequence[Shard]],
    workers: Workers,
    on_done: OnDone = lambda seconds: None,
    stopped: Callable[[], bool] = never,
) -> MappedBags:
    """
    Map bags and add them up, each when all its shards are done.

    Parameters
    ----------
    bags : sequence of sequence of Shard
        All shards of each bag, in order.
    workers : Workers
        Run the tasks.
    on_done : callable
        Called after every shard, for progress.
    stopped : callable
        Asked again and again; once it returns True, no more shards are begun, and of each bag the
        unbroken run of shards from its start is added.

    Raises
    ------
    MapError
        If no scan was mapped, or a voxel would hold too many points.
    BagError, FileFormatError, ClusterError
        If a bag or a file cannot be read, or the workers are lost.

    """
    total = MappedBags(Mapper(bags[0][0].config.replace({'pose.source': 'identity'})))
    unfinished: dict[int, dict[int, ShardResult]] = {bag: {} for bag in range(len(bags))}
    indices = [(bag, index) for bag, shards in enumerate(bags) for index in range(len(shards))]
    tasks = [shard for shards in bags for shard in shards]
    for number, result in workers.run(map_shard, tasks, stopped):
        on_done(result.recorded_s)
        bag, index = indices[number]
        unfinished[bag][index] = result
        if len(unfinished[bag]) == len(bags[bag]) and continues(
            results := leading(unfinished[bag])
        ):
            total.add(results)
            del unfinished[bag]
    unordered_bags = [bag for bag, results in unfinished.items() if len(results) == len(bags[bag])]
    for bag in unordered_bags:
        log.warning(
            '%s: its scans are out of order; it is mapped as one', bags[bag][0].request.path
        )
    wholes = [replace(bags[bag][0], span=None) for bag in unordered_bags]
    for number, result in workers.run(map_shard, wholes, stopped):
        total.add([result])
        total.repeated += 1
        del unfinished[unordered_bags[number]]
    for partial in unfinished.values():
        results = leading(partial)
        total.add(results if continues(results) else results[:1])
    total.interrupted = bool(unfinished)
    if not total.stamps_ns:
        raise MapError('no scan was mapped')
    total.sort_scans()
    return total


def leading(results: Mapping[int, ShardResult]) -> list[ShardResult]:
    """Return the shards from the start of a bag up to the first that is not done."""
    return [results[number] for number in takewhile(results.__contains__, count())]


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
