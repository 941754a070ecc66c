# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A live node in the viewer, by its topics."""

from __future__ import annotations

import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from sensor_msgs.msg import PointCloud2

from surfel_mapper.viz.discs import DrawnDiscs
from test import extras
from test.ros.driving import arguments, drive, mapped, send
from test.ros.live import LATCHED, NODE, TIMEOUT_S

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
