# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A short run of the long drive through the node; a file of its own as it starts a node."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from test.bench.options import Options
from test.soak import node


def test_the_node_maps_every_scan_of_a_long_drive(prefork, tmp_path):
    options = Options(scans=5, beams=8, columns=64, cache=tmp_path)
    rows = list(node.run(250, 100, options))  # the window is full, and scans have left it
    assert [row['scans'] for row in rows] == [100, 200, 250]
    assert all(row['lost'] == 0 for row in rows)
