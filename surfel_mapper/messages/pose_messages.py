# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Poses out of messages: odometry, stamped poses and transforms, whichever library made them.

Messages are read by the names of their attributes, for who has them and a ``Mapper`` of his own.
Node and replay read the same from the bytes alone, which is quicker; see raw_pose.py.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

ODOMETRY, POSE, TF = 'odometry', 'pose', 'tf'


class StampedPose(NamedTuple):
    """The pose of a child frame in its parent at one time, as ``Mapper.add_pose`` takes it."""

    parent: str
    child: str
    stamp_ns: int
    xyz: Iterable[float]
    q_xyzw: Iterable[float]


def poses_in(kind: str, msg: Any, base: str) -> Iterator[StampedPose]:
    """
    Yield the poses in a message.

    Parameters
    ----------
    kind : str
        odometry (nav_msgs/Odometry), pose (geometry_msgs/PoseStamped) or tf (tf2_msgs/TFMessage).
    msg : message
        Of rclpy or rosbags.
    base : str
        The frame that a stamped pose is about; the other messages name theirs.

    """
    if kind == TF:
        for stamped in msg.transforms:
            transform = stamped.transform
            child = stamped.child_frame_id
            yield stamped_pose(stamped.header, child, transform.translation, transform.rotation)
    elif kind == ODOMETRY:
        pose = msg.pose.pose
        yield stamped_pose(msg.header, msg.child_frame_id, pose.position, pose.orientation)
    else:
        yield stamped_pose(msg.header, base, msg.pose.position, msg.pose.orientation)


def stamped_pose(header: Any, child: str, position: Any, orientation: Any) -> StampedPose:
    """Return a pose from the parts of a message."""
    return StampedPose(
        parent=frame_name(header.frame_id),
        child=frame_name(child),
        stamp_ns=stamp_ns(header),
        xyz=(position.x, position.y, position.z),
        q_xyzw=(orientation.x, orientation.y, orientation.z, orientation.w),
    )


def frame_name(frame_id: str) -> str:
    """Return the name of a frame without the leading slash that ROS 1 put before it."""
    return str(frame_id).removeprefix('/')


def stamp_ns(header: Any) -> int:
    """Return the stamp of a header in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
