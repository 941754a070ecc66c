# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Serialised messages published without Python's lock arrive as they are."""

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import UInt8MultiArray

from surfel_mapper.ros.serialized import publish_serialized
from test.ros.live import LATCHED


@pytest.mark.parametrize('size', [0, 7, 5_000_000])
def test_serialised_message_arrives_as_it_is(peer, size):
    got = peer.subscribe(UInt8MultiArray, '/numbers', LATCHED)
    content = bytes(n % 251 for n in range(1000)) * (size // 1000) + bytes(size % 1000)
    publisher = peer.node.create_publisher(UInt8MultiArray, '/numbers', LATCHED)
    message = serialize_message(UInt8MultiArray(data=content))
    publish_serialized(publisher, message)
    peer.spin_until(lambda: got)
    assert bytes(got[0].data) == content
    assert deserialize_message(message, UInt8MultiArray).data == got[0].data


def test_destroyed_publisher_is_refused(peer):
    publisher = peer.node.create_publisher(UInt8MultiArray, '/numbers', LATCHED)
    peer.node.destroy_publisher(publisher)
    with pytest.raises(rclpy_implementation.InvalidHandle):
        publish_serialized(publisher, b'\x00\x01\x00\x00')
