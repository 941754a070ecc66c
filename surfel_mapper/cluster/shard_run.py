# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
ShardRun: all shards of some recordings, mapped until every one fits the one before it.

By induction from the first shard of a recording, which begins with nothing, shards that fit at
all borders are what a single process would have done.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
import logging
from pathlib import Path

from surfel_mapper.cluster.engines import Engine
from surfel_mapper.cluster.shards import LONGER, map_shard, Shard, ShardResult

log = logging.getLogger(__name__)

OnDone = Callable[[str, float], object]
"""Told how many seconds of recordings ('map') or tiles ('merge') got done."""


@dataclass(slots=True)
class ShardRun:
    """Maps shards, again where one began too late, until every one fits the one before it."""

    shards: list[Shard]
    engine: Engine
    work: Path
    on_done: OnDone
    repeated: int = 0
    results: dict[int, ShardResult] = field(default_factory=dict)

    def all(self, stopped: Callable[[], bool]) -> bool:
        """Map all shards, or keep of those done when it is stopped what fits; return if all."""
        wanted = list(range(len(self.shards)))
        while wanted:
            paths = [str(self.work / f'shard-{number}.parquet') for number in wanted]
            tasks = [(self.shards[n], path) for n, path in zip(wanted, paths, strict=True)]
            for done, result in self.engine.run(map_task, tasks, stopped):
                if wanted[done] not in self.results:
                    self.on_done('map', result.recorded_s)
                self.results[wanted[done]] = result
            if stopped():
                self.keep_what_fits()
                return len(self.results) == len(self.shards)
            wanted = self.torn() or self.begun_too_late()
            self.repeated += len(wanted)
        return True

    def keep_what_fits(self) -> None:
        """Of every recording keep the shards from its first one on that fit, without a gap."""
        for number in self.torn():
            self.results.pop(number, None)
        for number, shard in enumerate(self.shards):
            if shard.start_ns is not None and not self.fits(number):
                self.results.pop(number, None)

    def ordered(self) -> list[ShardResult]:
        """Return the results in the order of the shards."""
        return [self.results[number] for number in sorted(self.results)]

    def begun_too_late(self) -> list[int]:
        """Return the shards that do not fit the one before; they begin earlier next time."""
        late = []
        for number, shard in enumerate(self.shards):
            if shard.start_ns is None or number not in self.results:
                continue
            if not self.fits(number):
                late.append(number)
                self.shards[number] = replace(shard, lead_s=shard.lead_s * LONGER)
        return late

    def fits(self, number: int) -> bool:
        """Return whether a shard begins with what the one before it ends with, both being done."""
        before, after = self.results.get(number - 1), self.results.get(number)
        return before is not None and after is not None and after.before == before.after

    def torn(self) -> list[int]:
        """Return the first shards of bags in which time was set back: each is all of its bag."""
        again = []
        for number, shard in enumerate(self.shards):
            parts = [n for n, other in enumerate(self.shards) if other.request is shard.request]
            if shard.start_ns is not None or shard.stop_ns is None:
                continue
            if any(self.results[n].resets for n in parts if n in self.results):
                path = shard.request.path
                log.warning('%s: time is set back in it; it cannot be mapped in parts', path)
                self.shards[number] = replace(shard, stop_ns=None)
                again.append(number)
                for other in parts:
                    if self.shards[other].start_ns is not None:
                        self.results.pop(other, None)
        return again


def map_task(task: tuple[Shard, str]) -> ShardResult:
    """Map a shard to a file."""
    return map_shard(*task)
