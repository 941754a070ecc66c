# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures: a ROS domain for this test run, nodes as processes in it, and a peer node."""

from __future__ import annotations

from contextlib import contextmanager
import fcntl
import os
import sys

import pytest

from test.ros.domain import domain_of_our_own
from test.ros.prefork import load, Prefork


@pytest.fixture(scope='session')
def domain(tmp_path_factory):
    """Keep the ROS traffic of this test run on this machine and in its own domain."""
    pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')
    with domain_of_our_own(), pytest.MonkeyPatch.context() as patch:
        patch.setenv('ROS_LOG_DIR', str(tmp_path_factory.mktemp('ros_log')))
        yield


@pytest.fixture(scope='session')
def prefork(domain, tmp_path_factory):
    """Compile all kernels, then return the process of which verbs are forked, if it can."""
    own = tmp_path_factory.getbasetemp()  # of pytest-xdist one in a folder for each process
    with compiling_alone(own.parent if 'PYTEST_XDIST_WORKER' in os.environ else own):
        forking = Prefork() if sys.platform == 'linux' else load()
    yield forking
    if forking is not None:
        forking.close()


@contextmanager
def compiling_alone(folder):
    """Let one process of a test run compile at a time; those after it find the kernels cached."""
    with open(folder / 'surfel_mapper_compiling.lock', 'w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # released when the file is closed
        yield


@contextmanager
def starting(folder, prefork):
    """Return a function that runs a verb as a process; all are killed after the with-block."""
    from test.ros.live import Process

    processes = []

    def run(*arguments):
        processes.append(Process(arguments, folder, prefork))
        return processes[-1]

    yield run
    for process in processes:
        process.kill()
        print(process.output)  # pytest shows it if the test fails


@pytest.fixture
def start(prefork, tmp_path):
    """Return a function that forks a verb; see prefork.py."""
    with starting(tmp_path, prefork) as run:
        yield run


@pytest.fixture
def start_anew(prefork, tmp_path):
    """Return a function that runs a verb in a Python of its own, which searches for layers."""
    with starting(tmp_path, None) as run:
        yield run


@pytest.fixture
def peer(domain):
    """Return a node in the process of the test."""
    from test.ros.live import Peer

    peer = Peer()
    yield peer
    peer.close()


@pytest.fixture
def guarded_peer(domain):
    """Return a node in the process of the test whose callbacks are guarded as those of ours."""
    from surfel_mapper.ros.base_node import BaseNode
    from test.ros.live import Peer

    peer = Peer(node_type=BaseNode)
    yield peer
    peer.close()
