# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Heartbeats for Nav2's lifecycle manager; a file of its own as it needs the package ``bond``."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')
pytest.importorskip('bond.msg', reason='bond is not installed: apt has it, PyPI does not')

from bond.msg import Status
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState

from test.ros.driving import ARGUMENTS


def test_an_active_node_sends_heartbeats_until_it_is_deactivated(start, peer):
    start('node', *ARGUMENTS)
    received = peer.collect(Status, '/bond')
    peer.spin_until(lambda: len(received) > 2)
    assert {message.id for message in received} == {'surfel_mapper'}
    assert all(message.active for message in received)
    request = ChangeState.Request(transition=Transition(label='deactivate'))
    assert peer.call('change_state', ChangeState, request).success
    peer.spin_until(lambda: not received[-1].active)
