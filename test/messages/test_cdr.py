# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Serialised markers are read by rclpy as they were written."""

import struct

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from surfel_mapper.messages.markers import (
    ADD,
    DELETE,
    DELETE_ALL,
    LINE_LIST,
    Marker,
    marker_array,
    polygon_instance,
    TEXT_VIEW_FACING,
    TRIANGLE_LIST,
)

TEXTS = ['', 'a', 'ab', 'abc', 'odom', 'sensor', 'über', 'discs of a map']


def make_marker(frame_id='odom', ns='discs', points=3, coloured=True, seed=0, **changes):
    rng = np.random.default_rng(seed)
    values = {
        'ns': ns,
        'id': 7,
        'type': TRIANGLE_LIST,
        'action': ADD,
        'frame_id': frame_id,
        'stamp_ns': 1_700_000_000_123_456_789,
        'pose': rng.normal(size=7),
        'scale': (1.0, 2.0, 3.0),
        'color': (0.25, 0.5, 0.75, 1.0),
        'points': rng.normal(size=(points, 3)),
        'colors': rng.uniform(size=(points * coloured, 4)).astype(np.float32),
    }
    return Marker(**{**values, **changes})


NAMES = st.text(st.characters(exclude_characters='\0', exclude_categories=['Cs']), max_size=9)
MARKERS = st.lists(
    st.builds(
        make_marker,
        frame_id=NAMES,
        ns=NAMES,
        text=NAMES,
        points=st.integers(0, 4),
        coloured=st.booleans(),
        seed=st.integers(0, 9),
        id=st.integers(-(2**31), 2**31 - 1),
        type=st.sampled_from([LINE_LIST, TEXT_VIEW_FACING, TRIANGLE_LIST]),
        action=st.sampled_from([ADD, DELETE, DELETE_ALL]),
        stamp_ns=st.integers(0, 2**31 * 10**9 - 1),
    ),
    max_size=4,
)


def ros_message(markers):
    """Return the same MarkerArray made of the objects of rclpy."""
    msgs = pytest.importorskip('visualization_msgs.msg')
    from geometry_msgs.msg import Point
    from std_msgs.msg import ColorRGBA

    def ros_marker(m):
        out = msgs.Marker(ns=m.ns, id=m.id, type=m.type, action=m.action, text=m.text)
        out.header.frame_id = m.frame_id
        out.header.stamp.sec, out.header.stamp.nanosec = divmod(m.stamp_ns, 10**9)
        position, orientation = out.pose.position, out.pose.orientation
        position.x, position.y, position.z = map(float, m.pose[:3])
        orientation.x, orientation.y, orientation.z, orientation.w = map(float, m.pose[3:])
        out.scale.x, out.scale.y, out.scale.z = m.scale
        out.color.r, out.color.g, out.color.b, out.color.a = m.color
        out.points = [Point(x=x, y=y, z=z) for x, y, z in m.points.tolist()]
        out.colors = [ColorRGBA(r=r, g=g, b=b, a=a) for r, g, b, a in m.colors.tolist()]
        return out

    return msgs.MarkerArray(markers=[ros_marker(m) for m in markers])


@given(MARKERS)
@settings(max_examples=30, deadline=None)
def test_rclpy_reads_our_bytes(markers):
    serialization = pytest.importorskip('rclpy.serialization')
    expected = ros_message(markers)
    found = serialization.deserialize_message(marker_array(markers), type(expected))
    assert found == expected


@pytest.mark.parametrize('frame_id', TEXTS)
@pytest.mark.parametrize('corners', [0, 1, 5])
def test_rclpy_reads_the_polygon_that_was_written(frame_id, corners):
    serialization = pytest.importorskip('rclpy.serialization')
    from geometry_msgs.msg import PolygonInstanceStamped

    ring = np.random.default_rng(1).normal(size=(corners, 3))
    content = polygon_instance(ring, 2**40 + 3, stamp_ns=5 * 10**9 + 7, frame_id=frame_id)
    found = serialization.deserialize_message(content, PolygonInstanceStamped)
    assert (found.header.stamp.sec, found.header.stamp.nanosec) == (5, 7)
    assert found.header.frame_id == frame_id
    assert found.polygon.id == 2**40 + 3
    points = [(p.x, p.y, p.z) for p in found.polygon.polygon.points]
    assert np.array_equal(np.array(points).reshape(-1, 3), ring.astype(np.float32))


def test_arrays_of_other_types_and_layouts_are_converted():
    marker = make_marker(points=4)
    other = make_marker(
        points=4,
        colors=marker.colors.astype('>f8'),
        pose=marker.pose.tolist(),
    )
    reversed_twice = make_marker(points=4, colors=np.asfortranarray(marker.colors))
    assert marker_array([other]) == marker_array([marker])
    assert marker_array([reversed_twice]) == marker_array([marker])


def test_a_stamp_beyond_the_message_is_refused():
    with pytest.raises(struct.error):
        marker_array([make_marker(stamp_ns=2**31 * 10**9)])
