# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The files that repeat the settings agree with the code, as read by us and by ROS."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
from xml.etree import ElementTree

import pytest
import yaml

from surfel_mapper.cli.main import main
from surfel_mapper.config import Config, declarations, flatten, load_config
from test import settings

LAUNCH_CONFIGS = settings.DEFAULT_YAML.parent


def test_default_yaml_has_every_setting_at_its_default_and_nothing_else():
    content = yaml.safe_load(settings.DEFAULT_YAML.read_text(encoding='utf-8'))
    assert dict(flatten(content['/**']['ros__parameters'])) == {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in Config().to_mapping().items()
    }
    assert load_config(settings.DEFAULT_YAML) == Config()


def test_numbers_keep_their_type_in_default_yaml():
    content = yaml.safe_load(settings.DEFAULT_YAML.read_text(encoding='utf-8'))
    values = dict(flatten(content['/**']['ros__parameters']))
    faults = []
    for declared in declarations():
        expected = list if isinstance(declared.default, tuple) else type(declared.default)
        if type(values[declared.name]) is not expected:  # ROS would refuse 1 for 1.0
            faults.append(f'{declared.name}: {values[declared.name]!r}')
    assert faults == []


def test_default_yaml_and_the_page_are_as_make_settings_writes_them():
    assert settings.DEFAULT_YAML.read_text(encoding='utf-8') == settings.default_yaml()
    page = settings.PAGE.read_text(encoding='utf-8')
    assert page == settings.with_table(page)


def test_a_page_without_markers_is_refused():
    with pytest.raises(ValueError, match='markers'):
        settings.with_table('# Settings\n')


def test_ros_reads_default_yaml_as_we_do():
    pytest.importorskip('rclpy', reason='ROS 2 is not installed')
    code = (
        'import json, sys, rclpy\n'
        'from rcl_interfaces.msg import ParameterDescriptor\n'
        'rclpy.init(args=sys.argv)\n'
        'node = rclpy.create_node("surfel_mapper")\n'
        'as_given = ParameterDescriptor(dynamic_typing=True)\n'
        'names = json.loads(sys.argv[1])\n'
        'found = {name: node.declare_parameter(name, None, as_given).value for name in names}\n'
        'print(json.dumps(found))\n'
    )
    names = json.dumps([declared.name for declared in declarations()])
    done = subprocess.run(
        [sys.executable, '-c', code, names, '--ros-args', '--params-file', settings.DEFAULT_YAML],
        env={**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'},
        capture_output=True,
        text=True,
        check=True,
    )
    found = json.loads(done.stdout)
    # ROS has no type for an empty list: it takes the parameter as not set.
    expected = {
        name: (list(value) or None) if isinstance(value, tuple) else value
        for name, value in Config().to_mapping().items()
    }
    assert {name: (type(value), value) for name, value in found.items()} == {
        name: (type(value), value) for name, value in expected.items()
    }


def test_every_yaml_file_is_accepted():
    for path in LAUNCH_CONFIGS.glob('*.yaml'):
        load_config(path)  # an error names the file


def test_every_launch_file_compiles_and_offers_a_description():
    faults = []
    for path in LAUNCH_CONFIGS.glob('*.py'):
        tree = ast.parse(path.read_text(encoding='utf-8'), filename=str(path))
        functions = [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]
        if 'generate_launch_description' not in functions:
            faults.append(path.name)
    assert faults == []


def test_shared_memory_holds_a_large_cloud_several_times():
    root = ElementTree.parse(LAUNCH_CONFIGS / 'fastdds_shm.xml').getroot()
    found = [node.text for node in root.iter() if node.tag.endswith('}segment_size')]
    assert found == [str(64 * 2**20)]


def test_the_command_line_prints_the_table_of_the_page(capsys):
    assert main(['info', '--parameters']) == 0
    assert f'{settings.BEGIN}{capsys.readouterr().out}{settings.END}' in (
        settings.PAGE.read_text(encoding='utf-8')
    )


def test_the_page_about_the_node_names_existing_settings():
    page = (settings.ROOT / 'docs' / 'node.md').read_text(encoding='utf-8')
    names = {declared.name for declared in declarations()}
    stages = '|'.join(sorted({declared.stage for declared in declarations()} - {''}))
    named = set(re.findall(rf'`((?:{stages})\.\w+)', page))
    assert len(named) > 15
    assert named - names == set()


def test_every_setting_is_read_somewhere():
    paths = (settings.ROOT / 'surfel_mapper').rglob('*.py')
    code = ''.join(path.read_text('utf-8') for path in paths)
    names = {name.rpartition('.')[2] for name in Config().to_mapping()}
    assert [name for name in sorted(names) if not re.search(rf'\.{name}\b', code)] == []
