# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The start of a node over DDS, without compiled kernels and with them."""

from __future__ import annotations

import os
from pathlib import Path
import re
import sys
import threading

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2

from surfel_mapper.errors import ConfigError
from surfel_mapper.ros.context import context
from surfel_mapper.ros.main import create_node, executing
from test.ros.driving import ARGUMENTS, drive, mapped, send
from test.ros.live import NODE
from test.test_threads import may_run_in_real_time

LONGEST_S = 3600.0

MANY = QoSProfile(depth=200, durability=DurabilityPolicy.VOLATILE)


@pytest.mark.timeout(LONGEST_S)  # compiling takes 20 s of a core that other programs use too
def test_a_node_without_compiled_kernels_says_what_it_compiles_and_drops_no_cloud(
    start_anew, peer, tmp_path, monkeypatch
):
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path))
    node = start_anew('node', *ARGUMENTS)
    reports = peer.subscribe(DiagnosticArray, '/diagnostics')
    peer.spin_until(lambda: node.check() or 'ready:' in node.output, LONGEST_S)
    changed = peer.collect(PointCloud2, f'{NODE}/changed', MANY)
    peer.advertise('/odom', '/points')
    messages = drive(6)
    send(peer, messages)
    peer.spin_until(lambda: len(changed) == 6)

    compiling = [status.message for report in reports for status in report.status]
    assert any(
        re.fullmatch(r'compiling kernels, once on this machine: \d of \d \(.+\)', text)
        for text in compiling
    )
    assert re.search(
        r'compiling kernels, once on this machine: 1 of \d \(adding scans\)', node.output
    )
    assert re.search(r'\d+ kernels compiled in [\d.]+ s', node.output)
    # none is compiled by a scan, beyond those that the node and `compile --config` announce
    assert not re.search(r'once on this machine$', node.output, re.MULTILINE)
    updates, _ = mapped(messages)
    assert [each.width for each in changed] == [len(update.changed) for update in updates]
    _, values = peer.diagnosis({'scans.mapped': 6})
    assert 'scans.dropped.overload' not in values


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


def test_a_log_directory_that_cannot_be_made_names_the_variable(monkeypatch):
    monkeypatch.setenv('HOME', '/proc/nowhere')
    monkeypatch.delenv('ROS_LOG_DIR', raising=False)
    refused = pytest.raises(
        ConfigError, match='Set ROS_LOG_DIR to a directory that can be written'
    )
    with refused, context(['--ros-args']):
        pass
