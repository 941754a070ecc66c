# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A long drive up and down the street through the mapper, as fast as it goes.

Simulated once and then driven repeatedly, with increasing stamps and poses that move by a
millimetre a lap, so that no two scans have the same points at the same places. Every block of
scans gives a row: memory of the process, times, voxels. In the end the map is compared with a
new map of the scans of its window.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from time import perf_counter

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from surfel_mapper.config import Config
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.messages.pointcloud2 import RawCloud, to_scan
from surfel_mapper.pipeline import Mapper
from test.bench.machine import resident_bytes
from test.bench.options import Options
from test.bench.report import Row
from test.bench.street import Street

BASE = 'lidar'
PERIOD_NS = 100_000_000
TURN_M = 1e-3

CONFIG = {
    'pose.source': 'odometry',
    'frames.base': BASE,
    'window.max_scans': 100,
}


def run(num_scans: int, block: int, options: Options) -> Iterator[Row]:
    """
    Yield a row for every block of scans, up to a number of scans.

    Raises
    ------
    RuntimeError
        If a scan was not mapped, or the map is not the sum of its window in the end.

    """
    keep_freed_memory()
    street = Street(options)
    street.prepare(options.scans)
    messages = [street.message(number) for number in range(options.scans)]
    poses = [street.pose(number) for number in range(options.scans)]
    mapper = Mapper(Config.from_mapping(CONFIG))
    mapper.warm_up()
    times: list[float] = []
    latest: deque[RawCloud] = deque(maxlen=mapper.config.window.max_scans)
    for number, turn, place in there_and_back(num_scans, options.scans):
        latest.append(messages[place])
        stamp_ns = (number + 1) * PERIOD_NS
        times.append(mapped(mapper, messages[place], poses[place], turn, stamp_ns))
        if len(times) == block or number == num_scans - 1:
            yield row(number + 1, times, mapper)
            times = []
    check(mapper, latest)


def there_and_back(num_scans: int, length: int) -> Iterator[tuple[int, int, int]]:
    """Yield number, turn and place on the street of every scan."""
    turn_length = 2 * (length - 1)
    for number in range(num_scans):
        turn, step = divmod(number, turn_length)
        yield number, turn, min(step, turn_length - step)


def mapped(
    mapper: Mapper,
    message: RawCloud,
    T_odom_sensor: npt.NDArray[np.float64],
    turn: int,
    stamp_ns: int,
) -> float:
    """Map a scan; return the milliseconds it took."""
    xyz = T_odom_sensor[:3, 3] + TURN_M * turn
    q_xyzw = Rotation.from_matrix(T_odom_sensor[:3, :3]).as_quat()
    start = perf_counter()
    scan = to_scan(message)
    mapper.add_pose('odom', BASE, stamp_ns, xyz, q_xyzw)
    mapper.add_scan(replace(scan, stamp_ns=stamp_ns))
    if len(list(mapper.insert_ready())) != 1:
        raise RuntimeError(f'scan at {stamp_ns} ns was not mapped: {mapper.counters.dropped}')
    return (perf_counter() - start) * 1e3


def row(num_scans: int, times: list[float], mapper: Mapper) -> Row:
    """Return the figures of a block."""
    return {
        'scans': num_scans,
        'rss_MB': resident_bytes() / 2**20,
        'median_ms': float(np.median(times)),
        'p99_ms': float(np.percentile(times, 99)),
        'slowest_ms': max(times),
        'voxels': mapper.map.num_voxels,
        'map_MB': mapper.map.nbytes / 2**20,
    }


def check(mapper: Mapper, latest: Iterable[RawCloud]) -> None:
    """Compare the map with a new map of the clouds of its window."""
    anew = SurfelMap(mapper.map.voxel_size_m)
    for scan, message in zip(mapper.window, latest, strict=True):
        pose = scan.T_map_sensor
        points = to_scan(message).points
        near_m = mapper.config.input.min_range_m
        anew.insert(anew.reduce(points, pose, origin=pose[:3, 3], min_range_m=near_m))
    if anew.digest() != mapper.map.digest():
        raise RuntimeError('the map is not the sum of the scans in its window')
