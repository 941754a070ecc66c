# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters on one core, the voxel grid beside PCL's and Open3D's.

Each row is the least of some repeats on one scan: a busy machine only ever adds to it. ``Mpt_s``
are millions of points that come in, a second. PCL is compiled from peers/pcl_voxel_grid.cpp where
a compiler and Debian's libpcl-dev are there (or where CPATH, LIBRARY_PATH and LD_LIBRARY_PATH
lead to them); Open3D comes with --peers. Figures that are not measured here are marked as stated:
they are of another machine and one scan of 124,668 points. libpointmatcher has no package.

Scans are the simulated street and, where SURFEL_MAPPER_TEST_DATA leads to it, one of a real lidar
of 64 beams in columns, in which hardly two points that follow each other share a voxel.
"""

from __future__ import annotations

from collections.abc import Iterator
import json
import os
from pathlib import Path
import subprocess
import tempfile
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.filters import Chain
from surfel_mapper.scan import Scan
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.peers import OPEN3D, PeerSpec
from test.bench.peers.pcl import compiled
from test.bench.peers.run import environment, output, PeerError
from test.bench.report import Row
from test.bench.street import Street

SIZE_M = 0.5

VOXEL = {'vSizeX': SIZE_M, 'vSizeY': SIZE_M, 'vSizeZ': SIZE_M}
BOX = {'x_min_m': -20, 'x_max_m': 20, 'y_min_m': -20, 'y_max_m': 20, 'z_min_m': -2, 'z_max_m': 5}

FAST = 200.0
"""Mpt/s asked of boxes, ranges and masks."""

CHAINS: dict[str, tuple[Any, float | None]] = {
    'VoxelGrid': ({'VoxelGridDataPointsFilter': VOXEL}, 3 * 13.6),
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
    'surface_normal': ('surface_normal', None),
}
"""Timed filters, and the rates they should reach, Mpt/s."""

STATED = {'libpointmatcher': 13.6, 'PCL VoxelGrid': 30.8, 'PCL ApproximateVoxelGrid': 58.0}
"""Mpt/s of others as stated for one real scan, 0.5 m voxels, one core."""

PCL_LIBRARIES = ('filters', 'common')

REPEATS = 40

Points = npt.NDArray[np.float32]


def run(options: Options) -> list[Row]:
    """Return a row for every filter and scan, and for the voxel grids of others."""
    program = compiled('pcl_voxel_grid', PCL_LIBRARIES, options)
    rows: list[Row] = []
    with one_core():
        for name, points in scans(options):
            rows += [ours(name, points, each) for each in CHAINS]
            rows += [
                row(name, who, len(points), figures) for who, figures in others(points, program)
            ]
            if options.peers:
                rows += open3d_rows(name, points, options)
        rows += [
            {'scan': '124,668 points', 'filter': who, 'Mpt_s': rate, 'note': 'as stated'}
            for who, rate in STATED.items()
            if program is None or not who.startswith('PCL')
        ]
    return rows


def scans(options: Options) -> Iterator[tuple[str, Points]]:
    """Yield names and points of the scans, finite ones."""
    points = Street(options).points(options.untimed)
    yield 'street', points[np.isfinite(points).all(axis=1)]
    data = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    path = Path(data or '') / 'data/scans/rellis3d_os1_64_offroad_000104.bin'
    if data and path.exists():
        yield 'real', np.fromfile(path, np.float32).reshape(-1, 4)[:, :3]


def ours(name: str, points: Points, which: str) -> Row:
    """Return the row of one of our filters."""
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
    for _ in range(REPEATS if asked else 3):
        start = perf_counter()
        chain.apply(scan)
        times.append((perf_counter() - start) * 1e3)
    return {**row(name, which, len(points), (min(times), len(left))), 'asked_Mpt_s': asked}


def row(name: str, who: str, num_points: int, figures: tuple[float, int]) -> Row:
    """Return the row of a filter from its milliseconds and how many points it left."""
    milliseconds, left = figures
    return {
        'scan': name,
        'filter': who,
        'points': num_points,
        'left': left,
        'least_ms': milliseconds,
        'Mpt_s': num_points / milliseconds * 1e-3,
    }


def others(points: Points, program: Path | None) -> Iterator[tuple[str, tuple[float, int]]]:
    """Yield the least milliseconds of PCL's voxel grids and their numbers of points."""
    if program is None:
        return
    done = subprocess.run(
        [program, str(len(points)), str(SIZE_M), str(REPEATS)],
        input=np.ascontiguousarray(points).tobytes(),
        capture_output=True,
        check=True,
    )
    lines = done.stdout.decode().splitlines()
    for who, line in zip(('PCL VoxelGrid', 'PCL ApproximateVoxelGrid'), lines, strict=True):
        milliseconds, left = line.split()
        yield who, (float(milliseconds), int(left))


def open3d_rows(name: str, points: Points, options: Options) -> list[Row]:
    """Return the rows of Open3D; if it cannot be had, only why."""
    spec = PeerSpec(name='Open3D', module='test.bench.peers.open3d_voxel_grid', requires=OPEN3D)
    try:
        python = environment(spec, options.cache)
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / 'points.npy'
            np.save(path, np.ascontiguousarray(points))
            command = [str(python), '-m', spec.module, str(path), str(SIZE_M), str(REPEATS)]
            said = output(command, cwd=Path(__file__).parents[2])
    except PeerError as error:
        return [{'scan': name, 'filter': 'Open3D', 'note': f'not measured: {error}'}]
    found = json.loads(said.splitlines()[-1])
    return [row(name, who, len(points), tuple(figures)) for who, figures in found.items()]
