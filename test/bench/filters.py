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

SIZE_M = 0.5

VOXEL = {'vSizeX': SIZE_M, 'vSizeY': SIZE_M, 'vSizeZ': SIZE_M}

VOXEL_GRID = 'VoxelGrid'

CHAINS: dict[str, tuple[Any, int]] = {
    VOXEL_GRID: ({'VoxelGridDataPointsFilter': VOXEL}, 40),
    'normals 10': ({'surface_normal': {'num_neighbours': 10}}, 5),
    'normals 30': ({'surface_normal': {'num_neighbours': 30}}, 5),
    'outliers 20': ({'statistical_outliers': {'num_neighbours': 20}}, 5),
}
"""Timed filters, and the repeats of each."""

REAL = ('VLS-128 street', 'OS2-128', '64 beams street')
"""Real scans, by their names in real.py."""

VOXEL_GRIDS = (
    PeerSpec(
        name='small_gicp', module='test.bench.peers.small_gicp_voxel_grid', requires=SMALL_GICP
    ),
    PeerSpec(name='Open3D', module='test.bench.peers.open3d_voxel_grid', requires=OPEN3D),
)

NEIGHBOURS = ('normals 10', 'normals 30', 'outliers 20')
"""Filters that search for that many neighbours, as peers do too."""

SEARCHES = (
    PeerSpec(
        name='small_gicp', module='test.bench.peers.small_gicp_neighbours', requires=SMALL_GICP
    ),
    PeerSpec(name='Open3D', module='test.bench.peers.open3d_neighbours', requires=OPEN3D),
)

Points = npt.NDArray[np.float32]


Figures = tuple[list[float], int]
"""Milliseconds of each repeat, and how many points were left."""


def run(options: Options) -> list[Row]:
    """Return a row for every filter and scan, and for the voxel grids of others."""
    keep_freed_memory()  # as node and replay do
    rows: list[Row] = []
    with one_core():
        for name, points in scans(options):
            rows += voxel_grids(name, points, options)
            rows += searches(name, points, options)
    return rows


def scans(options: Options) -> Iterator[tuple[str, Points]]:
    """Yield names and points of the scans, finite ones."""
    points = Street(options).points(options.untimed)
    yield 'street', points[np.isfinite(points).all(axis=1)]
    yield from ((name, points) for name, points in real_scans() if name in REAL)


def voxel_grids(name: str, points: Points, options: Options) -> Iterator[Row]:
    """Yield the rows of our voxel grid and of those of others, in turns."""
    before, left = ours(points, VOXEL_GRID)
    others: dict[str, Figures] = {}
    notes: list[Row] = []
    for spec in VOXEL_GRIDS if options.peers else ():
        try:
            others.update(peer(spec, points, options))
        except PeerError as error:
            notes.append({'scan': name, 'filter': spec.name, 'note': f'not measured: {error}'})
    times = before + ours(points, VOXEL_GRID)[0]
    yield row(name, VOXEL_GRID, len(points), (times, left))
    for who, figures in others.items():
        ratio = float(np.median(figures[0]) / np.median(times))
        yield {**row(name, who, len(points), figures), 'x_ours': ratio}
    yield from notes


def searches(name: str, points: Points, options: Options) -> Iterator[Row]:
    """Yield the rows of our normals and outliers and of those of others, in turns."""
    before = {each: ours(points, each) for each in NEIGHBOURS}
    others: list[tuple[str, str, list[float]]] = []
    for spec in SEARCHES if options.peers else ():
        try:
            found = json.loads(run_peer(spec, points, [','.join(NEIGHBOURS), '5'], options.cache))
        except PeerError as error:
            yield {'scan': name, 'filter': spec.name, 'note': f'not measured: {error}'}
        else:
            others += [(each, spec.name, times) for each, times in found.items() if times]
    for each, (times, left) in before.items():
        mine = times + ours(points, each)[0]
        yield row(name, each, len(points), (mine, left))
        for job, who, peer_times in others:
            if job == each:
                ratio = float(np.median(peer_times) / np.median(mine))
                figures = row(name, f'{who} {each}', len(points), (peer_times, left))
                yield {**figures, 'left': None, 'x_ours': ratio}


def ours(points: Points, which: str) -> Figures:
    """Return the figures of one of our filters."""
    item, repeats = CHAINS[which]
    scan = Scan(points=np.asfortranarray(points), stamp_ns=0, frame_id='lidar')
    chain = Chain.from_list([item])
    left = chain.apply(scan)
    times = []
    for _ in range(repeats):
        start = process_time()
        chain.apply(scan)
        times.append((process_time() - start) * 1e3)
    return times, len(left)


def row(name: str, who: str, num_points: int, figures: Figures) -> Row:
    """Return the row of a filter from its milliseconds and how many points it left."""
    times, left = figures
    milliseconds = float(np.median(times))
    return {
        'scan': name,
        'filter': who,
        'points': num_points,
        'left': left,
        'median_ms': milliseconds,
        'Mpt_s': num_points / milliseconds * 1e-3,
    }


def peer(spec: PeerSpec, points: Points, options: Options) -> dict[str, Figures]:
    """
    Return the figures of the voxel grids of a package.

    Raises
    ------
    PeerError
        If it cannot be had.

    """
    said = run_peer(spec, points, [str(SIZE_M), str(CHAINS[VOXEL_GRID][1])], options.cache)
    return {who: (times, left) for who, (times, left) in json.loads(said).items()}
