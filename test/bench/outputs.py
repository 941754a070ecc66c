# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Outputs of the node beside the map, and inputs beside clouds, on one core.

Each is timed as the mapping thread does it, from the map to the bytes of the message: markers of
20,000 discs (choosing them, their surfels, vertices, CDR), changes of one scan with and without
exact moments, the scan with normals, the grid, the models; and of inputs: deskewing of a sweep, a
depth image of 640 x 480, and the time of a mirror to follow one change. Publishing is not
included.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from time import perf_counter
from types import SimpleNamespace
from typing import Any

import numpy as np

from surfel_mapper.config import Config, GridConfig, ModelsLayerConfig
from surfel_mapper.layers.costs.traversability import traversability
from surfel_mapper.mapping.ages import Ages
from surfel_mapper.mapping.surfel_columns import surfel_columns
from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.messages.map_cloud import MapMirror, moment_cloud
from surfel_mapper.messages.markers import marker_array
from surfel_mapper.messages.model_messages import (
    model_markers,
    primitive_columns,
    surfel_primitive_columns,
)
from surfel_mapper.messages.pointcloud2 import from_columns, to_scan
from surfel_mapper.messages.scan_normals import scan_with_normals
from surfel_mapper.messages.surfel_markers import disc_colors, surfel_markers
from surfel_mapper.models.live import LiveModels
from surfel_mapper.models.shapes import Shapes
from surfel_mapper.pipeline import Mapper, Update
from surfel_mapper.sensors.depth import depth_points, PinholeCamera
from surfel_mapper.sensors.deskew import deskewed, point_times
from surfel_mapper.simulation.recording import BASE, ODOM, SENSOR
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.report import Row, spread
from test.bench.street import Street

VOXEL_M = 0.2
DISCS = 20_000
MARKERS_BUDGET_MS = 15.0
MIN_POINTS = 5
REPEATS = 30
NOTHING = np.empty((0, 3), np.int32)


def run(options: Options) -> list[Row]:
    """Return a row for every output and input."""
    keep_freed_memory()  # as the node does
    with one_core():
        mapper, update = mapped(options)
        tasks = {**markers(mapper), **clouds(mapper, update), **inputs(mapper, update)}
        tasks.update(models(mapper))
        return [row(name, task) for name, task in tasks.items()]


def row(name: str, task: Callable[[], Any]) -> Row:
    """Return the times of a task, after a first run that is not counted."""
    task()
    times = []
    for _ in range(REPEATS):
        start = perf_counter()
        task()
        times.append((perf_counter() - start) * 1e3)
    budget = MARKERS_BUDGET_MS if name.startswith('markers') else None
    return {'what': name, **spread(times), 'budget_ms': budget}


def mapped(options: Options) -> tuple[Mapper, Update]:
    """Return a mapper whose window is full, and the update of its last scan."""
    street = Street(options)
    drive = street.simulation.drive
    mount = drive.base_to_sensor
    settings = {
        'map': {'voxel_size_m': VOXEL_M, 'min_points': MIN_POINTS},
        'window': {'max_scans': options.window},
        'pose': {'source': 'odometry'},
    }
    mapper = Mapper(Config.from_mapping(settings))
    mapper.add_pose(BASE, SENSOR, 0, mount[:3], mount[3:], static=True)
    for number, message, _ in street.drive(options.window, 1):
        stamp_ns = street.simulation.stamp_ns(number)
        mapper.add_pose(ODOM, BASE, stamp_ns, *drive.pose(stamp_ns))
        mapper.add_scan(to_scan(message))
        (update,) = mapper.insert_ready()
    end_ns = stamp_ns + 100_000_000
    mapper.add_pose(ODOM, BASE, end_ns, *drive.pose(end_ns))  # of the last point of the sweep
    return mapper, update


def markers(mapper: Mapper) -> dict[str, Callable[[], Any]]:
    """Return functions that build the markers, by colour."""
    ages = Ages()

    def draw(kind: str) -> bytes:
        surfels = mapper.map.surfels(MIN_POINTS, DISCS)
        colors = disc_colors(kind, surfels, mapper.window, ages)
        return marker_array(surfel_markers(surfels, VOXEL_M, colors, stamp_ns=0, frame_id='odom'))

    kinds = ('planarity', 'normal', 'age')
    return {f'markers by {kind}': partial(draw, kind) for kind in kinds}


def models(mapper: Mapper) -> dict[str, Callable[[], Any]]:
    """Return a function that describes the models, with new or cached shapes."""
    live = LiveModels(ModelsLayerConfig(enabled=True), mapper.map)
    live.update()
    model, versions = live.model, live.versions
    shapes = Shapes().of(model, versions)

    def draw() -> bytes:
        found = model_markers(shapes, model.gaussians, VOXEL_M, stamp_ns=0, frame_id='odom')
        return marker_array(found)

    return {
        f'shapes of {len(shapes)} planes and surfaces': lambda: Shapes().of(model, versions),
        f'their markers, and {len(model.gaussians)} Gaussians': draw,
        'a row a primitive': lambda: from_columns(
            primitive_columns(shapes, model.gaussians, versions)
        ),
        'a row a voxel': lambda: from_columns(surfel_primitive_columns(live.surfels, model)),
    }


def clouds(mapper: Mapper, update: Update) -> dict[str, Callable[[], Any]]:
    """Return functions that build the clouds of one scan, and the grid."""
    surfel_map, changed = mapper.map, update.changed
    center, limits = update.T_map_sensor[:2, 3], GridConfig()

    def with_moments() -> Any:
        moments = surfel_map.moments(changed.voxel_index)
        return moment_cloud(changed, moments, NOTHING)

    return {
        f'~/changed, {len(changed)} surfels': lambda: from_columns(surfel_columns(changed)),
        '~/changed with moments': with_moments,
        '~/scan_normals': lambda: scan_with_normals(
            update.scan, update.T_map_sensor, surfel_map, MIN_POINTS
        ),
        '~/grid': lambda: traversability(surfel_map.surfels(MIN_POINTS), VOXEL_M, center, limits),
    }


def inputs(mapper: Mapper, update: Update) -> dict[str, Callable[[], Any]]:
    """Return functions that deskew, convert depth images to points, and mirror."""
    scan, camera = update.scan, PinholeCamera(640, 480, 600.0, 600.0, 320.0, 240.0)
    times = np.linspace(0.0, 0.09, len(scan), dtype=np.float32)
    sweep = replace(scan, columns={'time': times})
    depth = np.random.default_rng(1).integers(500, 5000, (480, 640)).astype(np.uint16)
    change, mirror = message(mapper, update), MapMirror(VOXEL_M)
    mirror.change(change)

    def deskew() -> Any:
        timed = replace(sweep, times=point_times(sweep))
        return deskewed(timed, lambda ns: mapper.transforms.lookup(ODOM, SENSOR, ns))

    return {
        f'deskew, {len(scan)} points': deskew,
        'depth image of 640 x 480': lambda: depth_points(depth, camera),
        f'mirror of {len(update.changed)} voxels': lambda: mirror.change(change),
    }


def message(mapper: Mapper, update: Update) -> Any:
    """Return a change with moments, as a client receives it."""
    moments = mapper.map.moments(update.changed.voxel_index)
    content = moment_cloud(update.changed, moments, NOTHING)
    stamp = SimpleNamespace(sec=1, nanosec=0)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id='odom'),
        **{name: getattr(content, name) for name in content.__slots__},
    )
