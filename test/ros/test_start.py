# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The first start of a node over DDS: scans are mapped while kernels still compile."""

from __future__ import annotations

import os
from pathlib import Path
import sys
import threading

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from nav_msgs.msg import OccupancyGrid
from numba import njit
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2

from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.reduction import WarmUpSteps
from surfel_mapper.ros.context import context
from surfel_mapper.ros.main import create_node, executing
from surfel_mapper.ros.node import MapperNode
from test.ros.driving import ARGUMENTS, arguments, drive, mapped, send
from test.ros.live import LATCHED, NODE
from test.test_threads import may_run_in_real_time

MANY = QoSProfile(depth=200, durability=DurabilityPolicy.VOLATILE)


def rows_of(message):
    """Return the surfels of a message: normal and count by position."""
    scan = to_scan(message)
    columns = [scan.columns[f'normal_{axis}'] for axis in 'xyz'] + [scan.columns['num_points']]
    values = np.stack([column.astype(float) for column in columns], axis=1)
    return dict(zip(map(tuple, scan.points.tolist()), values.tolist(), strict=True))


def test_scans_are_mapped_before_surfels_can_be_derived(prefork, peer, monkeypatch):
    compiled = threading.Event()
    steps = WarmUpSteps([lambda: njit(lambda x: x + 1)(1)], [compiled.wait], [])
    monkeypatch.setattr(Mapper, 'warm_up_steps', lambda mapper: steps)
    changed = peer.subscribe(PointCloud2, f'{NODE}/changed', MANY)
    normals = peer.subscribe(PointCloud2, f'{NODE}/normals', LATCHED)
    grids = peer.subscribe(OccupancyGrid, f'{NODE}/grid', LATCHED)
    messages = drive(6)
    with context(arguments(**{'grid.rate_hz': 20.0})):
        node = MapperNode()
        with executing(node):
            node.start()
            peer.advertise('/odom', '/points')
            send(peer, messages)
            peer.diagnosis({'scans.mapped': 6})
            assert changed == normals == grids == []

            compiled.set()
            peer.spin_until(lambda: normals and changed and grids)
            node.end()
        node.destroy_node()
    _, twin = mapped(messages)
    position = twin.map.surfels(twin.config.map.min_points).position
    expected = {tuple(xyz) for xyz in position.astype(np.float32).tolist()}
    assert rows_of(normals[-1]) == rows_of(changed[0])
    assert set(rows_of(normals[-1])) == expected
    assert len(expected) > 100


def test_with_cached_kernels_the_first_scan_is_published(start, peer):
    start('node', *ARGUMENTS)
    changed = peer.collect(PointCloud2, f'{NODE}/changed', MANY)
    peer.advertise('/odom', '/points')
    messages = drive(2)
    send(peer, messages)
    peer.spin_until(lambda: len(changed) == 2)
    updates, _ = mapped(messages)
    assert [each.width for each in changed] == [len(update.changed) for update in updates]


def threads_of_fast_dds():
    """Return the threads of this process that Fast DDS has started, by their names."""
    tasks = Path('/proc/self/task').iterdir()
    return {int(task.name) for task in tasks if (task / 'comm').read_text().startswith('dds.')}


@pytest.mark.skipif(sys.platform != 'linux', reason='threads have no priority of their own')
def test_fast_dds_runs_in_real_time_if_permitted_and_the_mapper_does_not(prefork):
    before = threads_of_fast_dds()
    with context(ARGUMENTS[ARGUMENTS.index('--ros-args') :]):
        node = create_node()
        receiving = threads_of_fast_dds() - before
        with executing(node):
            node.start()
            ours = {thread.native_id for thread in threading.enumerate()}
            found = {os.sched_getscheduler(thread) for thread in receiving}
            of_the_mapper = {os.sched_getscheduler(thread) for thread in ours}
            node.end()
        node.destroy_node()
    assert found == {os.SCHED_RR if may_run_in_real_time() else os.SCHED_OTHER}
    assert of_the_mapper == {os.SCHED_OTHER}
