# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Models that follow a map: an update after about 5,000 changed voxels.

A lidar drives through the simulated street; the voxels within a radius of it change with every
scan. Times are processor time (cpu_ms), as the machine may be shared, and clock time (median_ms).
``access`` is the time to read all surfels and models.

Then whole real scans, not cut, again and again with 1 cm of noise, as a lidar that stands sees
them: every voxel changes, few patches grow. Without SURFEL_MAPPER_TEST_DATA there are none.

The last rows are those of ids in a window of ten scans, a metre apart: of the patches of which at
least half of the voxels are on patches a metre on, the share whose voxels mostly have the same id
then (``kept``), that of patches reported as merged into another (``merged``), and the share that
is kept of all others (``others``), in three streets.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from time import perf_counter, process_time
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import ModelsLayerConfig
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.models.live import LiveModels
from surfel_mapper.simulation import Lidar, Simulation, World
from test.bench.machine import load, one_core
from test.bench.report import Row, spread
from test.bench.scan_planes import real_scans

SCANS = 16
WARM = 6

CASES = ((0.5, 22.0), (0.3, 12.0), (0.2, 10.0))
"""Voxel size and radius, m, by which about 5,000 voxels change a scan."""


STANDING = (
    'nuscenes_hdl32_1532402927647951.pcd',
    'rellis3d_os1_64_offroad_000104',
    'ouster_os0_128',
    'argoverse2_2xvlp32_sweep',
    'velodyne_vls128_street',
)
STANDING_SIZE_M, STANDING_NOISE_M = 0.5, 0.01
"""Scans of the standing lidars, edge of the voxels, and noise."""


WINDOW, METRE, METRES = 10, 2, 14
"""Scans in the window for ids, number of scans a metre, and metres."""

STREETS = (1, 2, 3)
"""Seeds of the streets in which ids are counted."""


def run() -> Iterator[Row]:
    """Yield a row for every voxel size of the street and for every whole scan."""
    scans = street_scans()
    with one_core():
        for size_m, radius_m in CASES:
            yield case('street', scans, size_m, radius_m)
        for name, points in real_scans():
            if name in STANDING:
                yield case(name, repeated(points), STANDING_SIZE_M, np.inf)
        for seed in STREETS:
            yield ids_over_time(seed)


def ids_over_time(seed: int) -> Row:
    """Return the row of ids in one street."""
    surfel_map, held = SurfelMap(STANDING_SIZE_M), deque()
    models = LiveModels(ModelsLayerConfig(), surfel_map)
    before: dict[tuple[int, ...], int] = {}
    known = kept = merged = 0
    for number, (points, origin) in enumerate(street_scans(METRE, WINDOW + METRES, seed)):
        held.append(surfel_map.add(points, origin=origin))
        if len(held) > WINDOW:
            surfel_map.remove(held.popleft())
        update = models.update()
        now = patches_of_voxels(models)
        gone = {one for one, _ in update.merged}
        for patch in set(before.values()) if number > WINDOW else ():
            voxels = [voxel for voxel, label in before.items() if label == patch]
            ids = [now[voxel] for voxel in voxels if voxel in now]
            if len(ids) >= max(2, 0.5 * len(voxels)):
                known += 1
                kept += max(set(ids), key=ids.count) == patch
                merged += patch in gone
        before = now
    share = {'kept': kept / known, 'merged': merged / known, 'others': kept / (known - merged)}
    row: Row = {'cloud': f'street {seed}, live, ids', 'who': 'surfel_mapper'}
    return {**row, 'patches': known, **share}


def patches_of_voxels(models: LiveModels) -> dict[tuple[int, ...], int]:
    """Return the id of the patch of each voxel that has one, by its index."""
    labels, voxels = models.model.labels, models.surfels.voxel_index
    is_patch = np.isin(labels, [patch.id for patch in models.model.patches])
    return dict(zip(map(tuple, voxels[is_patch].tolist()), labels[is_patch].tolist(), strict=True))


def repeated(
    points: npt.NDArray[np.float32],
) -> list[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]]:
    """Return a scan SCANS times, each time with other noise, and the sensor position."""
    rng = np.random.default_rng(1)
    return [
        (points + STANDING_NOISE_M * rng.standard_normal(points.shape), np.zeros(3))
        for _ in range(SCANS)
    ]


def street_scans(
    step: int = 3, num_scans: int = SCANS, seed: int = 1
) -> list[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]]:
    """Return points in the frame of the map and the sensor position, for every scan."""
    lidar = Lidar(beams=64, columns=1024, range_noise_m=0.01)
    simulation = Simulation(World.street(seed=seed, length_m=200.0), lidar)
    found = []
    for number in range(0, step * num_scans, step):
        scan = simulation.scan(number)
        points = scan.points[np.isfinite(scan.points).all(axis=1)].astype(np.float64)
        T_odom_sensor = simulation.drive.T_odom_sensor(scan.stamp_ns)
        origin = T_odom_sensor[:3, 3]
        found.append((points @ T_odom_sensor[:3, :3].T + origin, origin))
    return found


def case(
    name: str,
    scans: list[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]],
    voxel_size_m: float,
    radius_m: float,
) -> Row:
    """Return one row."""
    surfel_map = SurfelMap(voxel_size_m)
    models = LiveModels(ModelsLayerConfig(), surfel_map)
    models.warm_up()
    times, processor, access, changed = [], [], [], []
    for points, origin in scans:
        near = np.linalg.norm(points - origin, axis=1) < radius_m
        surfel_map.add(points[near], origin=origin)
        start, busy = perf_counter(), process_time()
        update = models.update()
        processor.append((process_time() - busy) * 1e3)
        times.append((perf_counter() - start) * 1e3)
        busy = process_time()
        found = models.model, models.surfels
        access.append((process_time() - busy) * 1e3)
        changed.append(update.num_changed)
    row: dict[str, Any] = {
        'cloud': f'{name}, live',
        'who': 'surfel_mapper',
        'voxel_m': voxel_size_m,
        **spread(times[WARM:]),
        'cpu_ms': float(np.median(processor[WARM:])),
        'cpu_least_ms': min(processor[WARM:]),
        'access_ms': float(np.median(access[WARM:])),
        'changed': int(np.median(changed[WARM:])),
        'surfels': len(found[1]),
        'planes': len(found[0].planes),
        'surfaces': len(found[0].surfaces),
        'gaussians': len(found[0].gaussians),
        'load': load(),
    }
    return row
