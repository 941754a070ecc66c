# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The launch file starts what its arguments say, presets differ from it, views show real topics.

Where ``launch`` is not installed, the few classes of it that the file uses are stood in for by
ones that remember what they were given.
"""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
import sys
from types import ModuleType

import pytest
import yaml

from surfel_mapper.config import Config, flatten, load_config

FOLDER = Path(__file__).parents[1] / 'launch_configs'
LAUNCH_FILE = FOLDER / 'mapper.launch.py'
PRESETS = ('spinning_lidar', 'solid_state_lidar', 'indoor_depth_camera')
OUTPUT_TOPICS = {
    f'/surfel_mapper/{name}'
    for name in (
        *('normals', 'changed', 'removed', 'scan_normals', 'markers', 'grid'),
        *('planes', 'primitives', 'outlines', 'surfel_primitives'),
    )
}
INPUT_TOPICS = {'/points'}


class Argument:
    def __init__(self, name, *, default_value, description, choices=None):
        self.name, self.default, self.choices = name, default_value, choices
        self.description = description


class Configuration:
    def __init__(self, name):
        self._name = name

    def perform(self, context):
        return context[self._name]


class Function:
    def __init__(self, *, function):
        self.function = function


class Started:
    def __init__(self, **given):
        self.__dict__.update(given)


@pytest.fixture
def launch_file(monkeypatch):
    """Give the launch file as a module, with stand-ins for launch."""
    if importlib.util.find_spec('launch') is not None:
        pytest.skip('launch is installed: its own classes do not tell what they were given')
    for name, content in {
        'launch': {'LaunchContext': dict, 'LaunchDescription': list},
        'launch.actions': {'DeclareLaunchArgument': Argument, 'OpaqueFunction': Function},
        'launch.substitutions': {'LaunchConfiguration': Configuration},
        'launch_ros': {},
        'launch_ros.actions': {'Node': Started},
    }.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location('mapper_launch', LAUNCH_FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def started(launch_file, **given):
    """Return the nodes that arguments start."""
    *arguments, function = launch_file.generate_launch_description()
    values = {argument.name: argument.default for argument in arguments}
    assert set(given) <= set(values)
    return function.function({**values, **given})


def test_every_argument_is_described_and_its_default_allowed(launch_file):
    for argument in launch_file.generate_launch_description()[:-1]:
        assert argument.description.endswith('.')
        assert argument.choices is None or argument.default in argument.choices


def test_without_arguments_the_node_runs_with_the_defaults(launch_file):
    (node,) = started(launch_file)
    assert (node.package, node.executable, node.name) == (
        *('surfel_mapper', 'node'),
        'surfel_mapper',
    )
    assert node.parameters == [str(FOLDER / 'default.yaml'), {'use_sim_time': False}]
    assert all(topic == remapped for topic, remapped in node.remappings)


def test_arguments_override_the_file_and_say_where_topics_are(launch_file):
    (node,) = started(
        launch_file,
        config='my.yaml',
        points='/lidar/points',
        fixed_frame='map',
        use_sim_time='true',
        autostart='false',
        namespace='robot',
        log_level='debug',
    )
    overrides = {'use_sim_time': True, 'frames.fixed': 'map', 'autostart': False}
    assert node.parameters == ['my.yaml', overrides]
    Config.from_mapping({k: v for k, v in overrides.items() if k != 'use_sim_time'})
    assert ('points', '/lidar/points') in node.remappings
    assert node.namespace == 'robot'
    assert node.ros_arguments == ['--log-level', 'surfel_mapper:=debug']


def test_rviz_is_started_with_the_view_where_it_is_asked_for(launch_file):
    _, rviz = started(launch_file, rviz='true', fixed_frame='map')
    assert (rviz.package, rviz.executable) == ('rviz2', 'rviz2')
    assert rviz.arguments == ['-d', str(FOLDER / 'mapper.rviz'), '-f', 'map']


@pytest.mark.parametrize('name', PRESETS)
def test_a_preset_is_offered_and_only_says_what_it_changes(launch_file, name):
    assert name in launch_file.PRESETS
    (node,) = started(launch_file, preset=name)
    assert node.parameters[0] == str(FOLDER / f'{name}.yaml')
    content = yaml.safe_load((FOLDER / f'{name}.yaml').read_text(encoding='utf-8'))
    stages = content['/**']['ros__parameters']
    config, default = load_config(FOLDER / f'{name}.yaml'), Config().to_mapping()
    changed = {k for k, v in config.to_mapping().items() if v != default[k]}
    named = {name for name, _ in flatten(stages)}
    assert changed <= named
    assert len(changed) > 4


def test_the_view_of_rviz_shows_topics_of_the_node():
    view = yaml.safe_load((FOLDER / 'mapper.rviz').read_text(encoding='utf-8'))
    displays = view['Visualization Manager']['Displays']
    topics = {display['Topic']['Value'] for display in displays if 'Topic' in display}
    assert topics <= OUTPUT_TOPICS | INPUT_TOPICS
    assert {'/surfel_mapper/markers', '/surfel_mapper/normals'} <= topics
    names = ('markers', 'normals', 'grid', 'planes', 'surfel_primitives')
    latched = {f'/surfel_mapper/{name}' for name in names}
    for display in displays:
        if 'Topic' in display:
            durability = display['Topic']['Durability Policy']
            assert (durability == 'Transient Local') == (display['Topic']['Value'] in latched)


def test_the_layout_of_foxglove_shows_topics_of_the_node():
    layout = json.loads((FOLDER / 'mapper.foxglove.json').read_text(encoding='utf-8'))
    assert set(layout['configById']['3D!surfels']['topics']) <= OUTPUT_TOPICS | INPUT_TOPICS
    placed = json.dumps(layout['layout'])
    assert all(panel in placed for panel in layout['configById'])
