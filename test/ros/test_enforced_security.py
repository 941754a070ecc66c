# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A node that is told to enforce security does not start without it.

Whatever is missing: the keystore, the enclave of the node, certificates that are some, or
a middleware that is built with security.
"""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

ENCLAVE = (
    'identity_ca.cert.pem',
    'cert.pem',
    'key.pem',
    'permissions_ca.cert.pem',
    'governance.p7s',
    'permissions.p7s',
)


@pytest.fixture
def keystore(tmp_path, monkeypatch):
    keystore = tmp_path / 'keys'
    monkeypatch.setenv('ROS_SECURITY_ENABLE', 'true')
    monkeypatch.setenv('ROS_SECURITY_STRATEGY', 'Enforce')
    monkeypatch.setenv('ROS_SECURITY_KEYSTORE', str(keystore))
    return keystore


def refused(start):
    """Start a node; return what it says when it refuses to."""
    node = start('node', '--ros-args', '--enclave', '/surfel_mapper')
    assert node.wait() == 1, node.output
    assert 'Traceback' not in node.output
    assert 'ready:' not in node.output
    assert 'ROS_SECURITY_ENABLE is true' in node.output
    return node.output


def test_without_a_keystore_the_node_refuses_to_start(start, keystore, monkeypatch):
    monkeypatch.delenv('ROS_SECURITY_KEYSTORE')
    assert 'ROS_SECURITY_KEYSTORE (None)' in refused(start)


def test_without_its_enclave_the_node_refuses_to_start(start, keystore):
    assert 'enclaves/surfel_mapper' in refused(start)


def test_with_an_enclave_of_rubbish_the_node_refuses_to_start(start, keystore):
    enclave = keystore / 'enclaves' / 'surfel_mapper'
    enclave.mkdir(parents=True)
    for name in ENCLAVE:
        (enclave / name).write_text('rubbish', encoding='ascii')
    assert 'ROS cannot make the node' in refused(start)
