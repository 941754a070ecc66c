# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The one configuration of node and replay: a frozen dataclass for every stage.

A setting states its default, unit, bounds and meaning once, here; the ROS parameters, the YAML
files and the table in docs/settings.md are made from it or compared with it. A setting is called
``stage.name`` everywhere, or by its name alone if it belongs to no stage. Values keep to the types
of ROS parameters, so that one YAML serves both. Nothing is repaired in silence: an unknown name,
a wrong type or a value out of bounds is a ConfigError.
"""

from surfel_mapper.config.configuration import (
    Config,
    declarations,
    load_config,
    load_layer_packages,
    register_stage,
    stage_fields,
    unregister_stage,
)
from surfel_mapper.config.layers import (
    DynamicConfig,
    EsdfConfig,
    GridConfig,
    ModelsConfig,
    ModelsLayerConfig,
    SEMANTICS,
    TsdfConfig,
)
from surfel_mapper.config.registration import AlignConfig, LoopsConfig, RegistrationConfig
from surfel_mapper.config.settings import (
    checked,
    Declaration,
    flatten,
    near,
    plain,
    setting,
    Settings,
    settings_of,
    Stage,
)
from surfel_mapper.config.stages import (
    AUTO,
    ClearConfig,
    DeskewConfig,
    DiagnosticsConfig,
    FramesConfig,
    InputConfig,
    MapConfig,
    OutputConfig,
    PoseConfig,
    PublishConfig,
    ViewerConfig,
    WindowConfig,
)
from surfel_mapper.config.tables import allowed, FIRST, first_ones, settings_table, yaml_value
from surfel_mapper.config.yaml_files import parse_yaml, read_yaml

__all__ = [
    'AUTO',
    'AlignConfig',
    'ClearConfig',
    'Config',
    'Declaration',
    'DeskewConfig',
    'DiagnosticsConfig',
    'DynamicConfig',
    'EsdfConfig',
    'FramesConfig',
    'GridConfig',
    'InputConfig',
    'LoopsConfig',
    'MapConfig',
    'ModelsConfig',
    'ModelsLayerConfig',
    'OutputConfig',
    'PoseConfig',
    'PublishConfig',
    'RegistrationConfig',
    'SEMANTICS',
    'Settings',
    'Stage',
    'TsdfConfig',
    'ViewerConfig',
    'WindowConfig',
    'allowed',
    'checked',
    'FIRST',
    'declarations',
    'first_ones',
    'flatten',
    'load_config',
    'load_layer_packages',
    'near',
    'parse_yaml',
    'plain',
    'read_yaml',
    'setting',
    'settings_of',
    'settings_table',
    'register_stage',
    'stage_fields',
    'unregister_stage',
    'yaml_value',
]
