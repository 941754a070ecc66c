# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Poses read in place from the serialised bytes of messages, as the middleware hands them over.

They are those that ``poses_in`` finds in the message made of these bytes. Only the part up to the
pose is read: rclpy makes an odometry message with its two covariances in 0.3 ms, which at 100 Hz
costs more than mapping a scan; this takes 20 microseconds.
"""

from __future__ import annotations

from collections.abc import Iterator
import struct

from surfel_mapper.errors import PoseError
from surfel_mapper.messages.pose_messages import frame_name, ODOMETRY, stamp_ns, StampedPose, TF
from surfel_mapper.messages.raw_cloud import Cursor, read_header

SMALLEST_TRANSFORM_BYTES = 72
"""A transform takes at least this much, so their number can be checked before the loop."""


def raw_poses(
    kind: str, raw: bytes | memoryview, base: str, topic: str, *, ros1: bool = False
) -> list[StampedPose]:
    """
    Return the poses in a serialised message.

    Parameters
    ----------
    kind, base : str
        As ``poses_in`` takes them.
    raw : bytes or memoryview
        The message: CDR in either byte order, or as ROS 1 writes it.
    topic : str
        Named in errors.
    ros1 : bool
        Whether ROS 1 wrote it.

    Raises
    ------
    PoseError
        If the bytes end before the poses do, or are no such message.

    """
    try:
        return list(read_poses(kind, Cursor(raw, ros1=ros1), base))
    except (struct.error, ValueError) as error:
        raise PoseError(
            f'{topic}: {len(raw)} bytes that are no message of {kind}: {error}'
        ) from error


def read_poses(kind: str, cursor: Cursor, base: str) -> Iterator[StampedPose]:
    """Yield the poses of the message at a cursor."""
    number = 1
    if kind == TF:
        number = cursor.number('I')
        if number * SMALLEST_TRANSFORM_BYTES > cursor.remaining:
            raise ValueError(f'{number} transforms announced, {cursor.remaining} bytes left')
    for _ in range(number):
        header = read_header(cursor)
        child = cursor.string() if kind in (TF, ODOMETRY) else base
        xyz, q_xyzw = cursor.floats(3), cursor.floats(4)
        yield StampedPose(
            frame_name(header.frame_id), frame_name(child), stamp_ns(header), xyz, q_xyzw
        )
