# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A live node in the viewer: by its own page, and by its topics."""

from __future__ import annotations

from contextlib import contextmanager, suppress
from importlib.util import find_spec
import os
from pathlib import Path
import subprocess
import time
import urllib.request

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from sensor_msgs.msg import PointCloud2

from surfel_mapper.viz.discs import DrawnDiscs
from surfel_mapper.viz.server import LIVE
from test import extras
from test.ports import reserved_pair
from test.ros.driving import arguments, drive, mapped, send
from test.ros.live import LATCHED, NODE, TIMEOUT_S

NUM_SCANS = 6


@pytest.fixture(autouse=True)
def _rerun():
    extras.load('rerun.chunk')


def in_order(places):
    return places[np.lexsort(np.round(places, 4).T)]


def surfels_after(num_scans, *, adaptive=False):
    """Return the positions of the surfels of a mapper without ROS, those with a normal."""
    _, mapper = mapped(drive(num_scans))
    surfels = mapper.map.adaptive if adaptive else mapper.map.surfels
    return DrawnDiscs.of(surfels(mapper.config.map.min_points)).position


@contextmanager
def recorded(port, file):
    """Record what a page shows, as a second viewer of it."""
    source = f'rerun+http://127.0.0.1:{port}/proxy'
    program = Path(find_spec('rerun_cli').origin).with_name('rerun')
    with subprocess.Popen(
        [program, source, '--save', str(file)], stderr=subprocess.DEVNULL
    ) as recorder:
        try:
            yield
        finally:
            recorder.terminate()


def shown(file, path):
    """Return the rows of positions that a path has had."""
    from rerun import chunk as reader

    rows = []
    for chunk in reader.RrdReader(str(file)).stream().to_chunks():
        batch = chunk.to_record_batch()
        if chunk.entity_path == path and 'Points3D:positions' in batch.schema.names:
            found = batch.column('Points3D:positions').to_pylist()
            rows += [np.array(row) for row in found if row]
    return rows


def command_lines():
    """Return the words of the command lines of all processes."""
    found = []
    for path in Path('/proc').glob('[0-9]*/cmdline'):
        with suppress(OSError):  # it has ended
            found.append(path.read_text().split('\0'))
    return found


@pytest.fixture
def port():
    """Return the port of a page, of which the next one is that of its data."""
    with reserved_pair() as first:
        yield first


def test_a_node_serves_a_page_of_its_map(start, peer, tmp_path, port):
    settings = {'viewer.enabled': True, 'viewer.port': port}
    node = start('node', *arguments(**settings))
    node.wait_for_output(f'the map is shown at http://127.0.0.1:{port}/')
    changed = peer.collect(PointCloud2, f'{NODE}/changed')
    with urllib.request.urlopen(f'http://127.0.0.1:{port}/', timeout=TIMEOUT_S) as page:
        assert page.status == 200
    file = tmp_path / 'shown.rrd'
    with recorded(port + 1, file):
        peer.advertise('/odom', '/points')
        send(peer, drive(NUM_SCANS))
        peer.spin_until(lambda: len(changed) == NUM_SCANS)
        expected = [surfels_after(number + 1, adaptive=True) for number in range(NUM_SCANS)]
        deadline = time.monotonic() + TIMEOUT_S
        while os.path.getsize(file) < 40 * len(expected[0]):  # a map: 12 bytes for a position
            assert time.monotonic() < deadline
            node.check()
            peer.spin_for(0.1)
    commands = [words for words in command_lines() if str(port) in words]
    assert commands
    assert all(words[words.index('--server-memory-limit') + 1] == LIVE for words in commands)
    node.stop()

    maps = shown(file, '/map/surfels')
    assert maps
    for found in maps:
        same = [each for each in expected if len(each) == len(found)]
        assert any(np.allclose(in_order(found), in_order(each), atol=1e-4) for each in same)


def test_a_node_is_viewed_by_its_topics(start, peer, tmp_path):
    node = start('node', *arguments())
    normals = peer.collect(PointCloud2, f'{NODE}/normals', LATCHED)
    changed = peer.collect(PointCloud2, f'{NODE}/changed')
    peer.advertise('/odom', '/points')
    send(peer, drive(NUM_SCANS))
    peer.spin_until(lambda: len(changed) == NUM_SCANS)
    expected = surfels_after(NUM_SCANS)
    peer.spin_until(lambda: normals[-1].width == len(expected))

    folder = tmp_path / 'view'  # the file has another name until it is whole
    folder.mkdir()
    file = folder / 'shown.rrd'
    view = start('view', '--live', '--rrd', str(file))
    deadline = time.monotonic() + TIMEOUT_S
    while not any(part.stat().st_size > 40 * len(expected) for part in folder.iterdir()):
        view.check()
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert view.stop() == 0
    node.stop()

    found = shown(file, '/map/surfels')[-1]
    np.testing.assert_allclose(in_order(found), in_order(expected), atol=1e-4)


def test_a_node_that_is_not_there_is_named_with_those_that_are(start, peer, tmp_path):
    start('node', *arguments())
    peer.spin_until(lambda: peer.node.count_publishers(f'{NODE}/normals') == 1)
    view = start('view', '--live', '/mapper', '--rrd', str(tmp_path / 'a.rrd'))
    view.wait_for_output('/mapper/normals: nothing publishes it')
    assert f'nodes that publish such a map: {NODE}' in view.output
    assert view.stop() == 0
