# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The long drive through the node, cut short: nothing is lost, the map is exact in the end."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from test.bench.options import Options
from test.soak import node


def test_every_scan_of_the_long_drive_is_mapped_by_the_node(compiled, tmp_path):
    options = Options(scans=5, beams=8, columns=64, cache=tmp_path)
    rows = list(node.run(250, 100, options))  # the window is full, and scans have left it
    assert [row['scans'] for row in rows] == [100, 200, 250]
    assert all(row['lost'] == 0 for row in rows)
