# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Stages that compile the kernels of a node: input, mapping, and the messages of its default outputs.

A node runs them before it subscribes, because it would drop clouds while it compiles.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from surfel_mapper.compilation import CompileStage
from surfel_mapper.config import Config
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import WindowedScan
from surfel_mapper.messages.images import warm_up as warm_up_depth
from surfel_mapper.messages.map_cloud import moment_cloud
from surfel_mapper.messages.scan_normals import scan_with_normals
from surfel_mapper.messages.surfel_markers import disc_colors, surfel_markers
from surfel_mapper.pipeline.mapper import Mapper
from surfel_mapper.pipeline.mapping_stages import expected_type
from surfel_mapper.scan import Scan


def node_stages(mapper: Mapper) -> list[CompileStage]:
    """Return the stages for a node with a mapper."""
    config = mapper.config
    return [
        *([CompileStage('decoding', warm_up_depth)] if config.input.kind == 'depth' else []),
        *mapper.warm_up_stages(),
        CompileStage('messages', partial(compile_messages, config)),
    ]


def compile_messages(config: Config) -> None:
    """Compile the kernels of outgoing messages, and load their libraries by running them once."""
    surfel_map = SurfelMap(config.map.voxel_size_m)
    points = np.ones((1, 3), expected_type(config))
    moments = surfel_map.add(points)
    surfels = surfel_map.surfels()
    scan_with_normals(Scan(points=points, stamp_ns=0, frame_id=''), np.eye(4), surfel_map, 1)
    windowed = WindowedScan(moments=moments, stamp_ns=0, T_map_sensor=np.eye(4))
    colors = disc_colors('age', surfels, [windowed])
    surfel_markers(surfels, config.map.voxel_size_m, colors, stamp_ns=0, frame_id='')
    moment_cloud(surfels, surfel_map.moments(), np.empty((0, 3), np.int32))
