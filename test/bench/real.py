# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The window job on real scans in recorded order, beside numpy, on one core.

Scans of real lidars change the voxel with almost every point: spinning lidars fire column by
column, so that neighbours in memory belong to different beams. Each scan is moved by 0.3 m a step
through a window of 20; a step reduces it, inserts it, evicts the oldest and derives the surfels of
all changed voxels. Points are arrays already, so decoding is not included. Invalid points are
removed before, as drivers do.

``numpy`` is the same job in numpy_map.py. Both take turns of ten steps, every other turn in the
opposite order, so that changes of the machine affect both; ``x_numpy`` is the median of the ratios
of the turns. The first step of a turn finds the caches full of what the other one used, as no
step of a stream of scans does: it is not counted, but ``first_ms`` and ``first_x`` are the medians
of these steps and their ratio. Times are those of the processor, on which other load has less
effect than on clock times. The integers of both maps are compared at the end. ``B_voxel`` are the
bytes of a voxel in the map, hash table and free rows included, ``B_scan_voxel`` those of a voxel
of a scan in the window.

The scans come from SURFEL_MAPPER_TEST_DATA; without it there is only the simulated street, which
the mean does not include.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
import os
from pathlib import Path
from time import process_time

import numpy as np
import numpy.typing as npt

from surfel_mapper.files.scan_files import read_scan
from surfel_mapper.memory import keep_freed_memory
from test.bench.machine import one_core, prefault
from test.bench.numpy_map import NumpyMap
from test.bench.options import Options
from test.bench.ours import Ours
from test.bench.report import Row
from test.bench.street import Street

WINDOW = 20

TURN = 10
"""Steps in a row of the map, and then of numpy."""

UNTIMED_TURNS = 3
"""Turns until the window is full and kernels are loaded."""

TIMED_TURNS = 5
"""Turns timed, at most."""

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
                mean = {
                    c: geometric_mean([row[c] for row in found]) for c in ('x_numpy', 'first_x')
                }
                rows.append({'scan': 'geometric mean', 'voxel_m': size_m, **mean})
            rows.append(step_row('simulated street', street, size_m, options))
    return rows


def geometric_mean(values: Sequence[float]) -> float:
    """Return the geometric mean."""
    return float(np.exp(np.log(values).mean()))


def real_scans() -> Iterator[tuple[str, npt.NDArray[np.float32]]]:
    """Yield names and valid points (N, 3) of the scans, in recorded order."""
    data = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    for name, file in SCANS.items() if data else ():
        path = Path(data or '') / 'data/scans' / file
        if path.exists():
            points = np.asarray(read_scan(path)[0], np.float32)
            valid = np.isfinite(points).all(axis=1) & points.any(axis=1)
            yield name, np.asfortranarray(points[valid])


def step_row(name: str, points: npt.NDArray[np.float32], size_m: float, options: Options) -> Row:
    """Return the processor times of a step by stage, and of numpy."""
    prefault()
    ours, numpy_map = Ours(size_m, WINDOW), NumpyMap(size_m, WINDOW)
    columns = [np.ascontiguousarray(column) for column in points.T]
    laps: list[npt.NDArray[np.float64]] = []
    numpy_ms: list[npt.NDArray[np.float64]] = []
    num_turns = min(-(-options.scans // TURN), TIMED_TURNS)
    for turn in range(UNTIMED_TURNS + num_turns):
        poses = [moved(number) for number in range(turn * TURN, (turn + 1) * TURN)]
        drives = [partial(our_turn, ours, points), partial(numpy_turn, numpy_map, columns)]
        results: list[npt.NDArray[np.float64]] = [np.empty(0)] * len(drives)
        for place in sorted(range(len(drives)), reverse=turn % 2 == 1):
            results[place] = drives[place](poses)
        if turn >= UNTIMED_TURNS:
            laps.append(results[0])
            numpy_ms.append(results[1])
    ours.check_equal(numpy_map)
    ours_ms = np.sum(laps, axis=2)  # by turn and step
    ratios = np.median(np.array(numpy_ms)[:, 1:], axis=1) / np.median(ours_ms[:, 1:], axis=1)
    stages = np.median(np.array(laps)[:, 1:], axis=(0, 1))
    first_ms = float(np.median(ours_ms[:, 0]))
    return {
        'scan': name,
        'voxel_m': size_m,
        'points': len(points),
        'voxels': len(ours.scans[-1]),
        'changed': ours.num_changed,
        **{f'{s}_ms': float(ms) for s, ms in zip(STAGES, stages, strict=True)},
        'total_ms': float(np.median(ours_ms[:, 1:])),
        'slowest_ms': float(ours_ms[:, 1:].max()),
        'first_ms': first_ms,
        'numpy_ms': float(np.median(np.array(numpy_ms)[:, 1:])),
        'x_numpy': float(np.median(ratios)),
        'first_x': float(np.median(np.array(numpy_ms)[:, 0])) / first_ms,
        'B_voxel': ours.bytes_a_voxel,
        'B_scan_voxel': ours.bytes_a_scan_voxel,
    }


def moved(number: int) -> npt.NDArray[np.float64]:
    """Return the pose (4, 4) of a step."""
    pose = np.eye(4)
    pose[:3, 3] = np.array(STEP_M) * number
    return pose


def our_turn(
    ours: Ours, points: npt.NDArray[np.float32], poses: Sequence[npt.NDArray[np.float64]]
) -> npt.NDArray[np.float64]:
    """Map the points at some poses; return the milliseconds of each step, by stage."""
    laps = []
    for pose in poses:
        start = process_time()
        moments = ours.map.reduce(points, pose, origin=pose[:3, 3])
        laps.append(np.diff([start, process_time(), *ours.put(moments, process_time)]))
    return np.array(laps) * 1e3


def numpy_turn(
    numpy_map: NumpyMap,
    columns: list[npt.NDArray[np.float32]],
    poses: Sequence[npt.NDArray[np.float64]],
) -> npt.NDArray[np.float64]:
    """Map the points with numpy; return the milliseconds of each step."""
    times = []
    for pose in poses:
        start = process_time()
        numpy_map.step(columns, pose)
        times.append(process_time() - start)
    return np.array(times) * 1e3
