# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters on one core, beside those of small_gicp, Open3D and PCL.

Each row is the median of the processor times of some repeats on one scan, on which other load of
the machine has less effect than on clock times. ``Mpt_s``: million input points per
second. Voxel grids, normals and outliers by neighbours are timed twice, before and after those of
peers; ``x_ours`` is the ratio of the time of a peer to ours. PCL is compiled from
peers/pcl_voxel_grid.cpp if a compiler and Debian's libpcl-dev are installed (or CPATH,
LIBRARY_PATH and LD_LIBRARY_PATH name them); small_gicp and Open3D come with --peers.
libpointmatcher has no package: its figure is stated, of another machine and one scan of 124,668
points.

Scans are the simulated street and, where SURFEL_MAPPER_TEST_DATA leads to them, those of three
real lidars in recorded order, in which consecutive points rarely share a voxel.
"""

from __future__ import annotations

from collections.abc import Iterator
import json
from pathlib import Path
import subprocess
import tempfile
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
from test.bench.peers.pcl import compiled
from test.bench.peers.run import environment, output, PeerError
from test.bench.real import real_scans
from test.bench.report import Row
from test.bench.street import Street

SIZE_M = 0.5

VOXEL = {'vSizeX': SIZE_M, 'vSizeY': SIZE_M, 'vSizeZ': SIZE_M}
BOX = {'x_min_m': -20, 'x_max_m': 20, 'y_min_m': -20, 'y_max_m': 20, 'z_min_m': -2, 'z_max_m': 5}

VOXEL_GRID = 'VoxelGrid'

FAST = 200.0
"""Mpt/s asked of boxes, ranges and masks."""

CHAINS: dict[str, tuple[Any, float | None]] = {
    VOXEL_GRID: ({'VoxelGridDataPointsFilter': VOXEL}, 3 * 13.6),
    'remove_nan': ('remove_nan', FAST),
    'bounding_box, inside goes': ({'bounding_box': BOX}, FAST),
    'bounding_box, inside stays': ({'bounding_box': {**BOX, 'remove_inside': 0}}, FAST),
    'body_box': ({'body_box': {'x_min_m': -9, 'x_max_m': 9}}, FAST),
    'range_limit': ({'range_limit': {'min_m': 3, 'max_m': 30}}, FAST),
    'distance_limit': ({'distance_limit': {'distance_m': 10}}, FAST),
    'label_mask': ({'label_mask': {'labels': [1, 3]}}, FAST),
    'time_slice': ({'time_slice': {'end_s': 0.05}}, FAST),
    'field_of_view': ({'field_of_view': {'azimuth_min_deg': -60, 'azimuth_max_deg': 60}}, FAST),
    'angle_limit': ({'angle_limit': {'phi_min_deg': -60, 'phi_max_deg': 60}}, FAST),
    'octree_grid': ({'octree_grid': {'max_size_m': SIZE_M}}, None),
    'ground': ('ground', None),
    'sampling_surface_normal': ('sampling_surface_normal', None),
    'normals 10': ({'surface_normal': {'num_neighbours': 10}}, None),
    'normals 30': ({'surface_normal': {'num_neighbours': 30}}, None),
    'outliers 20': ({'statistical_outliers': {'num_neighbours': 20}}, None),
    'radius_outliers': ('radius_outliers', None),
}
"""Timed filters, and the rates they should reach, Mpt/s."""

STATED = {'libpointmatcher': 13.6}
"""Stated rate of another package for one real scan, 0.5 m voxels, one core, Mpt/s."""

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

PCL_LIBRARIES = ('filters', 'common')

REPEATS = 40

Points = npt.NDArray[np.float32]


Figures = tuple[list[float], int]
"""Milliseconds of each repeat, and how many points were left."""


def run(options: Options) -> list[Row]:
    """Return a row for every filter and scan, and for the voxel grids of others."""
    keep_freed_memory()  # as node and replay do
    program = compiled('pcl_voxel_grid', PCL_LIBRARIES, options)
    rows: list[Row] = []
    with one_core():
        for name, points in scans(options):
            rows += voxel_grids(name, points, program, options)
            rows += searches(name, points, options)
            rows += [
                {
                    **row(name, each, len(points), ours(points, each)),
                    'asked_Mpt_s': CHAINS[each][1],
                }
                for each in CHAINS
                if each not in (VOXEL_GRID, *NEIGHBOURS)
            ]
        rows += [
            {'scan': '124,668 points', 'filter': who, 'Mpt_s': rate, 'note': 'as stated'}
            for who, rate in STATED.items()
        ]
    return rows


def scans(options: Options) -> Iterator[tuple[str, Points]]:
    """Yield names and points of the scans, finite ones."""
    points = Street(options).points(options.untimed)
    yield 'street', points[np.isfinite(points).all(axis=1)]
    yield from ((name, points) for name, points in real_scans() if name in REAL)


def voxel_grids(
    name: str, points: Points, program: Path | None, options: Options
) -> Iterator[Row]:
    """Yield the rows of our voxel grid and of those of others, in turns."""
    before, left = ours(points, VOXEL_GRID)
    others = dict(pcl(points, program)) if program else {}
    notes: list[Row] = []
    for spec in VOXEL_GRIDS if options.peers else ():
        try:
            others.update(peer(spec, points, options))
        except PeerError as error:
            notes.append({'scan': name, 'filter': spec.name, 'note': f'not measured: {error}'})
    times = before + ours(points, VOXEL_GRID)[0]
    asked = CHAINS[VOXEL_GRID][1]
    yield {**row(name, VOXEL_GRID, len(points), (times, left)), 'asked_Mpt_s': asked}
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
            found = json.loads(run_peer(spec, points, [','.join(NEIGHBOURS), '5'], options))
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
    item, asked = CHAINS[which]
    columns = {
        'label_mask': {'label': np.arange(len(points)) % 7},
        'time_slice': {'t': np.linspace(0, 1e8, len(points)).astype(np.uint32)},
    }
    scan = Scan(
        points=np.asfortranarray(points),
        stamp_ns=0,
        frame_id='lidar',
        columns=columns.get(which, {}),
        T_base_sensor=np.eye(4),
        T_map_sensor=np.eye(4),
    )
    chain = Chain.from_list([item])
    left = chain.apply(scan)
    times = []
    for _ in range(REPEATS if asked else 5):
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


def pcl(points: Points, program: Path) -> Iterator[tuple[str, Figures]]:
    """Yield the figures of PCL's voxel grids."""
    done = subprocess.run(
        [program, str(len(points)), str(SIZE_M), str(REPEATS)],
        input=np.ascontiguousarray(points).tobytes(),
        capture_output=True,
        check=True,
    )
    lines = done.stdout.decode().splitlines()
    for who, line in zip(('PCL VoxelGrid', 'PCL ApproximateVoxelGrid'), lines, strict=True):
        left, *times = line.split()
        yield who, ([float(each) for each in times], int(left))


def peer(spec: PeerSpec, points: Points, options: Options) -> dict[str, Figures]:
    """
    Return the figures of the voxel grids of a package.

    Raises
    ------
    PeerError
        If it cannot be had.

    """
    said = run_peer(spec, points, [str(SIZE_M), str(REPEATS)], options)
    return {who: (times, left) for who, (times, left) in json.loads(said).items()}


def run_peer(spec: PeerSpec, points: Points, arguments: list[str], options: Options) -> str:
    """
    Return the last line that a peer prints, given the file of the points and arguments.

    Raises
    ------
    PeerError
        If it cannot be had.

    """
    python = environment(spec, options.cache)
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / 'points.npy'
        np.save(path, np.ascontiguousarray(points))
        command = [str(python), '-m', spec.module, str(path), *arguments]
        return output(command, cwd=Path(__file__).parents[2]).splitlines()[-1]
