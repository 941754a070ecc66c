# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The node fed by ``play``, and the examples, reach the digest that ``replay`` reports."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
import yaml

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from surfel_mapper.cli.main import main
from surfel_mapper.config import load_config
from surfel_mapper.files.map_state import load_map
from test.ros.live import Peer, ROOT, TIMEOUT_S


def offered_settings(bag, capsys):
    """Return the settings that ``info`` suggests for the odometry of a bag."""
    assert main(['info', str(bag), '--json']) == 0
    poses = json.loads(capsys.readouterr().out)['poses']
    return next(o['settings'] for o in poses if o['settings']['pose.source'] == 'odometry')


def live_digest(start, bag, config, num_scans, rate):
    """Return the digest that the node logs at its end, after mapping the bag."""
    node = start('node', '--ros-args', '--params-file', config)
    waiting = ['--wait-for', '/points', '/odom', '--timeout', TIMEOUT_S]
    playing = start('play', bag, '--rate', rate, *waiting, '--json')
    assert playing.wait(2 * TIMEOUT_S) == 0, playing.output
    assert json.loads(playing.output.splitlines()[-1])['published']['/points'] == num_scans
    assert node.stop() == 0, node.output
    assert f'scans received {num_scans}, mapped {num_scans},' in node.output
    return node.output.rpartition('digest ')[2].split()[0]


def offline_summary(bag, config, output, capsys):
    arguments = ['--config', str(config), '--window', '--output', str(output), '--json']
    assert main(['replay', str(bag), *arguments]) == 0
    return json.loads(capsys.readouterr().out)


def compare(start, bag, tmp_path, capsys, num_scans, rate, **settings):
    offered = offered_settings(bag, capsys)
    config = tmp_path / 'settings.yaml'
    # more clouds than the bag has: a slow machine drops none
    settings['input.max_waiting_clouds'] = 100
    content = {'/**': {'ros__parameters': {**offered, **settings}}}
    config.write_text(yaml.safe_dump(content), encoding='utf-8')

    live = live_digest(start, bag, config, num_scans, rate)

    summary = offline_summary(bag, config, tmp_path / 'offline', capsys)
    assert live == summary['digest']
    assert sum(summary['scans']['evicted'].values()) > 5


def test_live_equals_offline_on_a_simulated_street(start, tmp_path, capsys):
    bag = tmp_path / 'street'
    lidar = ['--beams', '16', '--columns', '512', '--noise', '0.02']
    assert main(['simulate', 'street', '--output', str(bag), '--scans', '30', *lidar]) == 0
    capsys.readouterr()

    compare(start, bag, tmp_path, capsys, 30, 2, **{'window.max_distance_m': 8.0})


def test_live_equals_offline_on_a_real_bag(start, tmp_path, capsys, data_folder):
    bag = data_folder / 'data' / 'bags' / 'hall_os0_full'

    compare(start, bag, tmp_path, capsys, 22, 5, **{'window.max_scans': 9})


def test_the_demo_uses_the_settings_that_info_suggests(tmp_path, capsys):
    bag = tmp_path / 'street'
    lidar = ['--scans', '2', '--beams', '8', '--columns', '64']
    assert main(['simulate', 'street', '--output', str(bag), *lidar]) == 0
    capsys.readouterr()
    settings = load_config(ROOT / 'examples' / 'street.yaml').to_mapping()
    offered = offered_settings(bag, capsys)
    assert {name: settings[name] for name in offered} == {
        name: tuple(value) if isinstance(value, list) else value for name, value in offered.items()
    }


def test_the_mirror_example_has_the_digest_of_the_saved_map(start, tmp_path):
    bag = tmp_path / 'bag'
    lidar = ['--scans', '20', '--beams', '16', '--columns', '360']
    assert main(['simulate', 'street', '--output', str(bag), *lidar]) == 0
    settings = ['--params-file', ROOT / 'examples' / 'street.yaml', '-p', 'publish.moments:=true']
    node = start('node', '--ros-args', *settings, '-p', f'output.directory:={tmp_path}')
    node.wait_for_output('ready:')
    mirror = subprocess.Popen(
        [sys.executable, ROOT / 'examples' / 'mirror_map.py'],
        env={**os.environ, 'PYTHONPATH': str(ROOT)},
        stdout=subprocess.PIPE,
        text=True,
    )
    peer = Peer()
    try:
        playing = start('play', bag, '--wait-for', '/points', '/odom')
        assert playing.wait() == 0, playing.output
        answer = peer.call('save_map')
        assert answer.success, answer.message
        saved, _ = load_map(tmp_path / 'map.npz')
        said = ''
        while saved.digest() not in said:  # it prints once a second
            said = mirror.stdout.readline()
            assert said, 'the example has ended'
    finally:
        peer.close()
        mirror.terminate()
        mirror.wait(TIMEOUT_S)
    assert saved.num_points > 0
    assert 'good and level' in said
