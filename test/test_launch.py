# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The launch file: its settings, overrides and views.

``launch`` and ``launch_ros`` are not on PyPI. Where they are missing, stand-ins that record their
arguments take their place, so that all of our own code runs.
"""

from __future__ import annotations

from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
import sys
from types import ModuleType, SimpleNamespace

import pytest
import yaml

from surfel_mapper.config import declarations
from test import settings
from test.ros.domain import domain_of_our_own

FOLDER = settings.DEFAULT_YAML.parent


class Recorded(SimpleNamespace):
    """An object that keeps its arguments."""

    def __init__(self, *args, **kwargs):
        super().__init__(args=args, **kwargs)
        self.name = kwargs.get('name', args[0] if args else '')


class Configuration:
    """The value of an argument."""

    def __init__(self, name):
        self.name = name

    def perform(self, context):
        return context[self.name]


@pytest.fixture
def launch(monkeypatch):
    """Return the module of the launch file."""
    names = {
        'launch': ('LaunchContext', 'LaunchDescription'),
        'launch.actions': ('DeclareLaunchArgument', 'OpaqueFunction'),
        'launch.substitutions': (),
        'launch_ros': (),
        'launch_ros.actions': ('Node',),
    }
    if find_spec('launch') is None:
        for module, classes in names.items():
            stand_in = ModuleType(module)
            for name in classes:
                setattr(stand_in, name, Recorded)
            monkeypatch.setitem(sys.modules, module, stand_in)
        sys.modules['launch.substitutions'].LaunchConfiguration = Configuration
    elif find_spec('launch_ros') is not None:
        pytest.skip('with launch installed the file is run by `ros2 launch`')
    spec = spec_from_file_location('mapper_launch', FOLDER / 'mapper.launch.py')
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def values(launch, **changes):
    """Return the values of all arguments, as text."""
    return {**{a.name: a.default_value for a in launch.ARGUMENTS}, **changes}


def test_the_default_is_the_node_with_the_default_settings(launch):
    (node,) = launch.nodes(values(launch))
    assert (node.package, node.executable, node.namespace) == ('surfel_mapper', 'node', '')
    assert node.parameters == [str(FOLDER / 'default.yaml')]
    assert ('points', 'points') in node.remappings


def test_the_node_is_started_again_a_few_times_unless_refused(launch):
    (node,), (once,) = (
        launch.nodes(values(launch, **given)) for given in ({}, {'respawn': 'false'})
    )
    assert (node.respawn, node.respawn_delay, node.respawn_max_retries) == (True, 2.0, 5)
    assert not once.respawn


@pytest.mark.parametrize('namespace', ['', 'robot1', '/fleet/robot1'])
def test_the_log_level_is_given_to_the_logger_of_the_node(launch, namespace):
    rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')
    (node,) = launch.nodes(values(launch, namespace=namespace, log_level='debug'))
    with domain_of_our_own(), rclpy.Context() as context:
        made = rclpy.create_node(node.name, namespace=namespace, context=context)
        name = made.get_logger().name
        made.destroy_node()
    assert node.ros_arguments == ['--log-level', f'{name}:=debug']


def test_a_settings_file_that_does_not_exist_ends_the_launch(launch, tmp_path):
    with pytest.raises(FileNotFoundError, match=r'config:=.*typo\.yaml: no such file'):
        launch.nodes(values(launch, config=str(tmp_path / 'typo.yaml')))


def test_a_voxel_size_that_is_no_number_ends_the_launch(launch):
    with pytest.raises(ValueError, match=r'voxel_size:=0,2: expected a number'):
        launch.overrides(values(launch, voxel_size='0,2'))


def test_arguments_override_existing_settings_with_their_type(launch):
    given = {'pose_source': 'odometry', 'input_kind': 'depth', 'voxel_size': '0.2'}
    (node,) = launch.nodes(values(launch, **given, fixed_frame='map', autostart='false'))
    assert node.parameters[1] == {
        'autostart': False,
        'pose.source': 'odometry',
        'input.kind': 'depth',
        'map.voxel_size_m': 0.2,
        'frames.fixed': 'map',
    }
    known = {declared.name: declared for declared in declarations()}
    for name, value in node.parameters[1].items():
        assert type(value) is type(known[name].default)
    assert set(launch.SOURCES) == set(known['pose.source'].choices)


@pytest.mark.parametrize('value', ['', 'true', 'false'])
def test_simulated_time_is_set_only_if_asked(launch, value):
    for node in launch.nodes(values(launch, use_sim_time=value, rviz='true')):
        given = [item for item in node.parameters if isinstance(item, dict)]
        assert given == ([{'use_sim_time': value == 'true'}] if value else [])


def test_the_view_of_a_namespace_shows_its_topics(launch):
    _, rviz = launch.nodes(values(launch, rviz='true', namespace='/robot'))
    path = Path(rviz.arguments[1])
    try:
        text = path.read_text(encoding='utf-8')
    finally:
        path.unlink()
    assert 'Value: /surfel_mapper' not in text
    topics = topics_in(yaml.safe_load(text))
    plain = topics_in(yaml.safe_load((FOLDER / 'mapper.rviz').read_text(encoding='utf-8')))
    assert topics == {f'/robot{topic}' for topic in plain}
    assert rviz.namespace == '/robot'


def topics_in(view):
    """Return all topics of an RViz view."""
    manager = view['Visualization Manager']
    entries = [*manager['Displays'], *manager['Tools']]
    return {entry['Topic']['Value'] for entry in entries if 'Topic' in entry}


def test_the_view_has_every_output_and_the_initial_pose(launch):
    text = (FOLDER / 'mapper.rviz').read_text(encoding='utf-8')
    topics = topics_in(yaml.safe_load(text))
    for name in (
        'markers',
        'planes',
        'mesh_tiles',
        'tsdf_slice',
        'track',
        'path',
        'grid',
        'normals',
    ):
        assert f'/surfel_mapper/{name}' in topics
    assert '/initialpose' in topics
