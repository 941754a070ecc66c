# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Two threads against one on the same scans, from decode to normals.

``calls``: one thread decodes and reduces the next two scans, as in the pipeline, while the other
inserts this one and derives its normals. ``Mapper``: the pipeline with ``map.threads`` 2 and more
scans waiting, as in a replay or a node with a backlog; ``prepared`` is the same with deskewing and
a chain of filters, which the other thread does too. Two threads and one take turns, eighty scans
at a time, and every other turn in the opposite order; ``ratio`` is the median of the ratios of the
turns. At the start of a turn one thread waits until the other has reduced the first scan, and at
its end no scan follows: as in a replay once for all scans. Of twenty scans that was 4 %, of forty
3 %, measured on 64 beams at 0.5 m. The maps are compared at the end.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
import json
from pathlib import Path
import tempfile
from time import perf_counter
from typing import Any, ClassVar

import numpy as np

from surfel_mapper.config import Config
from surfel_mapper.helpers import Job
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.messages.pointcloud2 import RawCloud, to_scan
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.reduction import AHEAD
from surfel_mapper.simulation.recording import BASE, ODOM, SENSOR
from surfel_mapper.threads import pool
from test.bench.options import Options
from test.bench.ours import Ours
from test.bench.real import drives
from test.bench.report import Row
from test.bench.street import Street, SWEEP_S

TURN = 80

TIMES = 4
"""Times as many scans as in other benches, so that there are five turns."""

Turn = Sequence[tuple[int, RawCloud]]

Poses = Sequence[Sequence[tuple[int, Any, Any]]]
"""Stamps, positions and orientations of the base, by scan of a turn."""


class ByCalls(Ours):
    """The direct calls, by one thread or two."""

    name = 'calls'

    def __init__(self, street: Street, voxel_size_m: float, window: int, threads: int) -> None:
        super().__init__(voxel_size_m, window)
        self.map = SurfelMap(voxel_size_m, threads=threads)
        self._street = street
        self._helper = pool(threads)

    def poses(self, turn: Turn) -> Poses:
        """Return none: the moments are made at the poses of the street."""
        return [[] for _ in turn]

    def drive(self, turn: Turn, _: Poses) -> None:
        """Map some scans."""
        for moments in self._ahead(turn) if self._helper else map(self._moments, turn):
            self.put(moments)

    def _ahead(self, turn: Turn) -> Iterator[ScanMoments]:
        """Yield the moments of every scan while the other thread makes those of the next."""
        assert self._helper is not None
        begun: deque[Job[ScanMoments]] = deque()
        for scan in turn:
            begun.append(self._helper.submit(self._moments, scan))
            if len(begun) > AHEAD:
                yield begun.popleft().result()
        while begun:
            yield begun.popleft().result()

    def _moments(self, scan: tuple[int, RawCloud]) -> ScanMoments:
        number, message = scan
        pose = self._street.pose(number)
        return self.map.reduce(to_scan(message).points, pose, origin=pose[:3, 3])


class ByMapper:
    """The pipeline, with one thread or two."""

    name = 'Mapper'

    chain: ClassVar[list[Mapping[str, Any]]] = []

    def __init__(self, street: Street, voxel_size_m: float, window: int, threads: int) -> None:
        settings: dict[str, Any] = {
            'map': {'voxel_size_m': voxel_size_m, 'min_points': 1, 'threads': threads},
            'window': {'max_scans': window},
            'pose': {'source': 'odometry'},
            'deskew': {'enabled': bool(self.chain)},
        }
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / 'chain.yaml'
            path.write_text(json.dumps(self.chain), encoding='utf-8')
            filters = str(path) if self.chain else ''
            self._mapper = Mapper(Config.from_mapping({**settings, 'filters': filters}))
        self.map = self._mapper.map
        self._drive = street.simulation.drive
        mount = self._drive.base_to_sensor
        self._mapper.add_pose(BASE, SENSOR, 0, mount[:3], mount[3:], static=True)

    def poses(self, turn: Turn) -> Poses:
        """Return the poses between which the scans lie; simulating them is not mapping."""
        stamps = [to_scan(message).stamp_ns for _, message in turn]
        before_ns = round(SWEEP_S * 1.2e9)
        return [[(ns, *self._drive.pose(ns)) for ns in (s - before_ns, s)] for s in stamps]

    def drive(self, turn: Turn, poses: Poses) -> None:
        """Map some scans."""
        num = 0
        for left, ((_, message), of_scan) in enumerate(
            zip(turn, poses, strict=True), 1 - len(turn)
        ):
            for pose in of_scan:
                self._mapper.add_pose(ODOM, BASE, *pose)
            self._mapper.add_scan(to_scan(message))
            num += sum(1 for _ in self._mapper.insert_ready(more_follows=left < 0))
        if num != len(turn):
            raise RuntimeError(f'{num} of {len(turn)} scans mapped')


class Prepared(ByMapper):
    """The pipeline with deskewing and filters."""

    name = 'prepared'

    chain: ClassVar[list[Mapping[str, Any]]] = [
        {'range_limit': {'min_m': 1.0, 'max_m': 80.0}},
        {'body_box': {'x_min_m': -1.5, 'x_max_m': 1.5, 'y_min_m': -1.0, 'y_max_m': 1.0}},
    ]


def run(options: Options) -> list[Row]:
    """Return a row for every scan, voxel size and way."""
    rows: list[Row] = []
    for name, street, size in drives(options):
        street.prepare(size.untimed + TIMES * size.scans)
        rows += [
            {'scan': name, **compared(street, size, size_m, way)}
            for size_m in options.voxel_sizes_m
            for way in (ByCalls, ByMapper, Prepared)
        ]
    return rows


def compared(
    street: Street,
    options: Options,
    size_m: float,
    way: type[ByCalls] | type[ByMapper],
) -> Row:
    """Return a row for one voxel size and way."""
    maps = [way(street, size_m, options.window, threads) for threads in (1, 2)]
    times: list[list[float]] = []
    turn: list[tuple[int, RawCloud]] = []
    num_timed = TIMES * options.scans
    for number, message, counts in street.drive(options.untimed, num_timed):
        turn.append((number, message))
        if len(turn) < min(TURN, num_timed):
            continue
        timed = in_turn(maps, turn, reverse=len(times) % 2 == 1)
        if counts:
            times.append(timed)
        turn = []
    if maps[0].map != maps[1].map:
        raise RuntimeError('one and two threads give different maps')
    one, two = np.transpose(times)
    return {
        'voxel_m': size_m,
        'way': way.name,
        'one_ms': float(np.median(one)),
        'two_ms': float(np.median(two)),
        'ratio': float(np.median(one / two)),
        'turns': len(times),
    }


def in_turn(maps: Sequence[ByCalls | ByMapper], turn: Turn, *, reverse: bool) -> list[float]:
    """Give some scans to all maps, one after the other; return ms a scan of each."""
    times = [0.0] * len(maps)
    poses = maps[0].poses(turn)
    for place in sorted(range(len(maps)), reverse=reverse):
        start = perf_counter()
        maps[place].drive(turn, poses)
        times[place] = (perf_counter() - start) * 1e3 / len(turn)
    return times
