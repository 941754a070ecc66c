# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy of the node, and a node that is told to enforce security."""

from __future__ import annotations

from pathlib import Path
import time
from xml.etree import ElementTree

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from rclpy.node import NodeNameNonExistentError

from test.ros.conftest import starting
from test.ros.driving import ARGUMENTS
from test.ros.live import NODE, Peer

POLICY = Path(__file__).parents[2] / 'launch_configs' / 'sros2_policy.xml'

EVERYTHING = [
    *('-p', 'window.keep_points:=true', '-p', 'align.every_scans:=5'),
    *('-p', 'layers.tsdf.enabled:=true', '-p', 'layers.models.enabled:=true'),
    *('-p', 'map.origin:=auto'),
]

SOURCES = {'pose', 'depth', 'camera_info', 'tf', 'tf_static', 'clock', 'initialpose'}
"""Subscriptions of other configurations than that of the test."""

OUTPUTS = {'tf', '~/odometry', '~/track', *(f'~/level_{n}/normals' for n in (1, 2, 3))}
"""Publishers of other configurations."""

NOT_SERVED = {'~/get_type_description'}
"""Services that not every version of rclpy has."""


def allowed(kind, how):
    """Return the full names that the policy allows."""
    found = ElementTree.parse(POLICY).iterfind(f'.//{kind}s[@{how}="ALLOW"]/{kind}')
    return {full(entry.text) for entry in found}


def full(name):
    return name.replace('~', NODE) if name.startswith('~') else f'/{name}'


def shown(find):
    """Return the names that the graph has for the node."""
    try:
        return {name for name, _ in find('surfel_mapper', '/')}
    except NodeNameNonExistentError:
        return set()


@pytest.mark.parametrize(
    ('find', 'policy', 'missing'),
    [
        ('get_publisher_names_and_types_by_node', ('topic', 'publish'), OUTPUTS),
        ('get_subscriber_names_and_types_by_node', ('topic', 'subscribe'), SOURCES),
        ('get_service_names_and_types_by_node', ('service', 'reply'), NOT_SERVED),
    ],
)
def test_the_policy_allows_exactly_the_topics_and_services_of_the_node(
    node, find, policy, missing
):
    needed = allowed(*policy) - {full(name) for name in missing}
    names = set()
    # A participant that lost a part of the graph may never get it; a new one asks anew.
    for _ in range(6):
        if not needed <= names:
            names = seen_anew(find, needed)
    assert needed <= names <= allowed(*policy)


@pytest.fixture(scope='module')
def node(prefork, tmp_path_factory):
    with starting(tmp_path_factory.mktemp('policy'), prefork) as start:
        running = start('node', *ARGUMENTS, *EVERYTHING)
        running.wait_for_output('ready:')
        yield running


def seen_anew(find, needed, wait_s=20.0):
    """Return the names that a new participant has for the node, soon or after some time."""
    peer, end_s = Peer(), time.monotonic() + wait_s
    try:
        while not needed <= (names := shown(getattr(peer.node, find))):
            if time.monotonic() > end_s:
                break
            peer.spin_for(0.05)
        return names
    finally:
        peer.close()


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
    """Start a node that has to refuse; return its output."""
    node = start('node', '--ros-args', '--enclave', '/surfel_mapper')
    assert node.wait() == 1, node.output
    assert 'Traceback' not in node.output
    assert 'ready:' not in node.output
    assert 'ROS_SECURITY_ENABLE is true' in node.output
    return node.output


def test_the_node_refuses_to_start_without_a_keystore(start, keystore, monkeypatch):
    monkeypatch.delenv('ROS_SECURITY_KEYSTORE')
    assert 'ROS_SECURITY_KEYSTORE (None)' in refused(start)


def test_the_node_refuses_to_start_without_its_enclave(start, keystore):
    assert 'enclaves/surfel_mapper' in refused(start)


def test_the_node_refuses_to_start_with_an_invalid_enclave(start, keystore):
    enclave = keystore / 'enclaves' / 'surfel_mapper'
    enclave.mkdir(parents=True)
    for name in ENCLAVE:
        (enclave / name).write_text('rubbish', encoding='ascii')
    assert 'ROS cannot make the node' in refused(start)
