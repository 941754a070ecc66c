# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The window job on real scans in recorded order, beside numpy, on one core.

Scans of real lidars change the voxel with almost every point: spinning lidars fire column by
column, so that neighbours in memory belong to different beams. Each scan is moved by 0.3 m a step
through a window of 20; a step reduces it, inserts it, evicts the oldest and derives the surfels of
all changed voxels. Points are arrays already, so decoding is not included. Invalid points are
removed before, as drivers do.

``numpy`` is the same job in numpy_map.py, run in turns with ours; ``x_numpy`` is the ratio of the
median processor times, on which other load of the machine has less effect than on clock times.
The integers of both maps are compared at the end. ``B_voxel`` are the bytes of a voxel in the
map, hash table and free rows included, ``B_scan_voxel`` those of a voxel of a scan in the window.

The scans come from SURFEL_MAPPER_TEST_DATA; without it there is only the simulated street, which
the mean does not include.
"""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
from time import process_time

import numpy as np
import numpy.typing as npt

from surfel_mapper.files.scan_files import read_scan
from surfel_mapper.memory import keep_freed_memory
from test.bench.machine import one_core
from test.bench.numpy_map import NumpyMap
from test.bench.options import Options
from test.bench.ours import Ours
from test.bench.report import Row
from test.bench.street import MovedScan, Street

WINDOW = 20

STEP_M = (0.3, 0.02, 0.0)

SCANS = {
    'VLS-128 street': 'velodyne_vls128_street.pcd',
    '64 beams street': 'pjlab_64beam_street_ring_timestamp.pcd',
    'OS2-128': 'ouster_os2_128.ply',
    'OS0-128': 'ouster_os0_128.ply',
    'Livox facade': 'livox_mlcc_scene2_l1_10.pcd',
    'HDL-32 street': 'nuscenes_hdl32_1532402927647951.pcd.bin',
}
"""Names of rows and files of scans."""

DRIVEN = ('VLS-128 street', '64 beams street', 'OS2-128')
"""Scans that other benches take beside the simulated street, by their names."""

STAGES = ('reduce', 'insert', 'evict', 'normals')


def run(options: Options) -> list[Row]:
    """Return a row for every scan and voxel size, and the means of the ratios of real scans."""
    keep_freed_memory()  # as node and replay do
    rows: list[Row] = []
    street = Street(options).points(options.untimed)
    street = np.asfortranarray(street[np.isfinite(street).all(axis=1)])
    with one_core():
        for size_m in options.voxel_sizes_m:
            found = [step_row(*scan, size_m, options) for scan in real_scans()]
            rows += found
            if found:
                ratios = [row['x_numpy'] for row in found]
                mean = float(np.exp(np.log(ratios).mean()))
                rows.append({'scan': 'geometric mean', 'voxel_m': size_m, 'x_numpy': mean})
            rows.append(step_row('simulated street', street, size_m, options))
    return rows


def real_scans() -> Iterator[tuple[str, npt.NDArray[np.float32]]]:
    """Yield names and valid points (N, 3) of the scans, in recorded order."""
    data = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    for name, file in SCANS.items() if data else ():
        path = Path(data or '') / 'data/scans' / file
        if path.exists():
            points = np.asarray(read_scan(path)[0], np.float32)
            valid = np.isfinite(points).all(axis=1) & points.any(axis=1)
            yield name, np.asfortranarray(points[valid])


def drives(options: Options) -> Iterator[tuple[str, Street, Options]]:
    """Yield name, scans and size of the simulated street and of the driven real scans."""
    yield 'simulated street', Street(options), options
    for name, points in real_scans():
        if name in DRIVEN:
            moved = MovedScan(options, points)
            yield name, moved, moved.options


def step_row(name: str, points: npt.NDArray[np.float32], size_m: float, options: Options) -> Row:
    """Return the processor times of a step by stage, and of numpy."""
    ours, numpy_map = Ours(size_m, WINDOW), NumpyMap(size_m, WINDOW)
    columns = [np.ascontiguousarray(column) for column in points.T]
    untimed = WINDOW + 3
    laps, numpy_ms = [], []
    for number in range(untimed + min(options.scans, 30)):
        pose = np.eye(4)
        pose[:3, 3] = np.array(STEP_M) * number
        start = process_time()
        moments = ours.map.reduce(points, pose, origin=pose[:3, 3])
        times = np.array([start, process_time(), *ours.put(moments, process_time)])
        start = process_time()
        numpy_map.step(columns, pose)
        if number >= untimed:
            numpy_ms.append((process_time() - start) * 1e3)
            laps.append(np.diff(times) * 1e3)
    ours.check_equal(numpy_map)
    median = np.median(laps, axis=0)
    total = float(np.median(np.sum(laps, axis=1)))
    return {
        'scan': name,
        'voxel_m': size_m,
        'points': len(points),
        'voxels': len(ours.scans[-1]),
        'changed': ours.num_changed,
        **{f'{s}_ms': float(ms) for s, ms in zip(STAGES, median, strict=True)},
        'total_ms': total,
        'slowest_ms': float(np.sum(laps, axis=1).max()),
        'numpy_ms': float(np.median(numpy_ms)),
        'x_numpy': float(np.median(numpy_ms)) / total,
        'B_voxel': ours.bytes_a_voxel,
        'B_scan_voxel': ours.bytes_a_scan_voxel,
    }
