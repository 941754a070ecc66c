# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A node with the defaults of Fast DDS, and publishers that use rclpy and its defaults only."""

from __future__ import annotations

from contextlib import contextmanager
import os
from pathlib import Path
import subprocess
import sys

import pytest

from surfel_mapper.ros.context import FASTDDS_VARIABLES, PROFILE
from test.ros.live import Process

NUMBER = 12
"""Messages of each size and kind of publisher, more than its queue holds."""

ATTEMPTS = 3
"""Best effort is for a machine with time to spare."""

DEFAULTS = ['--ros-args', '-p', 'pose.source:=identity', '-p', 'window.max_scans:=5']
DEFAULTS += ['-p', 'input.max_waiting_clouds:=1000', '-p', 'publish.diagnostics_rate_hz:=10.0']


@contextmanager
def node_on_defaults(folder, *arguments):
    """Run a node with Fast DDS' defaults in a with-block."""
    with pytest.MonkeyPatch.context() as patch:
        for name in FASTDDS_VARIABLES:
            patch.delenv(name, raising=False)
        node = Process(['node', *DEFAULTS, *arguments], folder)
        yield node
        node.kill()


def publish(peer, node, first_ns, reliability, *, profile, promised, sizes):
    """Run a publisher; return the number of messages received of each size."""
    env = {key: value for key, value in os.environ.items() if key not in FASTDDS_VARIABLES}
    if profile:
        env['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(PROFILE)
    command = [sys.executable, str(Path(__file__).with_name('plain_publisher.py'))]
    command += [reliability, str(NUMBER), str(first_ns)]
    received = {}
    peer.diagnosis({'state': 'active'})
    with subprocess.Popen(
        command, env=env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as publisher:
        for size in sizes:
            for _ in range(ATTEMPTS if size in promised else 1):
                received[size] = publish_size(peer, publisher, size, size in promised)
                if received[size] == NUMBER:
                    break
        publisher.stdin.close()
    node.check()
    return received


def publish_size(peer, publisher, size, is_promised):
    """Publish clouds of one size; return the number received."""
    before = int(peer.diagnosis()[1]['scans.received'])
    publisher.stdin.write(f'{size}\n')
    publisher.stdin.flush()
    assert publisher.stdout.readline().strip() == str(size)
    try:
        expected = {'scans.received': before + NUMBER}
        peer.diagnosis(expected, timeout_s=60.0 if is_promised else 1.0)
    except AssertionError:
        return int(peer.diagnosis()[1]['scans.received']) - before
    return NUMBER
