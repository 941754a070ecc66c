# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A layer of another package in a node: its settings are parameters, its topic is published."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from nav_msgs.msg import OccupancyGrid
from std_msgs.msg import Int64

from surfel_mapper.files.map_state import load_map, save_map
from test.layers.test_extending import install, POINTS
from test.ros.driving import drive, mapped, PERIOD_NS
from test.ros.live import cloud, LATCHED, odometry, START_NS
from test.ros.test_outputs import BASE, stamp_of, start_node


def test_a_layer_from_outside_is_published(start_anew, peer, tmp_path):
    install(tmp_path)  # the folder in which the node runs, and so on its path
    node = start_node(start_anew, peer, **{'layers.heights.enabled': 'true'})
    numbers = peer.collect(Int64, f'{BASE}/num_columns', LATCHED)
    peer.publish('/odom', odometry(START_NS, (0.0, 0.0, 0.0)))
    peer.publish('/points', cloud(START_NS, POINTS))
    peer.spin_until(lambda: numbers and numbers[-1].data == 2)
    node.check()


def test_the_grid_of_a_frozen_map_follows_the_sensor(start, peer, tmp_path):
    save_map(tmp_path / 'room.npz', mapped(drive(3))[1].map)
    settings = {'map.mode': 'frozen', 'map.load': 'room.npz', 'grid.size_m': 8.0}
    node = start_node(start, peer, **settings, **{'grid.rate_hz': 20.0})
    grids = peer.collect(OccupancyGrid, f'{BASE}/grid', LATCHED)

    def origins():
        places = [grid.info.origin.position for grid in grids]
        return [(place.x, place.y) for place in places]

    peer.spin_until(lambda: grids, what=lambda: node.output)
    assert origins()[-1] == (-4.0, -4.0)  # before any scan, about the origin of the map
    # the sensor is 0.1 m ahead: in the cells of 0.5 m from 1.0, 3.0 and 10.0 m
    for number, (x, expected) in enumerate([(1.2, -3.0), (3.0, -1.0), (10.2, 6.0)]):
        stamp_ns = START_NS + number * PERIOD_NS
        peer.publish('/odom', odometry(stamp_ns, (x, 0.0, 0.0)))
        peer.publish('/points', cloud(stamp_ns, POINTS))
        num_grids = len(grids)
        peer.spin_until(lambda known=num_grids: len(grids) > known, what=lambda: node.output)
        assert origins()[-1] == (expected, -4.0)
        assert stamp_of(grids[-1]) == stamp_ns


def test_a_node_that_cannot_go_on_saves_its_map(start_anew, peer, tmp_path):
    install(tmp_path)
    module = tmp_path / 'heights.py'
    code = module.read_text('utf-8')
    broken = "if len(self.lowest): raise SystemExit('broken')\n        T, size_m ="
    module.write_text(code.replace('T, size_m =', broken), encoding='utf-8')
    node = start_node(start_anew, peer, **{'layers.heights.enabled': 'true'})
    for stamp_ns in (START_NS, START_NS + PERIOD_NS):
        peer.publish('/odom', odometry(stamp_ns, (0.0, 0.0, 0.0)))
        peer.publish('/points', cloud(stamp_ns, POINTS))
    assert node.wait() != 0
    (saved,) = tmp_path.rglob('*.checkpoint.npz')
    assert str(saved) in node.output
    assert load_map(saved)[0].num_voxels == 3
