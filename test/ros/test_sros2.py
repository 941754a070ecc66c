# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy of the node, and a node that is told to enforce security."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from surfel_mapper.ros import bond
from surfel_mapper.ros.context import context
from surfel_mapper.ros.node import MapperNode
from surfel_mapper.ros.pose_inputs import STATIC_TOPIC, TREE_TOPIC
from test.ros.driving import ARGUMENTS
from test.ros.live import NODE

POLICY = Path(__file__).parents[2] / 'launch_configs' / 'sros2_policy.xml'

EVERYTHING = {
    'window.keep_points': 'true',
    'align.every_scans': 5,
    'layers.tsdf.enabled': 'true',
    'layers.models.enabled': 'true',
    'map.origin': 'auto',
    'publish.levels': 8,
    'use_sim_time': 'true',
}

CONFIGURATIONS = (
    EVERYTHING,
    {'pose.source': 'registration'},
    {'pose.source': 'auto'},
    {'input.kind': 'depth'},
)
"""Together these create all topics and services, but those of packages that PyPI lacks."""

OF_PACKAGES = {
    'publish': {f'/{bond.TOPIC}', TREE_TOPIC},
    'subscribe': {STATIC_TOPIC, TREE_TOPIC},
    'reply': set(),
}
"""Topics of the packages bond and tf2_msgs."""


def allowed(kind, how):
    """Return the full names that the policy allows."""
    found = ElementTree.parse(POLICY).iterfind(f'.//{kind}s[@{how}="ALLOW"]/{kind}')
    return {full(entry.text) for entry in found}


def full(name):
    return name.replace('~', NODE) if name.startswith('~') else f'/{name}'


@pytest.fixture(scope='module')
def used(domain):
    """Return the names that nodes of all configurations publish, subscribe and serve."""
    names = {how: set(of_packages) for how, of_packages in OF_PACKAGES.items()}
    for configuration in CONFIGURATIONS:
        pairs = [('-p', f'{name}:={value}') for name, value in configuration.items()]
        with context([*ARGUMENTS, *(item for pair in pairs for item in pair)]):
            node = MapperNode()
            node.start()
            for how, find in (
                ('publish', node.get_publisher_names_and_types_by_node),
                ('subscribe', node.get_subscriber_names_and_types_by_node),
                ('reply', node.get_service_names_and_types_by_node),
            ):
                names[how] |= {name for name, _ in find('surfel_mapper', '/')}
            node.end()
            node.destroy_node()
    return names


@pytest.mark.parametrize(
    ('kind', 'how'), [('topic', 'publish'), ('topic', 'subscribe'), ('service', 'reply')]
)
def test_the_policy_allows_exactly_the_topics_and_services_of_the_node(used, kind, how):
    assert used[how] == allowed(kind, how)


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
