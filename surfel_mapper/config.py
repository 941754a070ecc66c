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

from __future__ import annotations

from collections.abc import Iterator, Mapping
import dataclasses
from dataclasses import dataclass, field
import difflib
import math
from pathlib import Path
from typing import Any

from surfel_mapper.errors import ConfigError

POSE_SOURCES = ('tf', 'odometry', 'pose', 'identity', 'registration')


def setting(
    default: Any,
    meaning: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
) -> Any:
    """
    Declare a setting: its default, what it means and which values it may have.

    Parameters
    ----------
    default : bool, int, float, str or tuple of float
        Also gives the type.
    meaning : str
        One sentence for ``ros2 param describe`` and the table of the README.
    low, high : float, optional
        Bounds, both allowed.
    choices : tuple of str
        The only values allowed, where given.
    live : bool
        Whether a running node takes a new value.

    """
    metadata = {'meaning': meaning, 'low': low, 'high': high, 'choices': choices, 'live': live}
    return field(default=default, metadata=metadata)


class Stage:
    """Base of the stages: checks every setting against its declaration."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Check every value; a whole number becomes a float where a float is declared."""
        stage = stage_name(type(self))
        for declared in dataclasses.fields(self):  # type: ignore[arg-type]
            name = f'{stage}.{declared.name}'
            value = checked(name, getattr(self, declared.name), declared)
            object.__setattr__(self, declared.name, value)
        self.check(stage)

    def check(self, stage: str) -> None:
        """Check what concerns several settings of the stage."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapConfig(Stage):
    """The voxel map."""

    voxel_size_m: float = setting(0.5, 'Edge of a voxel, m.', low=0.001, high=1000.0)
    min_points: int = setting(
        5, 'Surfels of fewer points are not published.', low=1, high=2**31 - 1, live=True
    )
    max_voxels: int = setting(
        0,
        'The oldest scans leave while the map holds more voxels; 0: no such limit.',
        low=0,
        high=2**31 - 1,
        live=True,
    )
    threads: int = setting(
        1, 'How many threads share the work of a scan; the map is the same.', low=1, high=64
    )
    intensity: bool = setting(
        False, 'Sum the intensity of the points too; clouds without one are dropped.'
    )
    color: bool = setting(
        False, 'Sum the colour (rgb) of the points too; clouds without one are dropped.'
    )

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of the points that the map sums."""
        wanted = {'intensity': self.intensity, 'rgb': self.color}
        return tuple(name for name, is_wanted in wanted.items() if is_wanted)


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowConfig(Stage):
    """Which scans stay in the map; the first limit reached evicts the oldest."""

    max_scans: int = setting(
        100, 'At most this many scans; 0: no such limit.', low=0, high=2**31 - 1, live=True
    )
    max_age_s: float = setting(
        0.0,
        'A scan older than the newest by more than this leaves, s; 0: no such limit.',
        low=0.0,
        high=1e9,
        live=True,
    )
    max_distance_m: float = setting(
        0.0,
        'A scan leaves once the sensor has travelled farther than this since, m; '
        '0: no such limit.',
        low=0.0,
        high=1e9,
        live=True,
    )
    max_bytes: int = setting(
        0,
        'The oldest scans leave while those held need more bytes; 0: no such limit.',
        low=0,
        high=2**62,
        live=True,
    )
    keep_points: bool = setting(False, 'Keep the points of the scans of the window.')
    gate_distance_m: float = setting(
        0.0,
        'A scan is left out unless the sensor has moved this far since the last one mapped, m, '
        'or turned by gate_angle_deg; both 0: every scan is mapped.',
        low=0.0,
        high=1e6,
        live=True,
    )
    gate_angle_deg: float = setting(
        0.0,
        'A scan is left out unless the sensor has turned by this since the last one mapped, '
        'deg, or moved by gate_distance_m.',
        low=0.0,
        high=180.0,
        live=True,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseConfig(Stage):
    """Where the pose of a scan comes from."""

    source: str = setting(
        'tf',
        'tf: the tree in /tf; odometry: nav_msgs/Odometry; pose: geometry_msgs/PoseStamped; '
        'identity: clouds are in the fixed frame.',
        choices=POSE_SOURCES,
    )
    max_wait_s: float = setting(
        0.5,
        'A scan whose pose is not there when newer data is this much newer is dropped, s.',
        low=0.0,
        high=3600.0,
        live=True,
    )
    max_waiting_scans: int = setting(
        20,
        'At most this many scans wait for their pose; the oldest is dropped.',
        low=1,
        high=10**6,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FramesConfig(Stage):
    """Coordinate frames, after REP 105."""

    fixed: str = setting('odom', 'The frame of the map and of all output.')
    base: str = setting('base_link', 'The frame whose pose odometry or pose messages give.')
    base_to_sensor: tuple[float, ...] = setting(
        (),
        'Pose of the sensor in the base frame, x y z in m, qx qy qz qw; empty: from /tf_static.',
    )

    def check(self, stage: str) -> None:
        """Refuse empty frames and extrinsics that are no rigid transform."""
        for name in ('fixed', 'base'):
            if not getattr(self, name):
                raise ConfigError(f'{stage}.{name}: empty, expected the name of a frame')
        values = self.base_to_sensor
        if len(values) not in (0, 7):
            raise ConfigError(
                f'{stage}.base_to_sensor: {len(values)} values, '
                'expected 7 (x y z qx qy qz qw) or none'
            )
        if values and abs(math.hypot(*values[3:]) - 1.0) > 1e-3:
            raise ConfigError(
                f'{stage}.base_to_sensor: quaternion {list(values[3:])} has norm '
                f'{math.hypot(*values[3:]):.6g}, expected 1 (order x y z w)'
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class InputConfig(Stage):
    """What is taken of the clouds that come in."""

    min_range_m: float = setting(
        0.1, 'Points nearer to the origin of their frame are left out, m.', low=0.0, high=1e6
    )
    max_range_m: float = setting(
        0.0, 'Points farther from it are left out, m; 0: no such limit.', low=0.0, high=1e6
    )
    reset_after_s: float = setting(
        1.0,
        'A stamp that goes back by more than this clears the map, s; '
        'by less, the scan is dropped.',
        low=0.0,
        high=1e9,
    )

    def check(self, stage: str) -> None:
        """Refuse an empty range."""
        if 0.0 < self.max_range_m <= self.min_range_m:
            raise ConfigError(
                f'{stage}.max_range_m: {self.max_range_m}, expected more than '
                f'{stage}.min_range_m ({self.min_range_m}), or 0 for no limit'
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishConfig(Stage):
    """What the node publishes, and how often."""

    changed: bool = setting(True, 'Publish ~/changed after every scan.', live=True)
    normals_rate_hz: float = setting(
        1.0, 'Rate of the full map on ~/normals, Hz; 0: never.', low=0.0, high=1000.0, live=True
    )
    markers_rate_hz: float = setting(
        1.0, 'Rate of ~/markers, Hz; 0: never.', low=0.0, high=1000.0, live=True
    )
    max_markers: int = setting(
        20_000, 'At most this many surfels are drawn in ~/markers.', low=1, high=10**7, live=True
    )
    diagnostics_rate_hz: float = setting(
        1.0, 'Rate of /diagnostics, Hz; 0: never.', low=0.0, high=100.0
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputConfig(Stage):
    """Where files are written; the node writes nowhere else."""

    directory: str = setting('surfel_maps', 'Directory of ~/save_map; made when first needed.')
    map_name: str = setting('map', 'Name of the files of ~/save_map inside it, no extension.')

    def check(self, stage: str) -> None:
        """Refuse names that would leave the directory."""
        if not self.directory:
            raise ConfigError(f'{stage}.directory: empty, expected the path of a directory')
        name = self.map_name
        if not name or name.startswith('.') or any(c in name for c in '/\\\0'):
            raise ConfigError(
                f'{stage}.map_name: {name!r}, expected a plain file name: '
                'not empty, no leading dot, no slash'
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    """All settings of the pipeline: one field a stage, and those of no stage."""

    map: MapConfig = field(default_factory=MapConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    pose: PoseConfig = field(default_factory=PoseConfig)
    frames: FramesConfig = field(default_factory=FramesConfig)
    input: InputConfig = field(default_factory=InputConfig)
    publish: PublishConfig = field(default_factory=PublishConfig)
    output: OutputConfig = field(default_factory=OutputConfig)
    filters: str = setting(
        '', 'YAML file of the filters that every scan passes before it is mapped; empty: none.'
    )

    def __post_init__(self) -> None:
        """Check the settings of no stage; each stage has checked its own."""
        for declared in dataclasses.fields(self):
            if 'meaning' in declared.metadata:
                checked(declared.name, getattr(self, declared.name), declared)

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
        stages: dict[str, dict[str, Any]] = {}
        of_no_stage: dict[str, Any] = {}
        known = {declared.name: declared for declared in declarations()}
        for name, value in flatten(mapping):
            if name not in known:
                raise ConfigError(f'{name}: no such setting{near(name, known)}')
            declared = known[name]
            place = stages.setdefault(declared.stage, {}) if declared.stage else of_no_stage
            place[declared.key] = value
        classes = {f.name: f.default_factory for f in dataclasses.fields(cls)}
        made = {stage: classes[stage](**values) for stage, values in stages.items()}  # type: ignore[operator]
        return cls(**made, **of_no_stage)

    def to_mapping(self) -> dict[str, Any]:
        """Return all settings as ``stage.name`` to value, in the order they are declared."""
        return {
            declared.name: getattr(
                getattr(self, declared.stage) if declared.stage else self, declared.key
            )
            for declared in declarations()
        }

    def replace(self, mapping: Mapping[str, Any]) -> Config:
        """Return a copy with some settings changed; see from_mapping."""
        return Config.from_mapping({**self.to_mapping(), **dict(flatten(mapping))})


@dataclass(frozen=True, slots=True)
class Declaration:
    """One setting as declared: its full name, and what ``setting`` was told; stage may be ''."""

    name: str
    stage: str
    key: str
    default: Any
    meaning: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    live: bool


def declarations() -> list[Declaration]:
    """Return the declaration of every setting, in order."""
    rows = []
    for stage in dataclasses.fields(Config):
        if 'meaning' in stage.metadata:
            rows.append(Declaration(stage.name, '', stage.name, stage.default, **stage.metadata))
            continue
        for key in dataclasses.fields(stage.default_factory):  # type: ignore[arg-type]
            name = f'{stage.name}.{key.name}'
            rows.append(Declaration(name, stage.name, key.name, key.default, **key.metadata))
    return rows


def load_config(path: str | Path | None = None) -> Config:
    """
    Return the configuration in a YAML file, or the defaults without one.

    Parameters
    ----------
    path : str or Path, optional
        A YAML file of ROS parameters (``/**: ros__parameters: ...``), or of the stages alone.
        ``use_sim_time`` and ``qos_overrides`` are for the node and passed over here.

    Raises
    ------
    ConfigError
        If the file cannot be read, is not YAML, or holds something that is no setting.

    """
    import yaml

    if path is None:
        return Config()
    try:
        content = yaml.safe_load(Path(path).read_text(encoding='utf-8'))
    except OSError as error:
        raise ConfigError(f'{path}: cannot be read: {error.strerror}') from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f'{path}: not YAML: {error}') from error
    if content is None:
        return Config()
    try:
        return Config.from_mapping(ros_parameters(content))
    except ConfigError as error:
        raise ConfigError(f'{path}: {error}') from error


def ros_parameters(content: Any) -> dict[str, Any]:
    """Return the settings in the content of a parameters file, whichever way it is laid out."""
    if not isinstance(content, Mapping):
        raise ConfigError(f'a {type(content).__name__}, expected a mapping of settings')
    settings: dict[str, Any] = {}
    for name, value in content.items():
        if isinstance(value, Mapping) and 'ros__parameters' in value:
            settings.update(flatten(value['ros__parameters'] or {}))
        else:
            settings.update(flatten({name: value}))
    for_node = ('use_sim_time', 'qos_overrides.')
    return {name: value for name, value in settings.items() if not name.startswith(for_node)}


def flatten(mapping: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    """Yield the leaves of nested mappings with their dotted names."""
    if not isinstance(mapping, Mapping):
        raise ConfigError(f'a {type(mapping).__name__}, expected a mapping of settings')
    for name, value in mapping.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}', value


def near(name: str, known: Mapping[str, Any] | list[str]) -> str:
    """Return '; did you mean ...?' for the known name most like this one, or nothing."""
    found = difflib.get_close_matches(name, list(known), n=1)
    return f'; did you mean {found[0]}?' if found else ''


def stage_name(cls: type) -> str:
    """Return the name of a stage from its class: WindowConfig is window."""
    return cls.__name__.removesuffix('Config').lower()


def checked(name: str, value: Any, declared: dataclasses.Field[Any]) -> Any:
    """Return the value in the type of its declaration, or raise ConfigError."""
    expected, meta = declared.default, declared.metadata
    if isinstance(expected, tuple):
        if isinstance(value, str) or not hasattr(value, '__iter__'):
            raise ConfigError(f'{name}: {value!r}, expected a list of numbers')
        return tuple(checked_number(name, item, float) for item in value)
    if isinstance(expected, (bool, str)):
        if not isinstance(value, type(expected)):
            raise ConfigError(f'{name}: {value!r}, expected a {type(expected).__name__}')
    else:
        value = checked_number(name, value, type(expected))
        low = -math.inf if meta['low'] is None else meta['low']
        high = math.inf if meta['high'] is None else meta['high']
        if not low <= value <= high:
            raise ConfigError(f'{name}: {value}, expected a value in [{low:g}, {high:g}]')
    if meta['choices'] and value not in meta['choices']:
        expected_names = ', '.join(meta['choices'])
        raise ConfigError(
            f'{name}: {value!r}, expected one of {expected_names}'
            f'{near(str(value), list(meta["choices"]))}'
        )
    return value


def checked_number(name: str, value: Any, kind: type) -> Any:
    """Return a finite number of a type; a whole number may stand for a float."""
    whole = isinstance(value, int) and not isinstance(value, bool)
    if kind is float and (whole or isinstance(value, float)):
        if not math.isfinite(value):
            raise ConfigError(f'{name}: {value}, expected a finite number')
        return float(value)
    if kind is int and whole:
        return value
    wanted = 'a number' if kind is float else 'a whole number'
    raise ConfigError(f'{name}: {value!r}, expected {wanted}')
