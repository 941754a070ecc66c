# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Map: shards, which are bags cut by record time, each mapped on its own as a part of the whole.

A shard is a part of a recording as ``replay --start --duration`` maps it, with the poses of 5 s
before and after it. Moments are integers, so the sum of the shards is the map of a single process
unless scans of one sensor are out of order at a border. ``continues`` notices that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.errors import ConfigError
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.offline.bag_recording import BagRecording, feed
from surfel_mapper.offline.outputs import ScanTrajectory
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.replay import all_scans
from surfel_mapper.offline.request import MARGIN_NS, Request, Span
from surfel_mapper.pipeline import Mapper, ScanOutcome

SHORTEST_S, LONGEST_S = 5.0, 60.0
"""Bounds of the length of a shard, s: its margins are read twice, its map is held in memory."""

SLACK = 0.02
"""Share by which shards may be longer, to avoid one more short shard."""

IN_ORDER: dict[str, Any] = {
    'window.gate_distance_m': 0.0,
    'window.gate_angle_deg': 0.0,
    'align.every_scans': 0,
    'dynamic.clear': False,
}
"""Settings with which a scan does not depend on all before it."""

WAITS = ('pose.max_wait_s', 'pose.max_delay_s', 'pose.max_gap_s')
"""Settings that have to be shorter than the margins of a shard."""

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
    span : Span, optional
        The part of a bag; None for all of the request.

    """

    request: Request
    config: Config
    span: Span | None = None


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
    counts : dict
        ``Counters.summary``.
    resets : int
        Times that the clock was set back.
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
        span = recording.span
    number = max(math.ceil((stop_ns - start_ns) / 1e9 / shard_s - SLACK), 1)
    if number == 1:
        return [whole]
    bounds = [start_ns + (stop_ns - start_ns) * k // number for k in range(1, number)]
    starts, stops = [span.start_ns, *bounds], [*bounds, span.stop_ns]
    return [
        replace(whole, span=Span(start_ns=first, stop_ns=last))
        for first, last in zip(starts, stops, strict=True)
    ]


def absolute(request: Request) -> Request:
    """Return a request that means the same in another directory."""
    poses = None if request.poses is None else request.poses.absolute()
    return replace(request, path=request.path.absolute(), poses=poses)


def may_be_cut(recording: BagRecording) -> bool:
    """Return whether a scan depends on messages within the margins alone."""
    path, settings = recording.poses.path, recording.config.to_mapping()
    by_number = recording.span.every > 1 or (path is not None and not path.has_stamps)
    return (
        not by_number
        and settings['pose.source'] != 'registration'
        and all(settings[name] == value for name, value in IN_ORDER.items())
        and all(settings[name] * 1e9 < MARGIN_NS for name in WAITS)
        and settings['pose.max_gap_s'] > 0.0
    )


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
        mapper = Mapper(recording.config)
        mapper.derives = False  # surfels are derived when all shards are merged
        mapper.outcomes, mapper.pose_source = [], recording.describe()['poses_from']
        updates, recorded_s = recording.replay(mapper), recording.recorded_s
        if isinstance(recording, BagRecording) and shard.span is not None:
            reader = recording.reader
            updates = feed(reader, mapper, recording.topics, recording.poses, span=shard.span)
            start_ns, stop_ns = shard.span.clipped(reader.start_ns, reader.end_ns)
            recorded_s = (stop_ns - start_ns) / 1e9
        trajectory = ScanTrajectory(mapper)
        for update in updates:
            trajectory.add(update)
    return ShardResult(
        map=mapper.map,
        config=mapper.config,
        counts=mapper.counters.summary(),
        resets=mapper.counters.resets,
        recorded_s=recorded_s,
        core_s=time.process_time() - began,
        stamps_ns=np.array(trajectory.stamps_ns, np.int64),
        poses=trajectory.matrices,
        outcomes=mapper.outcomes or [],
    )


def continues(results: Sequence[ShardResult]) -> bool:
    """Return whether shards make the map of one go: no stamp twice, and no time set back."""
    newest_ns: dict[tuple[str, str], int] = {}
    all_stamps: set[tuple[str, str, int]] = set()
    for result in results:
        if result.resets and len(results) > 1:
            return False  # which clears the map of all shards before
        back_ns = round(1e9 * result.config.input.reset_after_s)
        stamps = {
            (outcome.frame_id, outcome.topic, outcome.stamp_ns)
            for outcome in result.outcomes
            if outcome.stamp_ns is not None
        }
        if stamps & all_stamps or any(
            stamp_ns < newest_ns.get((frame_id, topic), 0) - back_ns
            for frame_id, topic, stamp_ns in stamps
        ):
            return False
        all_stamps |= stamps
        for frame_id, topic, stamp_ns in stamps:
            sensor = (frame_id, topic)
            newest_ns[sensor] = max(stamp_ns, newest_ns.get(sensor, 0))
    return True
