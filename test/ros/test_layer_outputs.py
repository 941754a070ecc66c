# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A layer of another package in a node: its settings are parameters, its topic is published."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from std_msgs.msg import Int64

from test.layers.test_extending import install, POINTS
from test.ros.live import cloud, LATCHED, odometry, START_NS
from test.ros.test_outputs import BASE, start_node


def test_a_layer_from_outside_is_published(start, peer, tmp_path):
    install(tmp_path)  # the folder in which the node runs, and so on its path
    node = start_node(start, peer, **{'layers.heights.enabled': 'true'})
    numbers = peer.collect(Int64, f'{BASE}/num_columns', LATCHED)
    peer.publish('/odom', odometry(START_NS, (0.0, 0.0, 0.0)))
    peer.publish('/points', cloud(START_NS, POINTS))
    peer.spin_until(lambda: numbers and numbers[-1].data == 2)
    node.check()
