# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The configuration: accepted values, bounds, and refusals by name."""

from __future__ import annotations

import dataclasses
import math
import re

import pytest

from surfel_mapper.config import (
    Config,
    declarations,
    load_config,
    parse_yaml,
    register_stage,
    setting,
    Stage,
    stage_fields,
)
from surfel_mapper.errors import ConfigError

DECLARATIONS = {declared.name: declared for declared in declarations()}
BOUNDED = [declared for declared in declarations() if declared.is_number]
QUARTER_TURN = [1.0, 2.0, 3.0, 0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)]

UNITS = {'m', 's', 'deg', 'hz', 'voxels', 'weight', 'ratio', 'overlap', 'confidence'}

# A stage may refuse a combination of values within bounds; these companions avoid that.
COMPANIONS = {
    'align.every_scans': {'window.keep_points': True},
    'esdf.slice_min_m': {'esdf.slice_max_m': 1e5},
    'esdf.slice_max_m': {'esdf.slice_min_m': -1e5},
    'input.min_range_m': {'input.max_range_m': 0.0},
    'layers.tsdf.min_range_m': {'layers.tsdf.max_range_m': 1e5},
    'layers.tsdf.max_range_m': {'layers.tsdf.min_range_m': 0.001},
    'layers.tsdf.voxel_size_m': {'layers.tsdf.truncation_m': 1000.0},
    'layers.tsdf.truncation_m': {'layers.tsdf.voxel_size_m': 0.001},
}


def configured(name, value):
    """Return the configuration with one setting and its companions."""
    return Config.from_mapping({**COMPANIONS.get(name, {}), name: value})


def refusal(function, *args, **kwargs):
    """Return the message of the ConfigError that a call raises."""
    try:
        function(*args, **kwargs)
    except ConfigError as error:
        return str(error)
    return 'not refused'


def written(tmp_path, text):
    """Return the path of a YAML file with some text."""
    path = tmp_path / 'config.yaml'
    path.write_text(text, encoding='utf-8')
    return path


@pytest.mark.parametrize(
    ('settings', 'message'),
    [
        ({'publish.moments': True}, r'publish\.adaptive: .* expected publish\.moments false'),
        (
            {'publish.marker_color': 'age'},
            r'publish\.marker_color: age .* expected another colour',
        ),
    ],
)
def test_adaptive_surfels_have_neither_moments_nor_ages(settings, message):
    with pytest.raises(ConfigError, match=message):
        Config.from_mapping({'publish.adaptive': True, **settings})


def test_nothing_given_gives_the_defaults():
    assert Config.from_mapping({}) == Config() == load_config()
    expected = {name: declared.default for name, declared in DECLARATIONS.items()}
    assert Config().to_mapping() == expected


def test_settings_may_be_dotted_nested_or_both():
    dotted = {'map.voxel_size_m': 0.2, 'map.min_points': 3, 'window.max_scans': 7}
    nested = {'map': {'voxel_size_m': 0.2, 'min_points': 3}, 'window': {'max_scans': 7}}
    both = {'map': {'voxel_size_m': 0.2}, 'map.min_points': 3, 'window': {'max_scans': 7}}
    config = Config.from_mapping(dotted)
    assert config == Config.from_mapping(nested) == Config.from_mapping(both)
    assert (config.map.voxel_size_m, config.map.min_points, config.window.max_scans) == (0.2, 3, 7)


def test_a_configuration_survives_the_way_to_a_mapping_and_back():
    config = Config.from_mapping({'frames.base_to_sensor': QUARTER_TURN, 'pose.source': 'pose'})
    assert Config.from_mapping(config.to_mapping()) == config


def test_replacing_changes_what_is_named_and_keeps_the_rest():
    config = Config.from_mapping({'map.voxel_size_m': 0.2, 'window.max_scans': 7})
    changed = config.replace({'window': {'max_scans': 8}})
    assert changed.window.max_scans == 8
    assert changed.map == config.map
    assert config.window.max_scans == 7


def test_a_setting_of_no_stage_goes_by_its_name_alone():
    config = Config.from_mapping({'filters': 'clean.yaml', 'map': {'min_points': 3}})
    assert (config.filters, config.map.min_points) == ('clean.yaml', 3)
    assert config.to_mapping()['filters'] == 'clean.yaml'
    assert config.replace({'map.min_points': 4}).filters == 'clean.yaml'
    with pytest.raises(ConfigError, match='filters: 7, expected a str'):
        Config(filters=7)


def test_a_whole_number_stands_for_a_float_and_becomes_one():
    value = configured('map.voxel_size_m', 1).map.voxel_size_m
    assert (value, type(value)) == (1.0, float)


def test_a_list_becomes_a_tuple_of_floats():
    value = configured('frames.base_to_sensor', [1, 2, 3, 0, 0, 0, 1]).frames.base_to_sensor
    assert value == (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)
    assert {type(number) for number in value} == {float}


def test_every_declaration_is_complete():
    faults = []
    for declared in declarations():
        if not declared.meaning.endswith('.'):
            faults.append(f'{declared.name}: the meaning is no sentence')
        if declared.is_number and math.isinf(declared.high - declared.low):
            faults.append(f'{declared.name}: a number without bounds')
        unit = declared.key.rpartition('_')[2]
        if isinstance(declared.default, float) and unit not in UNITS:
            faults.append(f'{declared.name}: a float without a unit')
    assert faults == []


def test_bounds_are_allowed_and_values_beyond_are_refused_by_name():
    faults = []
    for declared in BOUNDED:
        for bound, outwards in ((declared.low, -math.inf), (declared.high, math.inf)):
            if configured(declared.name, bound).to_mapping()[declared.name] != bound:
                faults.append(f'{declared.name}: bound {bound} not taken')
            whole = isinstance(declared.default, int)
            step = 1 if outwards > 0 else -1
            beyond = bound + step if whole else math.nextafter(bound, outwards)
            message = refusal(configured, declared.name, beyond)
            if not re.match(rf'{declared.name}: .* expected a value in \[', message):
                faults.append(f'{declared.name} = {beyond}: {message}')
    assert faults == []


def test_values_that_are_no_finite_number_are_refused_by_name():
    faults = []
    for declared in BOUNDED:
        stage = stage_fields()[declared.stage].default_factory
        for value in (math.nan, math.inf, -math.inf, '1', None, True, [1.0], {}):
            message = refusal(stage, **{declared.key: value})
            if not re.match(rf'{declared.name}: .*expected a', message):
                faults.append(f'{declared.name} = {value!r}: {message}')
    assert faults == []


@pytest.mark.parametrize('value', [1, 0, 'true', None])
def test_only_true_and_false_are_boolean(value):
    with pytest.raises(ConfigError, match=r'window\.keep_points: .* expected a bool'):
        configured('window.keep_points', value)


@pytest.mark.parametrize(
    ('name', 'near'),
    [
        ('window.max_scan', 'window.max_scans'),
        ('map.voxel_size', 'map.voxel_size_m'),
        ('frame.fixed', 'frames.fixed'),
    ],
)
def test_a_misspelt_setting_is_refused_with_the_nearest_one(name, near):
    with pytest.raises(ConfigError, match=f'^{name}: no such setting; did you mean {near}\\?$'):
        Config.from_mapping({name: 1})


def test_an_unknown_pose_source_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"pose\.source: 'odom', expected one of auto, tf"):
        configured('pose.source', 'odom')


@pytest.mark.parametrize('name', ['frames.fixed', 'frames.base', 'output.directory'])
def test_an_empty_name_is_refused(name):
    with pytest.raises(ConfigError, match=f'{name}: empty'):
        configured(name, '')


@pytest.mark.parametrize('value', [[], QUARTER_TURN, [0, 0, 0, 0, 0, 0, -1]])
def test_a_rigid_transform_or_none_places_the_sensor(value):
    assert configured('frames.base_to_sensor', value).frames.base_to_sensor == tuple(value)


@pytest.mark.parametrize(
    ('value', 'message'),
    [
        ([0.0] * 6, '6 values, expected 7'),
        ([0.0] * 7, 'norm 0, expected 1'),
        ([0, 0, 0, 0, 0, 0, 1.006], 'norm 1.006, expected 1'),
        ([math.nan, 0, 0, 0, 0, 0, 1], 'nan, expected a finite number'),
        ([0, 0, 0, 0, 0, 0, '1'], "'1', expected a number"),
        ('0 0 0 0 0 0 1', 'expected a list of numbers'),
    ],
)
def test_invalid_poses_of_the_sensor_are_refused(value, message):
    with pytest.raises(ConfigError, match=rf'frames\.base_to_sensor: .*{message}'):
        configured('frames.base_to_sensor', value)


@pytest.mark.parametrize('farthest', [0.05, 0.1])
def test_a_range_without_points_is_refused(farthest):
    with pytest.raises(ConfigError, match=r'input\.max_range_m: .* more than input\.min_range_m'):
        Config.from_mapping({'input.min_range_m': 0.1, 'input.max_range_m': farthest})


def test_a_farthest_range_of_zero_means_no_limit():
    config = Config.from_mapping({'input.min_range_m': 5.0, 'input.max_range_m': 0.0})
    assert config.input.max_range_m == 0.0


@pytest.mark.parametrize('name', ['', '.', '..', '.map', 'a/b', '/etc/map', 'a\\b', 'a\0b'])
def test_a_map_name_that_could_leave_its_directory_is_refused(name):
    with pytest.raises(ConfigError, match=r'output\.map_name: .* expected a plain file name'):
        configured('output.map_name', name)


def test_a_refused_stage_is_not_registered():
    @dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
    class OtherConfig(Stage):
        STAGE = 'map'
        margin_m: float = setting(0.0, 'A margin.')

    before = Config().to_mapping()
    with pytest.raises(ConfigError, match=r"^stage 'map' of test\.test_config: another stage"):
        register_stage(OtherConfig)
    assert Config().to_mapping() == before
    assert Config().replace({'map.min_points': 3}).map.min_points == 3


@pytest.mark.parametrize(
    'text',
    [
        '/**:\n  ros__parameters:\n    window: {max_scans: 7}\n',
        '/**:\n  ros__parameters:\n    window.max_scans: 7\n',
        'my_mapper:\n  ros__parameters:\n    window: {max_scans: 7}\n',
        'robot1:\n  surfel_mapper:\n    ros__parameters:\n      window: {max_scans: 7}\n',
        'amcl:\n  ros__parameters: {alpha1: 0.2}\n'
        'surfel_mapper:\n  ros__parameters: {window.max_scans: 7}\n',
        '/**:\n  ros__parameters: {window.max_scans: 9}\n'
        '/*:\n  ros__parameters: {window.max_scans: 8}\n'
        '/robot1/surfel_mapper:\n  ros__parameters: {window.max_scans: 7}\n'
        'global_costmap: {global_costmap: {ros__parameters: {plugins: []}}}\n',
        'window:\n  max_scans: 7\n',
        'window.max_scans: 7\n',
    ],
)
def test_a_file_may_be_of_ros_parameters_or_of_the_stages_alone(tmp_path, text):
    assert load_config(written(tmp_path, text)) == Config.from_mapping({'window.max_scans': 7})


def test_parameters_of_rclpy_in_a_file_are_ignored(tmp_path):
    text = (
        '/**:\n  ros__parameters:\n    use_sim_time: true\n'
        '    qos_overrides: {/points: {subscription: {reliability: reliable}}}\n'
        '    map: {min_points: 3}\n'
    )
    assert load_config(written(tmp_path, text)) == Config.from_mapping({'map.min_points': 3})


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('- 1\n', 'a list, expected a mapping'),
        ('map: [', 'not YAML'),
        ('map:\n\tmin_points: 3\n', r'not YAML: .* \(a tab\? indent with spaces\) in line 2'),
        ('map:\n  voxel_size_m: -1.0\n', r'map\.voxel_size_m: -1'),
        ('map:\n  voxel_size_m: 0,5\n', r"map\.voxel_size_m: '0,5', expected a number"),
        ('/**:\n  ros__parameters: 7\n', 'expected a mapping'),
        (
            'amcl:\n  ros__parameters: {a: 1}\nmapper:\n  ros__parameters: {map.min_points: 3}\n',
            'parameters of the nodes amcl, mapper, expected those of one, or of one that is named '
            'surfel_mapper',
        ),
        (
            'a:\n  surfel_mapper:\n    ros__parameters: {map.min_points: 3}\n'
            'b:\n  surfel_mapper:\n    ros__parameters: {map.min_points: 4}\n',
            'parameters of the nodes a/surfel_mapper, b/surfel_mapper, expected those of one',
        ),
        ('windows:\n  max_scans: 7\n', r'windows\.max_scans: no such setting'),
    ],
)
def test_a_file_that_is_no_configuration_is_refused_by_name(tmp_path, text, message):
    path = written(tmp_path, text)
    with pytest.raises(ConfigError, match=f'^{path}: .*{message}'):
        load_config(path)


def test_a_file_that_is_not_text_is_refused(tmp_path):
    path = tmp_path / 'config.yaml'
    path.write_bytes(b'\xff\xfe\x00')
    with pytest.raises(ConfigError, match='not YAML'):
        load_config(path)


@pytest.mark.parametrize('name', ['missing.yaml', '.'])
def test_a_file_that_cannot_be_read_is_refused_by_name(tmp_path, name):
    path = tmp_path / name
    with pytest.raises(ConfigError, match=f'^{path}: cannot be read'):
        load_config(path)


@pytest.mark.parametrize(
    ('text', 'name', 'lines'),
    [
        ('map: {min_points: 3}\nwindow: {}\nmap: {}\n', 'map', (1, 3)),
        ('map:\n  min_points: 3\n  min_points: 4\n', r'map\.min_points', (2, 3)),
        ('map: {min_points: 3, min_points: 4}\n', r'map\.min_points', (1, 1)),
        ('map.min_points: 3\nmap:\n  min_points: 4\n', r'map\.min_points', (1, 3)),
    ],
)
def test_a_key_twice_is_refused_with_its_lines(tmp_path, text, name, lines):
    says = f'{name}: twice, in line {lines[0]} and line {lines[1]}, expected once'
    with pytest.raises(ConfigError, match=says):
        load_config(written(tmp_path, text))


@pytest.mark.parametrize('text', ['5e-1', '+5e-1', '5E-1', '5.e-1', '.5e0', '0.05e1', '0.5'])
def test_numbers_with_an_exponent_are_numbers(tmp_path, text):
    config = load_config(written(tmp_path, f'map: {{voxel_size_m: {text}}}\n'))

    assert config.map.voxel_size_m == 0.5


@pytest.mark.parametrize('text', ['e1', '1e', '1e2x', '"1e2"', '1e2e3'])
def test_texts_like_numbers_with_an_exponent_stay_text(text):
    assert parse_yaml(text) == text.strip('"')


def test_the_distance_field_has_at_most_25_settings():
    names = [name for name in DECLARATIONS if name.startswith(('layers.tsdf.', 'esdf.'))]
    assert len(names) <= 25
