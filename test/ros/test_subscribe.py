# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The example that subscribes to the surfels of a running node, and the arrays that it gets."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from sensor_msgs.msg import PointCloud2

from surfel_mapper import Surfels
from test.ros.driving import ARGUMENTS, drive, mapped, send
from test.ros.live import LATCHED, NODE, ROOT


def test_a_late_subscriber_has_the_surfels_of_the_map(start, peer):
    start('node', *ARGUMENTS)
    peer.advertise('/odom', '/points')
    messages = drive(3)
    send(peer, messages)
    peer.diagnosis({'scans.mapped': 3})
    _, mapper = mapped(messages)
    expected = mapper.surfels()

    received = peer.collect(PointCloud2, f'{NODE}/normals', LATCHED)
    peer.spin_until(lambda: received and received[-1].width == len(expected))
    surfels = Surfels.from_message(received[-1])
    rows, others = (np.lexsort(s.position.astype(np.float32).T) for s in (surfels, expected))
    for name in ('position', 'normal', 'planarity', 'num_points'):
        values = getattr(expected, name)[others].astype(np.float32)
        np.testing.assert_array_equal(getattr(surfels, name)[rows], values)

    example = [sys.executable, ROOT / 'examples' / 'subscribe.py']
    environment = {**os.environ, 'PYTHONPATH': str(ROOT)}
    with subprocess.Popen(example, stdout=subprocess.PIPE, env=environment, text=True) as process:
        try:
            line = process.stdout.readline()
        finally:
            process.kill()
    assert line.startswith(f'{len(expected)} surfels, ')
