# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
From a PointCloud2 to the normals of all voxels that changed, by stage, on one core.

``calls`` are direct calls of map and decoder, ``Mapper`` is the pipeline of node and replay, with
poses from odometry (its insert includes evict, its reduce decodes the points). ``total`` is
measured around all stages, so it is slightly more than their sum. Points per second include
missing returns. Bytes are those of a voxel in the map, with its share of the hash table, and of a
voxel of a scan in the window.
"""

from __future__ import annotations

from time import perf_counter

from surfel_mapper.config import Config
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.pipeline import Mapper
from surfel_mapper.simulation.recording import BASE, ODOM, SENSOR
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.ours import Ours
from test.bench.real import drives
from test.bench.report import rates, Row, spread
from test.bench.street import Street

BUDGET_MS = {0.5: 4.0, 0.2: 10.0}
"""Goal for a scan of 131,072 points in a window of 100, ms, by voxel size."""

Times = dict[str, list[float]]


def run(options: Options) -> list[Row]:
    """Return a row for every stage, by scan, voxel size and way."""
    rows: list[Row] = []
    with one_core():
        for name, street, size in drives(options):
            street.prepare(size.untimed + size.scans)
            for size_m in options.voxel_sizes_m:
                ours = Ours(size_m, size.window)
                found = stages(size, size_m, 'calls', by_calls(ours, size, street))
                found[-1] = {**found[-1], **memory(ours)}
                found += stages(size, size_m, 'Mapper', by_mapper(size_m, size, street))
                rows += [{'scan': name, **row} for row in found]
    return rows


def by_calls(ours: Ours, options: Options, street: Street) -> Times:
    """Return the times of the direct calls."""
    times: Times = {}
    for number, message, counts in street.drive(options.untimed, options.scans):
        pose = street.pose(number)
        start = perf_counter()
        stages = ours.step(message, pose)
        stages['total'] = (perf_counter() - start) * 1e3
        if counts:
            append(times, stages)
    return times


def by_mapper(size_m: float, options: Options, street: Street) -> Times:
    """Return the times of the pipeline."""
    drive = street.simulation.drive
    settings = {'voxel_size_m': size_m, 'min_points': 1}
    window = {'max_scans': options.window}
    mapper = Mapper(
        Config.from_mapping({'map': settings, 'window': window, 'pose': {'source': 'odometry'}})
    )
    mount = drive.base_to_sensor
    mapper.add_pose(BASE, SENSOR, 0, mount[:3], mount[3:], static=True)
    times: Times = {}
    for number, message, counts in street.drive(options.untimed, options.scans):
        stamp_ns = street.simulation.stamp_ns(number)
        xyz, q_xyzw = drive.pose(stamp_ns)
        start = perf_counter()
        scan = to_scan(message)
        decoded = perf_counter()
        mapper.add_pose(ODOM, BASE, stamp_ns, xyz, q_xyzw)
        mapper.add_scan(scan)
        (update,) = mapper.insert_ready()
        total = (perf_counter() - start) * 1e3
        if counts:
            decode = (decoded - start) * 1e3
            append(times, {'decode': decode, **update.milliseconds, 'total': total})
    return times


def append(times: Times, stages: dict[str, float]) -> None:
    """Add the stages of one scan to those of all."""
    for stage, milliseconds in stages.items():
        times.setdefault(stage, []).append(milliseconds)


def stages(options: Options, size_m: float, way: str, times: Times) -> list[Row]:
    """Return the rows of one run, the total last."""
    rows: list[Row] = [
        {'voxel_m': size_m, 'way': way, 'stage': stage, **spread(values)}
        for stage, values in times.items()
    ]
    asked = BUDGET_MS.get(size_m) if options.beams > 1 else None
    budget = {'budget_ms': asked}
    rows[-1] = {**rows[-1], **budget, **rates(rows[-1]['median_ms'], options.num_points)}
    return rows


def memory(ours: Ours) -> Row:
    """Return the number of voxels and their bytes."""
    return {
        'voxels': ours.map.num_voxels,
        'changed': ours.num_changed,
        'B_voxel': ours.bytes_a_voxel,
        'B_scan_voxel': ours.bytes_a_scan_voxel,
    }
