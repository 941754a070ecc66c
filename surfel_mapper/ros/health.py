# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The problems of a node since its last report, as warnings and errors with a remedy.

Imports no ROS: counts in, sentences out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from surfel_mapper.config import DiagnosticsConfig
from surfel_mapper.errors import counted
from surfel_mapper.pipeline.drops import REMEDIES

OK, WARN, ERROR = 0, 1, 2
"""As in diagnostic_msgs/DiagnosticStatus."""

NO_POSE = f'they wait for poses or were dropped; {REMEDIES["no_pose"]}'

OFF_S = 600.0
"""
Latencies above this mean that stamps and clock are of different times, s. A scan waits for its
pose at most ``pose.max_delay_s`` (4 s), and queues are bounded, so a real latency is seconds.
"""


@dataclass(kw_only=True)
class Interval:
    """
    Counts between two reports.

    Attributes
    ----------
    topic : str
        The topic of the clouds.
    num_publishers : int
        Number of its publishers that send clouds.
    unheard : str
        The publisher whose QoS does not match the subscription, and the remedy; empty if none.
    ever_received : bool
        Whether a cloud has ever been received.
    received : int
        Clouds received.
    never_mapped : int
        Clouds received until the last report if none of them was ever mapped; else 0.
    silent_s : float
        Time since the last cloud.
    dropped : Counter of str
        Scans dropped, by cause.
    latency_s : float or None
        99th percentile from stamp to publication; None if no scan was mapped.
    paused : bool
        Whether clouds are dropped on request.
    layers_off : mapping of str to str
        Last error of each layer that is switched off, by its name.
    loss : str
        Messages lost by the middleware, and the remedy; empty if none.
    alternatives : str
        The missing publisher, and the topics that could be read instead; empty if none.
    poses : str
        The poses that are missing or uncertain, and the remedy; empty if none.
    checkpoints : str
        Why checkpoints fail, and the age of the last good one; empty if none failed.
    mounts : str
        The sensors that have moved on the robot, and the remedy; empty if none.
    clocks : str
        The offsets between the clocks of clouds and poses; empty if none.

    """

    topic: str
    num_publishers: int = 1
    unheard: str = ''
    ever_received: bool = True
    received: int = 0
    never_mapped: int = 0
    silent_s: float = 0.0
    dropped: Counter[str] = field(default_factory=Counter)
    latency_s: float | None = None
    paused: bool = False
    layers_off: Mapping[str, str] = field(default_factory=dict)
    loss: str = ''
    alternatives: str = ''
    poses: str = ''
    checkpoints: str = ''
    mounts: str = ''
    clocks: str = ''


def findings(interval: Interval, limits: DiagnosticsConfig) -> Iterator[tuple[int, str]]:
    """Yield the problems, each with its level."""
    yield from _input(interval, limits)
    if interval.loss and interval.received:
        yield WARN, interval.loss
    if interval.poses:
        yield WARN, interval.poses
    if interval.checkpoints:
        yield ERROR, interval.checkpoints
    if interval.mounts:
        yield WARN, interval.mounts
    if interval.clocks:
        yield WARN, interval.clocks
    if interval.paused:
        yield WARN, 'paused: clouds are dropped until ~/pause is called with false'
    for name, error in interval.layers_off.items():
        yield WARN, f'layer {name} is off until ~/clear, it failed repeatedly: {error}'
    drops = list(_drops(interval, limits))
    yield from drops
    if interval.never_mapped and not (drops or interval.paused or interval.poses):
        yield WARN, f'no cloud of {interval.never_mapped} is mapped yet: {NO_POSE}'
    yield from _latency(interval, limits)


def _input(interval: Interval, limits: DiagnosticsConfig) -> Iterator[tuple[int, str]]:
    topic = interval.topic
    if interval.loss and not interval.received:
        yield ERROR, f'no cloud comes through: {interval.loss}'
    elif not interval.ever_received:
        remedy = interval.unheard or (
            f'publishers: {interval.num_publishers}; see fastdds_shm.xml if clouds are large'
            if interval.num_publishers
            else interval.alternatives
            or 'it has no publisher; remap points to the topic of the lidar'
        )
        yield WARN, f'no cloud on {topic} yet: {remedy}'
    elif 0.0 < limits.silence_s < interval.silent_s:
        cause = interval.unheard or 'is the lidar alive?'
        yield (
            ERROR,
            f'no cloud on {topic} for {interval.silent_s:.1f} s '
            f'(publishers: {interval.num_publishers}); {cause}',
        )


def _drops(interval: Interval, limits: DiagnosticsConfig) -> Iterator[tuple[int, str]]:
    dropped = Counter({c: n for c, n in interval.dropped.items() if n and c != 'paused'})
    share = dropped.total() / max(interval.received, dropped.total(), 1)
    if share <= limits.warn_dropped_ratio:
        return
    level = ERROR if share > limits.error_dropped_ratio else WARN
    causes = ', '.join(f'{cause} {number}' for cause, number in dropped.most_common())
    remedy = REMEDIES.get(dropped.most_common(1)[0][0], 'the log says why')
    yield level, f'{counted(dropped.total(), "scan")} dropped just now ({causes}): {remedy}'


def _latency(interval: Interval, limits: DiagnosticsConfig) -> Iterator[tuple[int, str]]:
    latency_s = interval.latency_s
    if latency_s is None or abs(latency_s) > OFF_S:
        return  # a bag played without use_sim_time is not a problem
    for level, limit_s in ((ERROR, limits.error_latency_s), (WARN, limits.warn_latency_s)):
        if 0.0 < limit_s < latency_s:
            yield (
                level,
                f'{latency_s:.3f} s from stamp to publication (99th percentile), above '
                f'{limit_s:g} s: milliseconds names the slow stage, queue the clouds that wait',
            )
            return
