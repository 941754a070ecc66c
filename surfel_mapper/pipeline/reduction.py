# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Scans to the exact moments that enter the map and the window, and that leave it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from surfel_mapper.config import Config
from surfel_mapper.geometry import Transform
from surfel_mapper.mapping.channels import CHANNELS
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.reducer import NARROW_COUNT, within
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import WindowedScan
from surfel_mapper.scan import Scan


def reduced(
    scan: Scan, T_map_sensor: Transform, surfel_map: SurfelMap, config: Config
) -> WindowedScan:
    """Return a scan as its moments at a pose, with its points where the window keeps them."""
    limits = config.input
    moments = surfel_map.reduce(
        scan.points,
        T_map_sensor,
        origin=origin(T_map_sensor, config),
        min_range_m=limits.min_range_m,
        max_range_m=limits.max_range_m or np.inf,
        columns=scan.columns,
    )
    windowed = WindowedScan(moments=moments, stamp_ns=scan.stamp_ns, T_map_sensor=T_map_sensor)
    if not config.window.keep_points:
        return windowed
    entered = scan.select(within(scan.points, limits.min_range_m, limits.max_range_m))
    columns = {name: entered.columns[name] for name in surfel_map.columns}
    return replace(windowed, points=entered.points, columns=columns)


def moments_at(
    scan: WindowedScan, T_map_sensor: Transform, surfel_map: SurfelMap, config: Config
) -> ScanMoments:
    """Return the moments of a scan of the window, whose points are kept, at another pose."""
    assert scan.points is not None, 'only scans with points are moved'
    seen_from = origin(T_map_sensor, config)
    return surfel_map.reduce(scan.points, T_map_sensor, origin=seen_from, columns=scan.columns)


def origin(T_map_sensor: Transform, config: Config) -> Transform | None:
    """Return where the sensor is; None where that is unknown, and normals stay unturned."""
    return None if config.pose.source == 'identity' else T_map_sensor[:3, 3]


def warm_up(config: Config) -> None:
    """Compile what adds, removes and derives, for points of every type and sums of every size."""
    for dtype in (np.float32, np.float64):
        surfel_map = SurfelMap(config.map.voxel_size_m, columns=config.map.columns)
        one, most = ({n: np.zeros(num) for n in CHANNELS} for num in (1, NARROW_COUNT))
        moments = surfel_map.add(np.zeros((1, 3), dtype), columns=one)
        surfel_map.surfels_changed(since=0)
        surfel_map.remove(moments)
        many = surfel_map.add(np.zeros((NARROW_COUNT, 3), dtype), columns=most)  # int64 sums
        surfel_map.remove(many)
    surfel_map.digest()
    if config.publish.levels:
        surfel_map.coarsen(1).surfels()
