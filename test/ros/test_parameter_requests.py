# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Requests that set parameters: one change of the configuration, with a result for each."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter

from surfel_mapper.ros.context import context
from surfel_mapper.ros.main import executing
from surfel_mapper.ros.node import MapperNode
from test.ros.driving import ARGUMENTS


@pytest.fixture
def node(domain):
    """Return a node that is not configured, and whose executor runs in this process."""
    with context(ARGUMENTS):
        node = MapperNode()
        with executing(node):
            yield node
        node.destroy_node()


def change(peer, pairs):
    """Set parameters in one request; return the reason of each refusal, None without one."""
    asked = [Parameter(name, value=value) for name, value in pairs]
    results = peer.result(peer.parameters().set_parameters(asked)).results
    return [None if result.successful else result.reason for result in results]


def values(node, *names):
    return [node.get_parameter(name).value for name in names]


def test_five_hundred_parameters_are_one_change(node, peer):
    events = peer.subscribe(ParameterEvent, '/parameter_events')
    peer.meet()
    names = 'clear.radius_m', 'window.max_scans'
    pairs = [(names[n % 2], n) for n in range(500)]

    assert change(peer, pairs) == [None] * 500

    peer.spin_until(lambda: any(event.changed_parameters for event in events))
    ((first, second),) = [event.changed_parameters for event in events if event.changed_parameters]
    assert {first.name: first.value.double_value, second.name: second.value.integer_value} == {
        'clear.radius_m': 498.0,
        'window.max_scans': 499,
    }
    assert values(node, 'window.max_scans', 'clear.radius_m') == [499, 498.0]


def test_each_refusal_has_its_reason_and_the_others_are_set(node, peer):
    reasons = change(
        peer,
        [
            ('window.max_scans', 7),
            ('window.max_scan', 3),
            ('map.min_points', 9.5),
            ('map.voxel_size_m', 0.1),
            ('clear.radius_m', -1.0),
            ('clear.box', [1.0, 2.0]),
            ('clear.box', [3.0, 2.0]),
            ('filters', '/nowhere/chain.yaml'),
            ('publish.normals_rate_hz', 3),
        ],
    )

    assert [reason is None for reason in reasons] == [True, *[False] * 7, True]
    for reason, text in zip(
        reasons[1:8],
        (
            'no such setting; did you mean window.max_scans?',
            'map.min_points',
            'read-only',
            'clear.radius_m: -1, expected',
            'clear.box: 2 values',
            'clear.box: 2 values',
            'give the directory of chains at the start',
        ),
        strict=True,
    ):
        assert text in reason
    assert values(node, 'window.max_scans', 'publish.normals_rate_hz') == [7, 3.0]


def test_a_condition_on_several_settings_refuses_one_of_them(node, peer):
    (none, reason) = change(peer, [('window.max_scans', 8), ('align.every_scans', 1)])
    assert none is None
    assert 'window.keep_points is false' in reason
    assert values(node, 'window.max_scans', 'align.every_scans') == [8, 0]


def test_whole_numbers_are_taken_for_a_list_of_floats(node, peer):
    assert change(peer, [('clear.box', [-1, -1, -2, 2, 1, 1])]) == [None]
    (box,) = values(node, 'clear.box')
    assert [*box] == [-1.0, -1.0, -2.0, 2.0, 1.0, 1.0]
    assert isinstance(box[0], float)
