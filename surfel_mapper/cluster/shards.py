# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Map: shards, which are bags cut by record time, each mapped on its own as a part of the whole.

A worker starts to read some time before its shard (the lead), so that poses and stamps are known
when the shard begins. The state that decides about later scans is hashed at both ends
(ShardMapper.outlook): if the end of one shard and the start of the next agree, both make the map
of a single process.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
import math
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.bags.reader import BagMessage
from surfel_mapper.config import Config
from surfel_mapper.errors import BagError, ConfigError
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.offline.bag_recording import add_cloud, add_poses, add_static, BagRecording
from surfel_mapper.offline.outputs import ScanTrajectory
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.replay import all_scans
from surfel_mapper.offline.request import Request
from surfel_mapper.pipeline import ScanOutcome
from surfel_mapper.pipeline.shard_mapper import is_divisible, ShardMapper, sweep_s
from surfel_mapper.pipeline.update import Update

SHORTEST_S, LONGEST_S = 5.0, 60.0
"""Bounds of the length of a shard, s: its lead is read twice, its map is held in memory."""

SLACK = 0.02
"""Share by which shards may be longer, to avoid one more short shard."""

LEAD_S = 1.0
"""Time before the oldest pose that a worker may need, s."""

SETTINGS: dict[str, Any] = {
    **all_scans(),
    'layers.tsdf.enabled': False,
    'layers.models.enabled': False,
}
"""Settings of shards: all scans stay, and no layers are kept, as they are not added up."""


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
    map : SurfelMap
        Its part of the map.
    config : Config
        The settings, with the source of the poses.
    start_outlook, end_outlook : str, optional
        Outlook at its start and at its stop; None at the ends of the bag.
    counts : dict
        ``Counters.summary`` of this part alone.
    resets : int
        Times that the clock was set back, in its lead too.
    recorded_s, core_s : float
        Time from its start to its stop, and processor time of mapping it.
    stamps_ns : (S,) int64
        Stamps of the mapped scans.
    poses : (S, 4, 4) float64
        Their T_map_sensor.
    outcomes : list of ScanOutcome
        Outcomes of its scans.

    """

    map: SurfelMap
    config: Config
    start_outlook: str | None
    end_outlook: str | None
    counts: dict[str, Any]
    resets: int
    recorded_s: float
    core_s: float
    stamps_ns: npt.NDArray[np.int64]
    poses: npt.NDArray[np.float64]
    outcomes: list[ScanOutcome]


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
    whole = Shard(request=absolute(request), config=config.replace(SETTINGS))
    with open_recording(request, whole.config) as recording:
        if not isinstance(recording, BagRecording) or not may_be_cut(recording):
            return [whole]
        start_ns, stop_ns = recording.bounds_ns
    number = max(math.ceil((stop_ns - start_ns) / 1e9 / shard_s - SLACK), 1)
    bounds = [start_ns + (stop_ns - start_ns) * k // number for k in range(1, number)]
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


def map_shard(shard: Shard) -> ShardResult:
    """
    Map a shard; runs on a worker.

    Raises
    ------
    BagError
        If the recording cannot be read.
    FileFormatError
        If a file cannot be read.

    """
    began = time.process_time()
    keep_freed_memory()
    with open_recording(shard.request, shard.config) as recording:
        mapper = ShardMapper(recording.config)
        mapper.outcomes, mapper.pose_source = [], recording.describe()['poses_from']
        trajectory = ScanTrajectory(mapper)
        start = ShardStart()
        if shard.is_whole:
            updates = recording.replay(mapper)
        elif isinstance(recording, BagRecording):
            updates = replay_middle(recording, mapper, shard, start)
        else:
            raise TypeError(f'{shard.request.path}: only bags are cut')
        for update in updates:
            trajectory.add(update)
        recorded_s = recording.recorded_s
        if isinstance(recording, BagRecording):
            first_ns, last_ns = recording.bounds_ns
            start_ns = first_ns if shard.start_ns is None else shard.start_ns
            recorded_s = ((shard.stop_ns or last_ns) - start_ns) / 1e9
    return ShardResult(
        map=mapper.map,
        config=mapper.config,
        start_outlook=start.outlook,
        end_outlook=None if shard.stop_ns is None else mapper.outlook(),
        counts=difference(mapper.counters.summary(), start.counts),
        resets=mapper.counters.resets,
        recorded_s=recorded_s,
        core_s=time.process_time() - began,
        stamps_ns=np.array(trajectory.stamps_ns, np.int64),
        poses=trajectory.matrices,
        outcomes=mapper.outcomes or [],
    )


@dataclass(slots=True)
class ShardStart:
    """Outlook and counts of a mapper at the start of its shard."""

    outlook: str | None = None
    counts: dict[str, Any] = field(default_factory=dict)

    def record(self, mapper: ShardMapper) -> None:
        """Take them from a mapper that maps from now on."""
        self.outlook, self.counts = mapper.outlook(), mapper.counters.summary()
        mapper.passes_over, mapper.outcomes = False, []


def replay_middle(
    recording: BagRecording, mapper: ShardMapper, shard: Shard, start: ShardStart
) -> Iterator[Update]:
    """Feed a shard to a mapper after its lead, and record its start; yield the updates."""
    if recording.config.input.kind == 'depth':
        raise BagError(f'{recording.reader.path}: depth images are mapped by one process alone')
    reader, poses, clouds = recording.reader, recording.poses, set(recording.topics)
    mapper.passes_over = shard.start_ns is not None
    static = add_static(reader, mapper, poses)
    for message in messages_of(recording, shard):
        if mapper.passes_over and message.record_ns >= (shard.start_ns or 0):
            start.record(mapper)
        if message.topic not in clouds:
            add_poses(reader, mapper, message, poses, static)
        elif recording.span.holds(message.record_ns):
            add_cloud(reader, mapper, message, poses, 0)
        yield from mapper.insert_ready()
    if mapper.passes_over:  # no message was recorded since
        start.record(mapper)
    if shard.stop_ns is None:
        mapper.end_scans()
        yield from mapper.insert_ready()
        mapper.finish()


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


def difference(counts: dict[str, Any], earlier: dict[str, Any]) -> dict[str, Any]:
    """Return counts less earlier ones; times of stages stay as they are."""
    change: dict[str, Any] = {}
    for name, value in counts.items():
        if name == 'milliseconds':
            change[name] = value
        elif isinstance(value, dict):
            change[name] = difference(value, earlier.get(name, {}))
        else:
            change[name] = value - earlier.get(name, 0)
    return change
