# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The one configuration of node and replay: a frozen dataclass for every stage.

A setting states its default, unit, bounds and meaning once, here. The ROS parameters, the YAML
files and the table in docs/settings.md are made from it or compared with it. A setting is called
``stage.name`` everywhere, or by its name alone if it belongs to no stage. Values keep to the types
of ROS parameters, so that one YAML serves both. Nothing is repaired in silence: an unknown name,
a wrong type or a value out of bounds is a ConfigError.
"""

from surfel_mapper.config.configuration import Config as Config
from surfel_mapper.config.configuration import declarations as declarations
from surfel_mapper.config.configuration import load_config as load_config
from surfel_mapper.config.configuration import load_layer_packages as load_layer_packages
from surfel_mapper.config.configuration import register_stage as register_stage
from surfel_mapper.config.configuration import stage_fields as stage_fields
from surfel_mapper.config.configuration import unregister_stage as unregister_stage
from surfel_mapper.config.layers import DynamicConfig as DynamicConfig
from surfel_mapper.config.layers import EsdfConfig as EsdfConfig
from surfel_mapper.config.layers import GridConfig as GridConfig
from surfel_mapper.config.layers import ModelsConfig as ModelsConfig
from surfel_mapper.config.layers import ModelsLayerConfig as ModelsLayerConfig
from surfel_mapper.config.layers import SEMANTICS as SEMANTICS
from surfel_mapper.config.layers import TsdfConfig as TsdfConfig
from surfel_mapper.config.registration import AlignConfig as AlignConfig
from surfel_mapper.config.registration import LoopsConfig as LoopsConfig
from surfel_mapper.config.registration import RegistrationConfig as RegistrationConfig
from surfel_mapper.config.settings import checked as checked
from surfel_mapper.config.settings import Declaration as Declaration
from surfel_mapper.config.settings import flatten as flatten
from surfel_mapper.config.settings import near as near
from surfel_mapper.config.settings import plain as plain
from surfel_mapper.config.settings import setting as setting
from surfel_mapper.config.settings import Settings as Settings
from surfel_mapper.config.settings import settings_of as settings_of
from surfel_mapper.config.settings import Stage as Stage
from surfel_mapper.config.stages import AUTO as AUTO
from surfel_mapper.config.stages import ClearConfig as ClearConfig
from surfel_mapper.config.stages import DeskewConfig as DeskewConfig
from surfel_mapper.config.stages import DiagnosticsConfig as DiagnosticsConfig
from surfel_mapper.config.stages import FramesConfig as FramesConfig
from surfel_mapper.config.stages import InputConfig as InputConfig
from surfel_mapper.config.stages import MapConfig as MapConfig
from surfel_mapper.config.stages import OutputConfig as OutputConfig
from surfel_mapper.config.stages import PoseConfig as PoseConfig
from surfel_mapper.config.stages import PublishConfig as PublishConfig
from surfel_mapper.config.stages import WindowConfig as WindowConfig
from surfel_mapper.config.tables import allowed as allowed
from surfel_mapper.config.tables import FIRST as FIRST
from surfel_mapper.config.tables import first_ones as first_ones
from surfel_mapper.config.tables import settings_table as settings_table
from surfel_mapper.config.tables import yaml_value as yaml_value
from surfel_mapper.config.yaml_files import parse_yaml as parse_yaml
from surfel_mapper.config.yaml_files import read_yaml as read_yaml
