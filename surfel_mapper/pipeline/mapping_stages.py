# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Stages that compile the kernels of the map: adding scans, deriving surfels, removing scans."""

from __future__ import annotations

from functools import partial

import numpy as np
import numpy.typing as npt

from surfel_mapper.compilation import CompileStage
from surfel_mapper.config import Config
from surfel_mapper.mapping.channels import CHANNELS
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import SETTINGS


def warm_up_stages(config: Config) -> list[CompileStage]:
    """Return the steps that compile reduction, insertion and removal, as far as they are used."""
    stages = [
        CompileStage('adding scans', partial(compile_adding, config)),
        CompileStage('deriving surfels', partial(compile_deriving, config)),
    ]
    if config.map.max_bytes or any(getattr(config.window, name) for name in SETTINGS):
        stages.append(CompileStage('removing scans', partial(compile_removing, config)))
    return stages


def compile_adding(config: Config) -> tuple[SurfelMap, ScanMoments]:
    """Compile reducing and adding points; return the map of one, and its moments."""
    surfel_map = SurfelMap(config.map.voxel_size_m, columns=config.map.columns)
    columns = {name: np.zeros(1) for name in CHANNELS}
    points = np.zeros((1, 3), expected_type(config))
    return surfel_map, surfel_map.add(points, columns=columns)


def expected_type(config: Config) -> npt.DTypeLike:
    """Return the type of the points of most sensors: deskewing moves them in double precision."""
    return np.float64 if config.deskew.enabled else np.float32


def compile_deriving(config: Config) -> None:
    """Compile deriving surfels, of coarser maps too if they are published."""
    surfel_map, _ = compile_adding(config)
    surfel_map.surfels_changed(since=0)
    surfel_map.surfels()
    if config.publish.adaptive:
        surfel_map.adaptive()
    if config.publish.levels:
        surfel_map.coarsen(1).surfels()


def compile_removing(config: Config) -> None:
    """Compile removing points, and the digest."""
    surfel_map, moments = compile_adding(config)
    surfel_map.digest()
    surfel_map.remove(moments)
