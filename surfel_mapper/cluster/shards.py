# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Map: shards, which are bags cut by record time, each mapped on its own as a part of the whole.

A worker starts to read some time before its shard (the lead), so that poses and stamps are known
when the shard begins. The state that decides about later scans is hashed at both ends
(ShardMapper.outlook). If the end of one shard and the start of the next disagree, the next is
mapped again with a longer lead.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
import math
from pathlib import Path
import resource
import sys
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.bags.reader import BagMessage
from surfel_mapper.config import Config
from surfel_mapper.errors import BagError, ConfigError
from surfel_mapper.files.parquet_tiles import Part, Tile, write_shard
from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.offline.bag_recording import add_cloud, add_poses, BagRecording
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.replay import ALL_SCANS
from surfel_mapper.offline.request import Request
from surfel_mapper.pipeline.shard_mapper import is_divisible, ShardMapper, sweep_s
from surfel_mapper.pipeline.update import Update

SHORTEST_S, LONGEST_S = 5.0, 60.0
"""Bounds of the length of a shard, s: its lead is read twice, its map is held in memory."""

SLACK = 0.02
"""Share by which shards may be longer, to avoid one more short shard."""

LEAD_S = 1.0
"""First lead: time before the oldest pose that a worker may need, s."""

LEAD_GROWTH = 8.0
"""Factor by which a lead grows if it was too short."""

StampedPose = tuple[int, npt.NDArray[np.float64]]
"""Stamp, ns, and T_map_sensor of a scan."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shard:
    """
    A part of a recording, in plain values.

    Attributes
    ----------
    request : Request
        The recording, with absolute paths, and the part that all shards map together.
    config : Config
        The settings.
    start_ns, stop_ns : int, optional
        Record time of its first message, and of the first one after it; None at the ends of the
        part that is mapped.
    lead_s : float
        Time before its start at which reading begins, s.

    """

    request: Request
    config: Config
    start_ns: int | None = None
    stop_ns: int | None = None
    lead_s: float = 0.0

    @property
    def is_whole(self) -> bool:
        """Whether it is the whole part of its recording."""
        return self.start_ns is None and self.stop_ns is None


@dataclass(frozen=True, slots=True, kw_only=True)
class ShardResult:
    """
    Result of a shard.

    Attributes
    ----------
    parts : dict of Tile to Part
        Files of its map, by tile.
    before, after : str, optional
        Outlook at its start and at its stop; None at the ends of the bag.
    counts : dict
        ``Counters.summary`` of this part alone.
    resets : int
        Times that the clock was set back, in its lead too.
    recorded_s, seconds, core_s : float
        Time from its start to its stop, wall time of mapping it, and processor time.
    stamps_ns : (S,) int64
        Stamps of the mapped scans.
    poses : (S, 4, 4) float64
        Their T_map_sensor.
    peak_bytes : int
        Peak memory of the process until the end of the shard.

    """

    parts: dict[Tile, Part]
    before: str | None
    after: str | None
    counts: dict[str, Any]
    resets: int
    recorded_s: float
    seconds: float
    core_s: float
    stamps_ns: npt.NDArray[np.int64]
    poses: npt.NDArray[np.float64]
    peak_bytes: int


def shard_length_s(recorded_s: float, num_workers: int) -> float:
    """
    Return the length of shards, s: few shards, and equally many for every worker.

    Three shards for two workers would leave one of them idle for a third of the time.
    """
    rounds = max(math.ceil(recorded_s / (num_workers * LONGEST_S)), 1)
    return max(recorded_s / (rounds * num_workers), SHORTEST_S)


def cut(request: Request, config: Config, shard_s: float) -> list[Shard]:
    """
    Return the shards of a recording, of equal length and hardly longer than wanted.

    Parameters
    ----------
    request : Request
        The recording and its part.
    config : Config
        The settings; all scans stay in the map, their window is ignored. If they make a scan
        depend on all before it, the recording is one shard, and so is a folder of scans.
    shard_s : float
        Length of a shard, s.

    Raises
    ------
    BagError, FileFormatError
        If the recording cannot be read or lacks a topic or poses.
    ConfigError
        If the settings need a single process.

    """
    if config.map.mode != 'live' or config.map.load:
        raise ConfigError(
            f'map.mode {config.map.mode!r}, map.load {config.map.load!r}: several processes '
            "begin with empty maps; expected 'live' and '', or a single process"
        )
    whole = Shard(request=absolute(request), config=config.replace(ALL_SCANS))
    with open_recording(request, whole.config) as recording:
        if not isinstance(recording, BagRecording) or not may_be_cut(recording):
            return [whole]
        start_ns, stop_ns = recording.bounds_ns
    number = max(math.ceil((stop_ns - start_ns) / 1e9 / shard_s - SLACK), 1)
    bounds = [start_ns + (stop_ns - start_ns) * part // number for part in range(1, number)]
    lead_s = LEAD_S + config.input.reset_after_s + sweep_s(config)
    return [
        replace(whole, start_ns=first, stop_ns=last, lead_s=lead_s)
        for first, last in zip([None, *bounds], [*bounds, None], strict=True)
    ]


def absolute(request: Request) -> Request:
    """Return a request that means the same in another directory."""
    poses = None if request.poses is None else request.poses.absolute()
    return replace(request, path=request.path.absolute(), poses=poses)


def may_be_cut(recording: BagRecording) -> bool:
    """Return whether a scan depends on neighbouring messages alone, and not on its number."""
    path = recording.poses.path
    by_number = recording.span.every > 1 or (path is not None and not path.has_stamps)
    return is_divisible(recording.config) and not by_number


def map_shard(shard: Shard, path: str) -> ShardResult:
    """
    Map a shard and write its part of the map to a file; runs on a worker.

    Raises
    ------
    BagError
        If the recording cannot be read.
    FileFormatError
        If a file cannot be read or written.

    """
    began, began_core = time.perf_counter(), time.process_time()
    keep_freed_memory()
    start = ShardStart()
    with open_recording(shard.request, shard.config) as recording:
        mapper = ShardMapper(recording.config)
        recorded_s = recording.recorded_s
        if shard.is_whole:
            mapped = [stamped_pose(update) for update in recording.replay(mapper)]
        elif isinstance(recording, BagRecording):
            start, mapped = map_middle(recording, mapper, shard)
            first_ns, last_ns = recording.bounds_ns
            start_ns = first_ns if shard.start_ns is None else shard.start_ns
            recorded_s = ((shard.stop_ns or last_ns) - start_ns) / 1e9
        else:
            raise TypeError(f'{shard.request.path}: only bags are cut')
    parts = write_shard(path, mapper.map)
    return ShardResult(
        parts=parts,
        before=start.outlook,
        after=None if shard.stop_ns is None else mapper.outlook(),
        counts=difference(mapper.counters.summary(), start.counts),
        resets=mapper.counters.resets,
        recorded_s=recorded_s,
        seconds=time.perf_counter() - began,
        core_s=time.process_time() - began_core,
        stamps_ns=np.array([stamp_ns for stamp_ns, _ in mapped], np.int64),
        poses=np.array([pose for _, pose in mapped]).reshape(-1, 4, 4),
        peak_bytes=peak_bytes(),
    )


@dataclass(frozen=True, slots=True)
class ShardStart:
    """Outlook and counts of a mapper at the start of its shard."""

    outlook: str | None = None
    counts: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, mapper: ShardMapper) -> ShardStart:
        """Return outlook and counts of a mapper."""
        return cls(mapper.outlook(), mapper.counters.summary())


def map_middle(
    recording: BagRecording, mapper: ShardMapper, shard: Shard
) -> tuple[ShardStart, list[StampedPose]]:
    """Map a shard after its lead; return the state at its start, and the poses of its scans."""
    reader, poses, clouds = recording.reader, recording.poses, set(recording.topics)
    if recording.config.input.kind == 'depth':
        raise BagError(f'{reader.path}: depth images are mapped by one process alone')
    start, mapped = ShardStart(), []
    mapper.passes_over = shard.start_ns is not None
    for topic, place in poses.mounts.items():
        base = mapper.config.frames.base
        mapper.add_pose(base, topic, 0, place[:3], place[3:], static=True)
    for message in messages_of(recording, shard):
        if mapper.passes_over and message.record_ns >= (shard.start_ns or 0):
            start = ShardStart.of(mapper)
            mapper.passes_over = False
        if message.topic not in clouds:
            add_poses(reader, mapper, message, poses)
        elif recording.span.holds(message.record_ns):
            add_cloud(reader, mapper, message, poses, 0)
        mapped += [stamped_pose(update) for update in mapper.insert_ready()]
    if mapper.passes_over:  # no message was recorded since
        start = ShardStart.of(mapper)
    if shard.stop_ns is None:
        mapper.end_scans()
        mapped += [stamped_pose(update) for update in mapper.insert_ready()]
        mapper.finish()
    return start, mapped


def stamped_pose(update: Update) -> StampedPose:
    """Return the stamp, ns, and T_map_sensor of a mapped scan."""
    return update.stamp_ns, update.T_map_sensor


def messages_of(recording: BagRecording, shard: Shard) -> Iterator[BagMessage]:
    """Yield static transforms from before a shard, then its messages from its lead on."""
    reader, poses, span = recording.reader, recording.poses, recording.span
    first_ns = span.poses_start_ns
    if shard.start_ns is not None:
        earliest_ns = reader.start_ns if first_ns is None else first_ns
        lead_ns = shard.start_ns - round(shard.lead_s * 1e9)
        first_ns = lead_ns if lead_ns > earliest_ns else first_ns
    if poses.static and first_ns is not None:
        yield from reader.messages(poses.static, None, first_ns)
    names = {*recording.topics, *poses.kinds, *poses.static}
    last_ns = span.poses_stop_ns if shard.stop_ns is None else shard.stop_ns
    yield from reader.messages(names, first_ns, last_ns)


def difference(now: dict[str, Any], before: dict[str, Any]) -> dict[str, Any]:
    """Return counts less those before; times of stages stay as they are."""
    left: dict[str, Any] = {}
    for name, value in now.items():
        if name == 'milliseconds':
            left[name] = value
        elif isinstance(value, dict):
            left[name] = difference(value, before.get(name, {}))
        else:
            left[name] = value - before.get(name, 0)
    return left


def peak_bytes() -> int:
    """Return the peak memory of this process since its program began, bytes."""
    status = Path('/proc/self/status')
    for line in status.read_text().splitlines() if status.exists() else []:
        if line.startswith('VmHWM:'):
            return int(line.split()[1]) * 1024
    # without /proc; on Linux this would include the memory of the parent
    unit = 1 if sys.platform == 'darwin' else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
