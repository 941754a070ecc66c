# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
CustomMsg of Livox's drivers, the message that they publish by default, as a PointCloud2.

Header, timebase (uint64, ns), point_num (uint32), lidar_id and three reserved uint8, then points
of offset_time (uint32, ns after the timebase), x, y, z (float32, m), reflectivity, tag and line
(uint8). In CDR a point is padded to 20 bytes, except the last one; in ROS 1 it has 19.

Source: livox_ros_driver2, msg/CustomMsg.msg and CustomPoint.msg.
"""

from __future__ import annotations

import struct

import numpy as np

from surfel_mapper.errors import CloudFormatError
from surfel_mapper.messages.cdr import MessageReader, read_header
from surfel_mapper.messages.pointcloud2 import Field, FLOAT32, RawCloud, UINT32

MEMBERS = ('header', 'timebase', 'point_num', 'lidar_id', 'rsvd', 'points')
"""Members of a CustomMsg, in their order."""

UINT8 = 2

FIELDS = [
    Field('offset_time', 0, UINT32, 1),
    *(Field(name, 4 * i, FLOAT32, 1) for i, name in enumerate('xyz', 1)),
    *(Field(name, i, UINT8, 1) for i, name in enumerate(('intensity', 'tag', 'line'), 16)),
]

POINT_BYTES = 19


def parse_livox(raw: bytes | memoryview, *, ros1: bool = False, topic: str = 'points') -> RawCloud:
    """
    Return the PointCloud2 with the points of a CustomMsg, the reflectivity as intensity.

    Parameters
    ----------
    raw : bytes or memoryview
        The message: CDR in either byte order, or as ROS 1 writes it.
    ros1 : bool
        Whether ROS 1 wrote it.
    topic : str
        Named in errors.

    Raises
    ------
    CloudFormatError
        If the bytes are truncated, or are not such a message.

    """
    step = POINT_BYTES if ros1 else POINT_BYTES + 1
    try:
        reader = MessageReader(raw, ros1=ros1)
        header = read_header(reader)
        reader.numbers('QIBBBB')
        number = reader.number('I')
        points = reader.view(max(number * step - (step - POINT_BYTES), 0))
    except (struct.error, UnicodeDecodeError, ValueError) as error:
        raise CloudFormatError(
            f'{topic}: {len(raw)} bytes that are not a whole CustomMsg of Livox: {error}'
        ) from error
    data = np.zeros(number * step, np.uint8)
    data[: len(points)] = points
    return RawCloud(
        header=header,
        height=1,
        width=number,
        fields=FIELDS,
        is_bigendian=reader.is_bigendian,
        point_step=step,
        row_step=number * step,
        data=data,
        is_dense=True,
    )
