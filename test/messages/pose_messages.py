# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses of message objects, by the names of their attributes: the twin of ``raw_poses``."""

from surfel_mapper.messages.cdr import frame_name, stamp_ns
from surfel_mapper.messages.poses import ODOMETRY, StampedPose, TF


def poses_in(kind, msg, base):
    """Yield the poses in a message of rclpy or rosbags; see raw_poses."""
    if kind == TF:
        for stamped in msg.transforms:
            transform = stamped.transform
            child = stamped.child_frame_id
            yield stamped_pose(stamped.header, child, transform.translation, transform.rotation)
    elif kind == ODOMETRY:
        pose = msg.pose.pose
        child = msg.child_frame_id or base
        yield stamped_pose(msg.header, child, pose.position, pose.orientation)
    else:
        yield stamped_pose(msg.header, base, msg.pose.position, msg.pose.orientation)


def stamped_pose(header, child, position, orientation):
    """Return a pose from the parts of a message."""
    return StampedPose(
        parent=frame_name(header.frame_id),
        child=frame_name(child),
        stamp_ns=stamp_ns(header),
        xyz=(position.x, position.y, position.z),
        q_xyzw=(orientation.x, orientation.y, orientation.z, orientation.w),
    )
