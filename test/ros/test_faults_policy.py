# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy of the node allows what the node does, and nothing that it never does."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from rclpy.node import NodeNameNonExistentError

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

NOT_SERVED = {'~/get_type_description'}
"""By every version of rclpy."""


def allowed(kind, how):
    """Return the full names that the policy allows."""
    found = ElementTree.parse(POLICY).iterfind(f'.//{kind}s[@{how}="ALLOW"]/{kind}')
    return {full(entry.text) for entry in found}


def full(name):
    return name.replace('~', NODE) if name.startswith('~') else f'/{name}'


def shown(find):
    """Return the names that the graph shows of the node by now."""
    try:
        return {name for name, _ in find('surfel_mapper', '/')}
    except NodeNameNonExistentError:
        return set()


def test_the_policy_allows_what_the_node_does_and_no_more(start, peer):
    node = start('node', *ARGUMENTS, *EVERYTHING)
    node.wait_for_output('ready:')
    graph = peer.node
    for find, policy, missing in (
        (graph.get_publisher_names_and_types_by_node, ('topic', 'publish'), OUTPUTS),
        (graph.get_subscriber_names_and_types_by_node, ('topic', 'subscribe'), SOURCES),
        (graph.get_service_names_and_types_by_node, ('service', 'reply'), NOT_SERVED),
    ):
        needed = allowed(*policy) - {full(name) for name in missing}
        peer.spin_until(lambda f=find, n=needed: n <= shown(f))
        assert shown(find) <= allowed(*policy)
