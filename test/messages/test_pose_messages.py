# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses come out of messages with frames, stamp and numbers as they were written."""

import pytest

from surfel_mapper.messages.pose_messages import poses_in, StampedPose
from test.bags.recorded import Entries, ROS1, ROS2

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


def test_numbers_are_handed_on_as_they_are():
    entries = Entries()
    entries.odometry('/odom', STAMP_NS, XYZ)
    turn = entries[0][3].pose.pose.orientation
    turn.x, turn.y, turn.z, turn.w = 0.1, 0.2, 0.3, float('nan')

    (pose,) = poses_in('odometry', entries[0][3], base='')

    assert pose.q_xyzw[:3] == (0.1, 0.2, 0.3)
    assert pose.q_xyzw[3] != pose.q_xyzw[3]


@pytest.mark.parametrize('kind', ['odometry', 'tf', 'pose'])
def test_the_leading_slash_of_ros1_frames_is_left_out(kind):
    entries = Entries()
    entries.odometry('/odom', STAMP_NS, XYZ)
    entries.transform('/tf', STAMP_NS, '/odom', '/base_link', XYZ)
    entries.pose_stamped('/pose', STAMP_NS, XYZ)
    odometry, transform, pose = (message for *_, message in entries)
    odometry.header.frame_id, odometry.child_frame_id = '/odom', '/base_link'
    pose.header.frame_id = '/odom'
    message = {'odometry': odometry, 'tf': transform, 'pose': pose}[kind]

    (found,) = poses_in(kind, message, 'base_link')

    assert (found.parent, found.child) == ('odom', 'base_link')
