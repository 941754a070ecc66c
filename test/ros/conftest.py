# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A ROS domain of this test run's own, nodes in it as processes, and a peer to talk to them."""

from __future__ import annotations

import os

import pytest

COMPILING_S = 250.0
"""Half a minute where nothing else runs."""


@pytest.fixture(scope='session')
def domain(tmp_path_factory):
    """Keep all ROS traffic of this test run on this machine and apart from others'."""
    pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        patch.setenv('ROS_LOG_DIR', str(tmp_path_factory.mktemp('ros_log')))
        yield


@pytest.fixture(scope='session')
def compiled(domain, tmp_path_factory):
    """Run a node until its kernels are compiled, which takes longer than any test waits."""
    from test.ros.live import Process

    layers = ['-p', 'layers.models.enabled:=true']
    arguments = ['node', '--ros-args', '-p', 'pose.source:=identity', *layers]
    node = Process(arguments, tmp_path_factory.mktemp('compiling'))
    try:
        node.wait_for_output('ready:', COMPILING_S)
        assert node.stop() == 0, node.output
    finally:
        node.kill()


@pytest.fixture
def start(compiled, tmp_path):
    """Give a function that runs a verb as a process; all are ended after the test."""
    from test.ros.live import Process

    processes = []

    def run(*arguments):
        processes.append(Process(arguments, tmp_path))
        return processes[-1]

    yield run
    for process in processes:
        process.kill()


@pytest.fixture
def peer(domain):
    """Give a node of the test itself."""
    from test.ros.live import Peer

    peer = Peer()
    yield peer
    peer.close()
