# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Settings as ROS parameters: declarations, overrides, and refused values."""

from __future__ import annotations

import pytest

from surfel_mapper.config import Config, declarations
from surfel_mapper.errors import ConfigError

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from rclpy.parameter import Parameter  # noqa: E402

from surfel_mapper.ros.parameters import (  # noqa: E402
    declare_settings,
    settings_among,
    unread_files,
)

TYPES = {
    bool: 'BOOL',
    int: 'INTEGER',
    float: 'DOUBLE',
    str: 'STRING',
    (float,): 'DOUBLE_ARRAY',
    (str,): 'STRING_ARRAY',
}
NUMBERS = ('INTEGER', 'DOUBLE')


def type_name(declared):
    is_list = isinstance(declared.default, tuple)
    return TYPES[(declared.items,) if is_list else type(declared.default)]


@pytest.fixture
def make(domain):
    """Return a function that creates a node with overrides."""
    nodes = []
    context = rclpy.Context()
    rclpy.init(context=context)

    def node(*arguments):
        cli_args = ['--ros-args', *(item for pair in arguments for item in ('-p', pair))]
        nodes.append(rclpy.create_node('surfel_mapper', context=context, cli_args=cli_args))
        return nodes[-1]

    yield node
    for made in nodes:
        made.destroy_node()
    context.shutdown()


def test_every_setting_is_a_parameter_of_its_type_default_bounds_and_meaning(make):
    node = make()

    assert declare_settings(node) == Config()

    for declared in declarations():
        found = node.get_parameter(declared.name)
        described = node.describe_parameter(declared.name)
        is_list = isinstance(declared.default, tuple)
        expected = list(declared.default) if is_list else declared.default
        assert found.value == expected
        assert found.type_.name == type_name(declared)
        assert described.type == found.type_.value
        assert described.description == declared.meaning
        assert described.read_only is not declared.live
        for choice in declared.choices:
            assert choice in described.additional_constraints
        ranges = [*described.floating_point_range, *described.integer_range]
        assert [(r.from_value, r.to_value) for r in ranges] == (
            [(declared.low, declared.high)] if type_name(declared) in NUMBERS else []
        )


def test_overrides_reach_the_configuration(make):
    node = make(
        'map.voxel_size_m:=2',  # an integer for a float
        'pose.source:=odometry',
        'frames.base_to_sensor:=[1.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]',
        'use_sim_time:=false',
        'qos_overrides./points.subscription.depth:=3',
    )

    config = declare_settings(node)

    assert config == Config.from_mapping(
        {
            'map.voxel_size_m': 2.0,
            'pose.source': 'odometry',
            'frames.base_to_sensor': [1.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0],
        }
    )
    for name, value in config.to_mapping().items():
        shown = list(value) if isinstance(value, tuple) else value
        assert node.get_parameter(name).value == shown


def test_an_empty_list_is_the_default(make):
    assert declare_settings(make('frames.base_to_sensor:=[]')) == Config()


def test_a_list_cannot_be_changed_while_running(make):
    node = make()
    declare_settings(node)
    name = 'frames.base_to_sensor'

    result = node.set_parameters([Parameter(name, Parameter.Type.DOUBLE_ARRAY, [1.0] * 7)])[0]

    assert not result.successful
    assert 'read-only' in result.reason


@pytest.mark.parametrize(
    ('override', 'message'),
    [
        ('map.voxelsize_m:=0.5', 'map.voxelsize_m: no such setting; did you mean'),
        ('voxel_size_m:=0.5', 'did you mean map.voxel_size_m?'),
        ('map.voxel_size_m:=-1.0', r'map.voxel_size_m: -1, expected a value in \[0.001, 1000\]'),
        ('map.min_points:=2.5', 'map.min_points: 2.5, expected a whole number'),
        ('pose.source:=odom', 'did you mean odometry?'),
        ('frames.base_to_sensor:=[1, 2, 3]', 'expected 7'),
    ],
)
def test_a_wrong_name_or_value_is_refused_before_anything_is_declared(make, override, message):
    node = make(override)

    with pytest.raises(ConfigError, match=message):
        declare_settings(node)

    assert not node.has_parameter('map.min_points')


def test_parameters_of_rclpy_are_no_settings():
    found = [Parameter('window.max_scans', value=7), Parameter('use_sim_time', value=True)]
    assert settings_among(found) == {'window.max_scans': 7}


@pytest.mark.parametrize(
    ('sections', 'is_named'),
    [
        ('/**: &node\n  ros__parameters: {map: {voxel_size_m: 0.2}}', False),
        ('robot:\n  surfel_mapper:\n    ros__parameters: {map: {voxel_size_m: 0.2}}', False),
        ('mapper:\n  ros__parameters: {map: {voxel_size_m: 0.2}}', True),
    ],
)
def test_a_file_with_parameters_of_other_nodes_alone_is_named(tmp_path, sections, is_named):
    file = tmp_path / 'params.yaml'
    file.write_text(sections)
    arguments = ['--ros-args', '-r', 'points:=/a', '--params-file', str(file)]
    assert [*unread_files(arguments, 'surfel_mapper')] == (
        [f'{file}: parameters of mapper, none of surfel_mapper: none is used'] if is_named else []
    )
