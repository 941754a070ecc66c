# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings for rerun hold all entities and pass the verification of rerun."""

from importlib.util import find_spec
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys

import numpy as np
import pytest

from surfel_mapper.cli.main import main
from surfel_mapper.config import Config
from surfel_mapper.errors import FileFormatError, SurfelMapperError
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan
from surfel_mapper.viz import scene
from surfel_mapper.viz.server import LIVE, started_server
from surfel_mapper.viz.viewer import Viewer
from test import extras
from test.bags.recorded import drive, write_rosbag2
from test.layers.test_distance_field import insert, mapper_with
from test.ports import reserved_pair

pytestmark = extras.needs('rerun')

PROGRAM = find_spec('rerun') and Path(find_spec('rerun_cli').origin).with_name('rerun')
"""The program itself: `python -m rerun` takes .6 s to start it."""

ENTITIES = ('/map/surfels', '/map/changed', '/map/trajectory', '/map/window', '/map/sensor/scan')


def rerun(*arguments):
    return subprocess.run([PROGRAM, 'rrd', *map(str, arguments)], capture_output=True, text=True)


def test_a_replay_is_recorded_with_scans_surfels_trajectory_and_window(tmp_path):
    bag = write_rosbag2(tmp_path / 'drive', drive())
    file = tmp_path / 'drive.rrd'

    arguments = ['replay', str(bag), '--output', str(tmp_path / 'out'), '--rrd', str(file)]
    assert main(arguments) == 0

    done = rerun('verify', file)
    assert done.returncode == 0, done.stderr
    printed = rerun('print', file).stdout
    for entity in ENTITIES:
        assert entity in printed


def test_a_file_that_cannot_be_written_is_an_error(tmp_path):
    with pytest.raises(FileFormatError, match='nowhere'):
        Viewer(Mapper(), tmp_path / 'nowhere' / 'a.rrd')


def test_the_mesh_of_a_tsdf_is_recorded(tmp_path):
    mapper = mapper_with()
    with Viewer(mapper, tmp_path / 'a.rrd') as viewer:
        for update in insert(mapper, 1):
            viewer.add(update)
    assert '/map/mesh' in rerun('print', tmp_path / 'a.rrd').stdout


def test_the_origin_of_the_map_is_recorded(tmp_path):
    origin_m = [400_000.25, 5_400_000.0, 250.0]
    settings = {'pose.source': 'identity', 'map.origin': ' '.join(map(str, origin_m))}
    mapper = Mapper(Config.from_mapping(settings))
    points = np.random.default_rng(1).uniform(0.0, 5.0, (50, 3)) + origin_m
    mapper.add_scan(Scan(points=points, stamp_ns=10**9, frame_id='odom'))
    with Viewer(mapper, tmp_path / 'a.rrd') as viewer:
        for update in mapper.insert_ready():
            viewer.add(update)

    printed = rerun('print', '-vvv', tmp_path / 'a.rrd').stdout

    assert 'origin_m' in printed
    for value in origin_m:
        assert f'{value:.12g}' in printed


WINDOW = """#!/bin/sh
echo $$ > '{pid}'
exec '{rerun}' --serve-grpc "$@"
"""
"""A rerun without a window: this machine may have no display."""


@pytest.mark.parametrize('taken', [0, 1])
@pytest.mark.parametrize('address', ['127.0.0.1', '0.0.0.0'])
def test_a_port_on_which_another_program_listens_is_refused(address, taken):
    with (
        reserved_pair(address) as port,
        socket.create_server((address, port + taken)),
        pytest.raises(SurfelMapperError, match=f':{port + taken} .* is the port free'),
    ):
        started_server(port, port + 1, LIVE)


@pytest.mark.skipif(not Path('/proc/net/tcp').exists(), reason='sockets are not shown')
def test_the_window_listens_on_loopback_only(tmp_path, monkeypatch):
    window, pid = tmp_path / 'rerun', tmp_path / 'pid'
    window.write_text(WINDOW.format(pid=pid, rerun=PROGRAM))
    window.chmod(0o755)
    monkeypatch.setenv('PATH', f'{tmp_path}{os.pathsep}{os.environ["PATH"]}')

    with reserved_pair() as port:
        monkeypatch.setattr(scene, 'PORT', port)
        with Viewer(Mapper()):
            listening = addresses(port)
        os.kill(int(pid.read_text()), signal.SIGTERM)

    assert listening == {'127.0.0.1'}


def addresses(port):
    """Return the addresses at which a port is listened on, for IPv4 and IPv6."""
    found = set()
    for name in ('tcp', 'tcp6'):
        for line in Path('/proc/net', name).read_text().splitlines()[1:]:
            _, local, _, state, *_ = line.split()
            address, _, hexadecimal = local.partition(':')
            if state == '0A' and int(hexadecimal, 16) == port:
                ipv4 = bytes.fromhex(address)[::-1] if name == 'tcp' else None
                found.add('::' if ipv4 is None else socket.inet_ntoa(ipv4))
    return found


FULL = """
import resource, sys
sys.dont_write_bytecode = True  # it would be cut
from surfel_mapper.cli.main import main
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.skipif(sys.platform != 'linux', reason='limits the size of files')
def test_a_recording_for_which_there_is_no_room_is_a_sentence(tmp_path):
    """It was a traceback."""
    surfel_map = SurfelMap(0.5)
    surfel_map.add(np.random.default_rng(0).uniform(-20.0, 20.0, (30_000, 3)))
    surfel_map.save(tmp_path / 'map.npz')
    arguments = ['view', tmp_path / 'map.npz', '--rrd', tmp_path / 'map.rrd']
    done = subprocess.run(
        [sys.executable, '-c', FULL, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert 'map.rrd: cannot be written: ' in done.stderr
    assert 'Traceback' not in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ['map.npz']
