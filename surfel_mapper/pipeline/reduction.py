# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Reduction of scans to the exact moments that enter the map and the window, and that leave it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from surfel_mapper.compilation import CompileStage
from surfel_mapper.config import Config
from surfel_mapper.geometry import Transform
from surfel_mapper.mapping.channels import CHANNELS, summed_columns
from surfel_mapper.mapping.moments import point_keys, ScanMoments
from surfel_mapper.mapping.reducer import within
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import SETTINGS, WindowedScan
from surfel_mapper.scan import Scan


def reduced(
    scan: Scan, T_map_sensor: Transform, surfel_map: SurfelMap, config: Config
) -> WindowedScan:
    """Return a scan as its moments at a pose, with its points if the window keeps them."""
    limits = config.input
    moments = surfel_map.reduce(
        scan.points,
        T_map_sensor,
        origin=viewpoint(T_map_sensor, config),
        min_range_m=limits.min_range_m,
        max_range_m=limits.max_range_m or np.inf,
        columns=scan.columns,
    )
    windowed = WindowedScan(
        moments=moments,
        stamp_ns=scan.stamp_ns,
        T_map_sensor=T_map_sensor,
        frame_id=scan.frame_id,
    )
    if not config.window.keep_points:
        return windowed
    stay = within(scan.points, limits.min_range_m, limits.max_range_m)
    if 'beyond_map' in moments.left_out:
        stay &= point_keys(scan.points, T_map_sensor, surfel_map.voxel_size_m) >= 0
    entered = scan.select(stay)
    columns = summed_columns(entered.columns, surfel_map.columns)
    return replace(windowed, points=entered.points, columns=columns)


def moments_at(
    scan: WindowedScan, T_map_sensor: Transform, surfel_map: SurfelMap, config: Config
) -> ScanMoments:
    """Return the moments of a scan of the window, whose points are kept, at another pose."""
    assert scan.points is not None, 'only scans with points are moved'
    seen_from = viewpoint(T_map_sensor, config)
    return surfel_map.reduce(scan.points, T_map_sensor, origin=seen_from, columns=scan.columns)


def viewpoint(T_map_sensor: Transform, config: Config) -> Transform | None:
    """Return the position of the sensor; None if unknown, and normals stay as they are."""
    if config.pose.source != 'identity':
        return T_map_sensor[:3, 3]
    place = standing_sensor(config)
    if place is None:
        return None
    moved: npt.NDArray[np.float64] = (T_map_sensor[:3, :3] * place).sum(axis=1)
    return moved + T_map_sensor[:3, 3]


def standing_sensor(config: Config) -> npt.NDArray[np.float64] | None:
    """
    Return where the sensor stands with ``pose.source: identity``, (3,) m in the fixed frame.

    Only ``frames.base_to_sensor`` tells: clouds in the fixed frame may be those of a sensor that
    stands in its origin, or made of the scans of one that moves.
    """
    values = config.frames.base_to_sensor
    if config.pose.source != 'identity' or config.frames.sensors or not values:
        return None
    return np.array(values[:3])


def warm_up_stages(config: Config) -> list[CompileStage]:
    """Return the steps that compile reduction, insertion and removal, as far as they are used."""
    stages = [
        CompileStage('adding scans', partial(compile_adding, config)),
        CompileStage('deriving surfels', partial(compile_deriving, config)),
    ]
    if config.map.max_bytes or any(getattr(config.window, name) for name in SETTINGS):
        stages.append(CompileStage('removing scans', partial(compile_removing, config)))
    return stages


def compile_adding(config: Config) -> SurfelMap:
    """Compile reducing and adding points; return the map of one."""
    surfel_map = SurfelMap(config.map.voxel_size_m, columns=config.map.columns)
    columns = {name: np.zeros(1) for name in CHANNELS}
    surfel_map.insert(surfel_map.reduce(np.zeros((1, 3), expected_type(config)), columns=columns))
    return surfel_map


def expected_type(config: Config) -> npt.DTypeLike:
    """Return the type of the points of most sensors: deskewing moves them in double precision."""
    return np.float64 if config.deskew.enabled else np.float32


def compile_deriving(config: Config) -> None:
    """Compile deriving surfels, of coarser maps too if they are published."""
    surfel_map = compile_adding(config)
    surfel_map.surfels_changed(since=0)
    surfel_map.surfels()
    if config.publish.levels:
        surfel_map.coarsen(1).surfels()


def compile_removing(config: Config) -> None:
    """Compile removing points, and the digest."""
    surfel_map = SurfelMap(config.map.voxel_size_m, columns=config.map.columns)
    columns = {name: np.zeros(1) for name in CHANNELS}
    moments = surfel_map.add(np.zeros((1, 3), expected_type(config)), columns=columns)
    surfel_map.digest()
    surfel_map.remove(moments)
