# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Config: all settings together, read from a file."""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from surfel_mapper.config.layers import (
    DynamicConfig,
    EsdfConfig,
    GridConfig,
    ModelsLayerConfig,
    TsdfConfig,
)
from surfel_mapper.config.parameters_file import ros_parameters
from surfel_mapper.config.registration import AlignConfig, LoopsConfig, RegistrationConfig
from surfel_mapper.config.settings import (
    checked,
    Declaration,
    flatten,
    near,
    setting,
    settings_of,
    Stage,
    stage_name,
)
from surfel_mapper.config.stages import (
    ClearConfig,
    DeskewConfig,
    DiagnosticsConfig,
    FramesConfig,
    InputConfig,
    MapConfig,
    OutputConfig,
    PoseConfig,
    PublishConfig,
    WindowConfig,
)
from surfel_mapper.config.yaml_files import read_yaml
from surfel_mapper.errors import ConfigError

LAYERS = 'surfel_mapper.layers'
"""Group of the entry points by which other packages add layers, and the stages of these."""

_LAYER_STAGES: dict[str, type[Stage]] = {}
"""Stages of layers of other packages, by name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    """
    All settings of the pipeline: one field a stage, and those of no stage.

    Examples
    --------
    >>> Config().map.voxel_size_m
    0.5
    >>> Config.from_mapping({'map.voxel_size_m': 0.2, 'window': {'max_scans': 50}})
    Config(map.voxel_size_m=0.2, window.max_scans=50)

    """

    map: MapConfig = field(default_factory=MapConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    pose: PoseConfig = field(default_factory=PoseConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    align: AlignConfig = field(default_factory=AlignConfig)
    loops: LoopsConfig = field(default_factory=LoopsConfig)
    frames: FramesConfig = field(default_factory=FramesConfig)
    input: InputConfig = field(default_factory=InputConfig)
    deskew: DeskewConfig = field(default_factory=DeskewConfig)
    publish: PublishConfig = field(default_factory=PublishConfig)
    grid: GridConfig = field(default_factory=GridConfig)
    output: OutputConfig = field(default_factory=OutputConfig)
    tsdf: TsdfConfig = field(default_factory=TsdfConfig)
    esdf: EsdfConfig = field(default_factory=EsdfConfig)
    models: ModelsLayerConfig = field(default_factory=ModelsLayerConfig)
    dynamic: DynamicConfig = field(default_factory=DynamicConfig)
    clear: ClearConfig = field(default_factory=ClearConfig)
    diagnostics: DiagnosticsConfig = field(default_factory=DiagnosticsConfig)
    more: Mapping[str, Stage] = field(default_factory=dict)
    """Stages of layers of other packages, by name; see ``stage``."""

    filters: str = setting(
        '',
        'YAML file of the chain of filters applied to every scan before mapping; empty: none.',
        live=True,
    )
    autostart: bool = setting(
        True, 'The node configures and activates itself; false: a lifecycle manager does.'
    )

    def __post_init__(self) -> None:
        """Check the settings of no stage, and conditions on several stages."""
        for entry in dataclasses.fields(self):
            kind, value = entry.default_factory, getattr(self, entry.name)
            if isinstance(kind, type) and not isinstance(value, Mapping if kind is dict else kind):
                raise ConfigError(
                    f'{entry.name}: a {type(value).__name__}, expected a {kind.__name__}'
                )
        for declared in settings_of(type(self)):
            checked(declared.name, getattr(self, declared.key), declared)
        if self.deskew.enabled and self.pose.source == 'identity':
            raise ConfigError(
                'deskew.enabled: true, but clouds that already are in the fixed frame '
                '(pose.source identity) cannot be deskewed'
            )
        if self.loops.enabled and self.map.mode == 'frozen':
            raise ConfigError('loops.enabled: true, but map.mode frozen, which moves no scan')
        if self.align.every_scans and not self.window.keep_points:
            raise ConfigError(
                f'align.every_scans: {self.align.every_scans}, but window.keep_points is false; '
                'scans are moved by their points'
            )

    def __repr__(self) -> str:
        """Return the settings that differ from their defaults."""
        defaults = {declared.name: declared.default for declared in declarations()}
        changed = [
            f'{name}={value!r}'
            for name, value in self.to_mapping().items()
            if value != defaults[name]
        ]
        return f'Config({", ".join(changed)})'

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Config:
        """
        Return the configuration with some settings changed from their defaults.

        Parameters
        ----------
        mapping : mapping of str
            Stages to mappings of settings, or ``stage.name`` to values, or both.

        Raises
        ------
        ConfigError
            If a name is unknown (with the nearest known one), or a value is refused.

        """
        return cls().replace(mapping)

    @property
    def image_topics(self) -> dict[str, str]:
        """Topics of the images joined with the scans, by kind: color, label."""
        return self.tsdf.image_topics

    def to_mapping(self) -> dict[str, Any]:
        """Return all settings as ``stage.name`` to value, in the order they are declared."""
        owners: dict[str, Any] = {'': self}
        owners.update((stage, getattr(self, f.name)) for stage, f in stage_fields().items())
        owners.update((stage, self.stage(stage)) for stage in layer_stages())
        return {
            declared.name: getattr(owners[declared.stage], declared.key)
            for declared in declarations()
        }

    def stage(self, name: str) -> Any:
        """
        Return the stage of a layer of another package, by its name: ``layers.heights``.

        Raises
        ------
        ConfigError
            If no package has registered it.

        """
        if not isinstance(name, str) or name not in {**self.more, **layer_stages()}:
            names = ', '.join(sorted(layer_stages())) or 'none is registered'
            raise ConfigError(
                f'{name!r:.60}: no stage of a layer of another package ({names}); the others are '
                'attributes, as config.map'
            )
        return self.more[name] if name in self.more else layer_stages()[name]()

    def replace(self, mapping: Mapping[str, Any]) -> Config:
        """Return a copy with some settings changed; see from_mapping."""
        stages, of_no_stage = by_stage(mapping)
        fields = {stage: entry.name for stage, entry in stage_fields().items()}
        changed = {
            fields[stage]: dataclasses.replace(getattr(self, fields[stage]), **values)
            for stage, values in stages.items()
            if stage in fields
        }
        more = {
            name: dataclasses.replace(self.stage(name), **stages.get(name, {}))
            for name in layer_stages()
        }
        return dataclasses.replace(self, **changed, **of_no_stage, more=more)


def by_stage(mapping: Mapping[str, Any]) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
    """Return settings by stage and key, and those of no stage; refuse unknown names."""
    stages: dict[str, dict[str, Any]] = {}
    of_no_stage: dict[str, Any] = {}
    by_name = {declared.name: declared for declared in declarations()}
    for name, value in flatten(mapping):
        if name not in by_name:
            raise ConfigError(f'{name}: no such setting{near(name, by_name)}')
        declared = by_name[name]
        values = stages.setdefault(declared.stage, {}) if declared.stage else of_no_stage
        values[declared.key] = value
    return stages, of_no_stage


def stage_fields() -> dict[str, dataclasses.Field[Any]]:
    """Return the field of Config that holds each stage, by the name of the stage."""
    return {
        stage_name(stage.default_factory): stage  # type: ignore[arg-type]
        for stage in dataclasses.fields(Config)
        if 'meaning' not in stage.metadata and stage.name != 'more'
    }


def register_stage(stage: type[Stage]) -> type[Stage]:
    """
    Add the stage of a layer of another package to the configuration; a class decorator.

    Raises
    ------
    ConfigError
        If another stage has the name.

    """
    name = stage_name(stage)
    registered = _LAYER_STAGES.get(name, stage)
    if name in stage_fields() or registered.__qualname__ != stage.__qualname__:
        raise ConfigError(f'stage {name!r} of {stage.__module__}: another stage has this name')
    _LAYER_STAGES[name] = stage
    return stage


def unregister_stage(stage: type[Stage]) -> None:
    """Remove a stage that was registered."""
    del _LAYER_STAGES[stage_name(stage)]


def layer_stages() -> dict[str, type[Stage]]:
    """Return the stages of layers of other packages, by name; loads those packages first."""
    load_layer_packages()
    return _LAYER_STAGES


@cache
def load_layer_packages() -> None:
    """
    Load the packages that add layers: they register them, and their stages.

    Raises
    ------
    ConfigError
        If a package cannot be loaded.

    """
    for point in entry_points(group=LAYERS):
        try:
            point.load()
        except Exception as error:  # whatever the package raises
            raise ConfigError(f'layer {point.name} of {point.value}: {error}') from error


def declarations() -> list[Declaration]:
    """Return the declaration of every setting, in order."""
    rows: list[Declaration] = []
    for stage, holder in stage_fields().items():
        rows += settings_of(holder.default_factory, stage)
    for stage, cls in layer_stages().items():
        rows += settings_of(cls, stage)
    return [*rows, *settings_of(Config)]


def load_config(path: str | Path | None = None) -> Config:
    """
    Return the configuration in a YAML file, or the defaults without one.

    Parameters
    ----------
    path : str or Path, optional
        A YAML file of ROS parameters (``/**: ros__parameters: ...``), or of the stages alone. Of a
        file for several nodes those of ``/**`` and of ``surfel_mapper`` are taken.
        ``use_sim_time`` and ``qos_overrides`` belong to rclpy and are ignored.

    Raises
    ------
    ConfigError
        If the file cannot be read, is not YAML, or a setting is unknown or refused.

    Examples
    --------
    >>> load_config().map.voxel_size_m
    0.5

    """
    if path is None:
        return Config()
    if not isinstance(path, (str, Path)):
        raise ConfigError(
            f'path: a {type(path).__name__}, expected a str or Path of a YAML file; '
            'Config.from_mapping(settings) takes a dict'
        )
    try:
        content = read_yaml(path)
    except OSError as error:
        raise ConfigError(f'{path}: cannot be read: {error.strerror}') from error
    except ValueError as error:
        raise ConfigError(f'{path}: not YAML: {error}') from error
    if content is None:
        return Config()
    try:
        return Config.from_mapping(ros_parameters(content))
    except ConfigError as error:
        raise ConfigError(f'{path}: {error}') from error
