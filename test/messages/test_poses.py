# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses read from messages have the frames, stamps and numbers that were written."""

from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

from surfel_mapper.errors import PoseError
from surfel_mapper.messages.poses import raw_poses, StampedPose, warn_of_child
from test.bags.recorded import Entries, ODOMETRY, ROS1, ROS2
from test.messages.pose_messages import poses_in

STAMP_NS = 1_700_000_000_123_456_789
XYZ = (1.5, -2.25, 0.125)
NO_TURN = (0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize('store', [ROS1, ROS2])
def test_each_message_yields_its_pose(store):
    entries = Entries(store)
    entries.odometry('/odom', STAMP_NS, XYZ)
    entries.pose_stamped('/pose', STAMP_NS, XYZ)
    entries.transform('/tf', STAMP_NS, 'odom', 'base_link', XYZ)
    expected = StampedPose('odom', 'base_link', STAMP_NS, XYZ, NO_TURN)

    for kind, (*_, message) in zip(('odometry', 'pose', 'tf'), entries, strict=True):
        assert list(poses_in(kind, message, base='base_link')) == [expected]


def test_a_stamped_pose_is_that_of_the_base_frame():
    entries = Entries()
    entries.pose_stamped('/pose', STAMP_NS, XYZ)

    (pose,) = poses_in('pose', entries[0][3], base='imu')

    assert (pose.parent, pose.child) == ('odom', 'imu')


def test_all_transforms_of_a_message_are_yielded_in_order():
    entries = Entries()
    for child in ('a', 'b', 'c'):
        entries.transform('/tf', STAMP_NS, 'odom', child, XYZ)
    message = entries[0][3]
    for *_, other in entries[1:]:
        message.transforms.extend(other.transforms)

    assert [pose.child for pose in poses_in('tf', message, base='')] == ['a', 'b', 'c']


def test_odometry_without_a_child_frame_has_the_poses_of_the_base(caplog):
    entries = Entries()
    entries.odometry('/odom', STAMP_NS, XYZ)
    entries[0][3].child_frame_id = ''
    raw = ROS2.serialize_cdr(entries[0][3], ODOMETRY)
    warn_of_child.cache_clear()
    for _ in range(2):
        (pose,) = raw_poses('odometry', raw, 'base', '/odom')
        assert (pose.parent, pose.child) == ('odom', 'base')
    assert len(caplog.records) == 1
    assert '/odom: child_frame_id is empty' in caplog.text


names = st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=9)
numbers = st.floats(allow_nan=False)
transforms = st.lists(
    st.tuples(names, names, st.integers(0, 2**31 * 10**9 - 1), st.tuples(*[numbers] * 3)),
    min_size=1,
    max_size=3,
)


@settings(max_examples=100, deadline=None)
@given(transforms, st.booleans())
def test_bytes_give_the_poses_of_the_message(values, little_endian):
    entries = Entries()
    for parent, child, stamp_ns, xyz in values:
        entries.transform('/tf', stamp_ns, parent, child, xyz)
        entries.odometry('/odom', stamp_ns, xyz)
        entries[-1][3].child_frame_id = child
        entries.pose_stamped('/pose', stamp_ns, xyz)
        entries[-1][3].header.frame_id = parent
    for *_, other in entries[3::3]:
        entries[0][3].transforms.extend(other.transforms)

    for kind, (_, name, _, message) in zip(('tf', 'odometry', 'pose'), entries, strict=False):
        raw = bytes(ROS2.serialize_cdr(message, name, little_endian=little_endian))
        expected = list(poses_in(kind, message, 'base_link'))
        assert raw_poses(kind, raw, 'base_link', '/topic') == expected


@pytest.mark.parametrize('parent', ['odom', '/a', 'lidar_front'])
def test_bytes_of_ros1_give_the_poses_of_the_message(parent):
    entries = Entries(ROS1)
    for frame in (parent, 'b'):
        entries.transform('/tf', STAMP_NS, frame, 'base_link', XYZ)
    entries[0][3].transforms.extend(entries.pop()[3].transforms)
    entries.odometry('/odom', STAMP_NS, XYZ)
    entries[-1][3].header.frame_id = parent
    entries.pose_stamped('/pose', STAMP_NS, XYZ)

    for kind, (_, name, _, message) in zip(('tf', 'odometry', 'pose'), entries, strict=True):
        raw = memoryview(bytes(ROS1.serialize_ros1(message, name)))
        expected = list(poses_in(kind, message, 'base_link'))
        assert raw_poses(kind, raw, 'base_link', '/topic', ros1=True) == expected


def serialised(kind):
    """Return a message, and the number of its bytes up to the end of its pose."""
    entries = Entries()
    entries.odometry('/odom', STAMP_NS, XYZ)
    entries.transform('/tf', STAMP_NS, 'odom', 'base_link', XYZ)
    entries.pose_stamped('/pose', STAMP_NS, XYZ)
    _, name, _, message = entries[('odometry', 'tf', 'pose').index(kind)]
    raw = bytes(ROS2.serialize_cdr(message, name))
    covariances_and_twist = (36 + 6 + 36) * 8
    return raw, len(raw) - (covariances_and_twist if kind == 'odometry' else 0)


@pytest.mark.parametrize('kind', ['odometry', 'tf', 'pose'])
def test_bytes_truncated_before_the_end_of_the_pose_are_refused(kind):
    raw, num_needed = serialised(kind)
    assert raw_poses(kind, raw[:num_needed], 'base_link', '/odom')
    for size in range(num_needed):
        with pytest.raises(PoseError, match=f'/odom: {size} bytes that are not a'):
            raw_poses(kind, raw[:size], 'base_link', '/odom')


def test_a_count_of_transforms_beyond_the_message_is_refused_before_the_loop():
    raw = bytearray(serialised('tf')[0])
    raw[4:8] = b'\xff\xff\xff\xff'
    with pytest.raises(PoseError, match='4294967295 transforms announced'):
        raw_poses('tf', bytes(raw), '', '/tf')


def test_a_frame_name_that_is_not_utf8_is_refused():
    raw = serialised('odometry')[0].replace(b'base_link', b'base\xff\xfeink')
    with pytest.raises(PoseError, match='utf-8'):
        raw_poses('odometry', raw, '', '/odom')
