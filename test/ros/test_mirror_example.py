# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""examples/mirror_map.py beside a running node: its copy has the digest that the node states."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from surfel_mapper.cli.main import main
from surfel_mapper.files.map_state import load_map
from test.ros.live import Peer, ROOT, TIMEOUT_S

EXAMPLES = ROOT / 'examples'


def test_the_mirror_of_a_node_has_the_digest_of_the_map_that_the_node_saves(start, tmp_path):
    bag = tmp_path / 'bag'
    lidar = ['--scans', '20', '--beams', '16', '--columns', '360']
    assert main(['simulate', 'street', '--output', str(bag), *lidar]) == 0
    settings = ['--params-file', EXAMPLES / 'street.yaml', '-p', 'publish.moments:=true']
    node = start('node', '--ros-args', *settings, '-p', f'output.directory:={tmp_path}')
    node.wait_for_output('ready:')
    mirror = subprocess.Popen(
        [sys.executable, EXAMPLES / 'mirror_map.py'],
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
        while saved.digest() not in said:  # it prints once a second what has changed
            said = mirror.stdout.readline()
            assert said, 'it has ended'
    finally:
        peer.close()
        mirror.terminate()
        mirror.wait(TIMEOUT_S)
    assert saved.num_points > 0
    assert 'flat and level' in said
