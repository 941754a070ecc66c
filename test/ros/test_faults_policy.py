# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy of the node allows what the node does, and nothing that it never does."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from test.ros.driving import ARGUMENTS
from test.ros.live import NODE

POLICY = Path(__file__).parents[2] / 'launch_configs' / 'sros2_policy.xml'

EVERYTHING = [
    *('-p', 'window.keep_points:=true', '-p', 'align.every_scans:=5'),
    *('-p', 'layers.tsdf.enabled:=true', '-p', 'layers.models.enabled:=true'),
]

SOURCES = {'pose', 'depth', 'camera_info', 'tf', 'tf_static', 'clock', 'initialpose'}
"""Read in other configurations than that of the test."""

OUTPUTS = {'tf', '~/odometry', '~/track', *(f'~/level_{n}/normals' for n in (1, 2, 3))}
"""Written in other configurations."""


def allowed(kind, how):
    """Return the full names that the policy allows."""
    found = ElementTree.parse(POLICY).iterfind(f'.//{kind}s[@{how}="ALLOW"]/{kind}')
    return {full(entry.text) for entry in found}


def full(name):
    return name.replace('~', NODE) if name.startswith('~') else f'/{name}'


def names(entries):
    return {name for name, _ in entries}


def test_the_policy_allows_what_the_node_does_and_no_more(start, peer):
    node = start('node', *ARGUMENTS, *EVERYTHING)
    node.wait_for_output('ready:')
    graph, here = peer.node, ('surfel_mapper', '/')
    peer.spin_until(lambda: graph.count_subscribers('/points'))
    peer.spin_for(0.5)
    published = names(graph.get_publisher_names_and_types_by_node(*here))
    subscribed = names(graph.get_subscriber_names_and_types_by_node(*here))
    served = names(graph.get_service_names_and_types_by_node(*here))
    assert published <= allowed('topic', 'publish')
    assert subscribed <= allowed('topic', 'subscribe')
    assert served <= allowed('service', 'reply')
    assert allowed('topic', 'publish') - published <= {full(name) for name in OUTPUTS}
    assert allowed('topic', 'subscribe') - subscribed <= {full(name) for name in SOURCES}
    assert allowed('service', 'reply') - served <= {full('~/get_type_description')}
