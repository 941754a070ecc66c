# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Depth images are received as docs/inputs.md promises for clouds of their size."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from test.ros.live import START_NS
from test.ros.ordinary import node_on_defaults, NUMBER, publish

VGA = 2 * 640 * 480
"""Bytes of a depth image in mm."""


@pytest.fixture(scope='module')
def node(prefork, tmp_path_factory):
    """Run a node that reads depth images."""
    folder = tmp_path_factory.mktemp('depth')
    with node_on_defaults(folder, '-p', 'input.kind:=depth') as node:
        yield node


@pytest.mark.parametrize(('reliability', 'profile'), [('reliable', False), ('best_effort', True)])
def test_all_depth_images_of_promised_publishers_are_mapped(node, peer, reliability, profile):
    first_ns = START_NS + profile * 1000 * 10**9
    options = {'profile': profile, 'promised': [VGA], 'sizes': [VGA], 'kind': 'depth'}

    received = publish(peer, node, first_ns, reliability, **options)

    assert received == {VGA: NUMBER}, node.output[-3000:]
    _, values = peer.diagnosis()
    peer.diagnosis({'scans.mapped': values['scans.received']})
