# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Voxel grids, normals and outliers on one core, beside those of small_gicp and Open3D.

Each row is the median of the processor times of some repeats on one scan, on which other load of
the machine has less effect than on clock times. ``Mpt_s``: million input points per second. Ours
are timed twice, before and after those of peers, which come with --peers; ``x_ours`` is the ratio
of the time of a peer to ours.

Scans are the simulated street and, if SURFEL_MAPPER_TEST_DATA names their folder, those of three
real lidars in recorded order, in which consecutive points rarely share a voxel.
"""

from __future__ import annotations

from collections.abc import Iterator
import json
from time import process_time
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.filters import Chain
from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.scan import Scan
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.peers import OPEN3D, PeerSpec, SMALL_GICP
from test.bench.peers.run import PeerError, run_peer
from test.bench.real import real_scans
from test.bench.report import Row
from test.bench.street import Street

TASKS: dict[str, tuple[Any, str]] = {
    'VoxelGrid': (
        {'VoxelGridDataPointsFilter': {'vSizeX': 0.5, 'vSizeY': 0.5, 'vSizeZ': 0.5}},
        'grid 0.5 40',
    ),
    'normals 10': ({'surface_normal': {'num_neighbours': 10}}, 'normals 10 5'),
    'normals 30': ({'surface_normal': {'num_neighbours': 30}}, 'normals 30 5'),
    'outliers 20': ({'statistical_outliers': {'num_neighbours': 20}}, 'outliers 20 5'),
}
"""Timed filters: the filter of ours, and the task of peers, which ends with the repeats."""

REAL = ('VLS-128 street', 'OS2-128', '64 beams street')
"""Real scans, by their names in real.py."""

PEERS = (
    PeerSpec(name='small_gicp', module='test.bench.peers.points', requires=SMALL_GICP),
    PeerSpec(name='Open3D', module='test.bench.peers.points', requires=OPEN3D),
)

Points = npt.NDArray[np.float32]

Figures = tuple[list[float], int | None]
"""Milliseconds of each repeat, and the number of points that are left."""


def run(options: Options) -> list[Row]:
    """Return a row for every filter and scan, of ours and of peers."""
    keep_freed_memory()  # as node and replay do
    with one_core():
        return [row for scan in scans(options) for row in rows_of(*scan, options)]


def scans(options: Options) -> Iterator[tuple[str, Points]]:
    """Yield names and points of the scans, finite ones."""
    points = Street(options).points(options.untimed)
    yield 'street', points[np.isfinite(points).all(axis=1)]
    yield from ((name, points) for name, points in real_scans() if name in REAL)


def rows_of(name: str, points: Points, options: Options) -> Iterator[Row]:
    """Yield the rows of our filters and of those of peers, in turns."""
    first = {task: ours(points, task) for task in TASKS}
    peer_figures: dict[str, dict[str, Figures | None]] = {}
    for spec in PEERS if options.peers else ():
        tasks = ','.join(task for _, task in TASKS.values())
        try:
            said = run_peer(spec, points, [spec.name.lower(), tasks], options.cache)
        except PeerError as error:
            yield {'scan': name, 'filter': spec.name, 'note': f'not measured: {error}'}
        else:
            peer_figures[spec.name] = json.loads(said)
    for task, (times, num_left) in first.items():
        own_times = times + ours(points, task)[0]
        yield row(name, task, len(points), (own_times, num_left))
        for package, figures in peer_figures.items():
            if figures[TASKS[task][1]] is not None:
                peer_row = row(name, f'{package} {task}', len(points), figures[TASKS[task][1]])
                yield {**peer_row, 'x_ours': peer_row['median_ms'] / float(np.median(own_times))}


def ours(points: Points, task: str) -> Figures:
    """Return the figures of one of our filters."""
    item, peer_task = TASKS[task]
    scan = Scan(points=np.asfortranarray(points), stamp_ns=0, frame_id='lidar')
    chain = Chain.from_list([item])
    num_left = len(chain.apply(scan))
    times = []
    for _ in range(int(peer_task.split()[-1])):
        start = process_time()
        chain.apply(scan)
        times.append((process_time() - start) * 1e3)
    return times, num_left


def row(name: str, task: str, num_points: int, figures: Figures) -> dict[str, Any]:
    """Return the row of a filter from its milliseconds and the number of points it left."""
    times, num_left = figures
    milliseconds = float(np.median(times))
    return {
        'scan': name,
        'filter': task,
        'points': num_points,
        'left': num_left,
        'median_ms': milliseconds,
        'Mpt_s': num_points / milliseconds * 1e-3,
    }
