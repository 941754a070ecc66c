# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The one configuration of node and replay: a frozen dataclass for every stage.

A setting states its default, unit, bounds and meaning once, here; the ROS parameters, the YAML
files and the table of the README are made from it or compared with it. A setting is called
``stage.name`` everywhere, or by its name alone where it is of no stage. Values keep to the types
of ROS parameters, so that one YAML serves both. Nothing is repaired in silence: an unknown name,
a wrong type or a value out of bounds is a ConfigError.
"""

from surfel_mapper.config.align import AlignConfig
from surfel_mapper.config.configuration import Config, declarations, load_config
from surfel_mapper.config.deskew import DeskewConfig
from surfel_mapper.config.dynamic import DynamicConfig
from surfel_mapper.config.grid import GridConfig
from surfel_mapper.config.models_layer import ModelsLayerConfig
from surfel_mapper.config.operation import ClearConfig, DiagnosticsConfig
from surfel_mapper.config.registration import RegistrationConfig
from surfel_mapper.config.settings import Declaration, flatten, near, setting, Stage
from surfel_mapper.config.stages import (
    FramesConfig,
    InputConfig,
    MapConfig,
    OutputConfig,
    PoseConfig,
    PublishConfig,
    WindowConfig,
)
from surfel_mapper.config.tsdf import TsdfConfig

__all__ = [
    'AlignConfig',
    'ClearConfig',
    'Config',
    'Declaration',
    'DeskewConfig',
    'DiagnosticsConfig',
    'DynamicConfig',
    'FramesConfig',
    'GridConfig',
    'InputConfig',
    'MapConfig',
    'ModelsLayerConfig',
    'OutputConfig',
    'PoseConfig',
    'PublishConfig',
    'RegistrationConfig',
    'Stage',
    'TsdfConfig',
    'WindowConfig',
    'declarations',
    'flatten',
    'load_config',
    'near',
    'setting',
]
