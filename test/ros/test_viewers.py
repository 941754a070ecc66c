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

from geometry_msgs.msg import Point
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from surfel_mapper.ros import node_view
from surfel_mapper.viz.discs import DrawnDiscs
from surfel_mapper.viz.scene import Scene
from surfel_mapper.viz.server import free_port, LIVE
from test import extras
from test.ros.driving import arguments, drive, mapped, send
from test.ros.live import cloud, LATCHED, NODE, room, START_NS, TIMEOUT_S

NUM_SCANS = 6


@pytest.fixture(autouse=True)
def _rerun():
    extras.load('rerun.chunk')


def in_order(places):
    return places[np.lexsort(np.round(places, 4).T)]


def surfels_after(num_scans):
    """Return the positions of the surfels of a mapper without ROS, those with a normal."""
    _, mapper = mapped(drive(num_scans))
    return DrawnDiscs.of(mapper.map.surfels(mapper.config.map.min_points)).position


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


def test_a_node_serves_a_page_of_its_map(start, peer, tmp_path):
    port = free_port()
    settings = {'viewer.enabled': True, 'viewer.port': port, 'viewer.rate_hz': 100.0}
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
        expected = [surfels_after(number + 1) for number in range(NUM_SCANS)]
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


def test_messages_that_cannot_be_shown_are_left_out(start, peer, tmp_path):
    """Anyone can publish on the topics of a node; a view ended with a traceback."""
    file = tmp_path / 'view.rrd'
    view = start('view', '--live', '/other', '--rrd', file)
    topics = {f'/other/{name}': kind for name, kind in FOREIGN.items()}
    publishers = {
        topic: peer.node.create_publisher(kind, topic, LATCHED) for topic, kind in topics.items()
    }
    peer.spin_until(lambda: all(p.get_subscription_count() for p in publishers.values()))
    point = Point(x=1.0)
    odd = Marker(ns='odd\x1b[31m\n', type=Marker.TRIANGLE_LIST, points=[point] * 4)
    lines = Marker(ns='lines', type=Marker.LINE_LIST, points=[point] * 3)
    colours = Marker(type=Marker.TRIANGLE_LIST, points=[point] * 3, colors=[ColorRGBA()] * 2)
    for topic, message, reason in (
        ('/other/normals', PointCloud2(width=10, height=1), 'normals: a message is not shown'),
        ('/other/changed', PointCloud2(width=10, height=1), 'changed: a message is not shown'),
        ('/other/mesh', odd, '4 points and 0 colours'),
        ('/other/mesh', colours, '3 points and 2 colours'),
        ('/other/planes', MarkerArray(markers=[lines]), '3 points and 0 colours'),
    ):
        publishers[topic].publish(message)
        view.wait_for_output(reason)
        peer.spin_for(1.1)
        view.check()
    plain = cloud(START_NS, room(seed=1, num=100))
    publishers['/other/normals'].publish(plain)
    view.wait_for_output('no normal_x, normal_y, normal_z')
    publishers['/other/normals'].publish(plane_cloud(50, 3.0))
    peer.spin_for(3.0)
    assert view.stop() == 0, view.output
    assert '\x1b' not in view.output
    assert len(shown(file, '/map/surfels')) >= 1


@pytest.mark.parametrize(('least_s', 'expected'), [(0.0, [1.0, 2.0, 3.0]), (np.inf, [1.0, 3.0])])
def test_a_view_shows_maps_at_most_so_often_and_the_newest_at_its_end(
    peer, tmp_path, monkeypatch, least_s, expected
):
    monkeypatch.setattr(node_view, 'MAP_S', least_s)
    file = tmp_path / 'shown.rrd'
    with Scene.to_file(file) as scene:
        view = node_view.NodeView(peer.node, '/other', scene, 'normal')
        for height in (1.0, 2.0, 3.0):
            view.show_normals(plane_cloud(40, height))
        view.finish()
        view.finish()
    heights = [float(found[0, 2]) for found in shown(file, '/map/surfels')]
    assert heights == expected


def plane_cloud(num, height):
    """Return a cloud of a level plane with normals."""
    names = ('x', 'y', 'z', 'normal_x', 'normal_y', 'normal_z')
    fields = [PointField(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate(names)]
    table = np.tile(np.float32([0.0, 0.0, height, 0.0, 0.0, 1.0]), (num, 1))
    table[:, 0] = np.arange(num)
    header = cloud(START_NS, room(seed=1, num=1)).header
    return PointCloud2(
        header=header,
        height=1,
        width=num,
        fields=fields,
        point_step=24,
        row_step=24 * num,
        data=table.tobytes(),
    )


FOREIGN = {'normals': PointCloud2, 'changed': PointCloud2, 'mesh': Marker, 'planes': MarkerArray}


def test_a_node_that_is_not_there_is_named_with_those_that_are(start, peer, tmp_path):
    start('node', *arguments())
    peer.spin_until(lambda: peer.node.count_publishers(f'{NODE}/normals') == 1)
    view = start('view', '--live', '/mapper', '--rrd', str(tmp_path / 'a.rrd'))
    view.wait_for_output('/mapper/normals: nothing publishes it')
    assert f'nodes that publish such a map: {NODE}' in view.output
    assert view.stop() == 0
