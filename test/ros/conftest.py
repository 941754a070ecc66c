# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures: a ROS domain for this test run, nodes as processes in it, and a peer node."""

from __future__ import annotations

from contextlib import contextmanager
import fcntl
import itertools
import os
import socket

import pytest

COMPILING_S = 3600.0
"""Longest wait for all kernels to compile; a minute on an idle machine."""

LAYERS = {
    'pose.source': 'odometry',
    'deskew.enabled': True,
    'publish.levels': 1,
    'map.intensity': True,
    'window.keep_points': True,
    'layers.tsdf.enabled': True,
    'layers.models.enabled': True,
}
WITHOUT_POSES = {'pose.source': 'registration'}


@contextmanager
def domain_of_our_own():
    """Reserve a ROS domain that no other run of these tests uses, in a with-block."""
    for number in itertools.chain(range(os.getpid() % 100, 100), range(100)):
        with socket.socket(socket.AF_UNIX) as claim:
            try:
                claim.bind(f'\0surfel_mapper-tests-in-domain-{number + 1}')
            except OSError:  # taken; released when its process ends
                continue
            yield number + 1
            return


@pytest.fixture(scope='session')
def domain(tmp_path_factory):
    """Keep the ROS traffic of this test run on this machine and in its own domain."""
    pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')
    with domain_of_our_own() as number, pytest.MonkeyPatch.context() as patch:
        patch.setenv('ROS_DOMAIN_ID', str(number))
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        patch.setenv('ROS_LOG_DIR', str(tmp_path_factory.mktemp('ros_log')))
        yield


@pytest.fixture(scope='session')
def compiled(domain, tmp_path_factory):
    """Run nodes until all kernels are compiled, which takes longer than the tests wait."""
    from test.ros.live import Process

    folder = tmp_path_factory.mktemp('compiling')
    with compiling_alone(folder.parent.parent):
        compile_kernels(folder, Process)


@contextmanager
def compiling_alone(folder):
    """Let one process of a test run compile at a time; those after it find the kernels cached."""
    with open(folder / 'surfel_mapper_compiling.lock', 'w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # released when the file is closed
        yield


def compile_kernels(folder, Process):
    """Run a node with every layer, then one that registers, until they are ready."""
    for settings in (LAYERS, WITHOUT_POSES):
        given = (('-p', f'{name}:={str(value).lower()}') for name, value in settings.items())
        node = Process(['node', '--ros-args', *itertools.chain(*given)], folder)
        try:
            node.wait_for_output('ready:', COMPILING_S)
            assert node.stop() == 0, node.output
        finally:
            node.kill()


@pytest.fixture
def start(compiled, tmp_path):
    """Return a function that runs a verb as a process; all are killed after the test."""
    from test.ros.live import Process

    processes = []

    def run(*arguments):
        processes.append(Process(arguments, tmp_path))
        return processes[-1]

    yield run
    for process in processes:
        process.kill()
        print(process.output)  # pytest shows it if the test fails


@pytest.fixture
def peer(domain):
    """Return a node in the process of the test."""
    from test.ros.live import Peer

    peer = Peer()
    yield peer
    peer.close()
