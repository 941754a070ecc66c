# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Clouds and grids as messages.

The bytes of a cloud go through an array.array, which takes 0.6 ms for 4 MiB; assigning a numpy
array, which rclpy checks byte by byte, takes 270 ms.
"""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING

from builtin_interfaces.msg import Time
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from surfel_mapper.messages.pointcloud2 import CloudBytes

if TYPE_CHECKING:
    from surfel_mapper.mapping.cost_grid import CostGrid


def cloud_message(content: CloudBytes, stamp_ns: int, frame_id: str) -> PointCloud2:
    """Return the message of a cloud."""
    data = array('B')
    data.frombytes(content.data.data)
    return PointCloud2(
        header=Header(stamp=time_message(stamp_ns), frame_id=frame_id),
        height=content.height,
        width=content.width,
        fields=[
            PointField(name=f.name, offset=f.offset, datatype=f.datatype, count=f.count)
            for f in content.fields
        ],
        is_bigendian=content.is_bigendian,
        point_step=content.point_step,
        row_step=content.row_step,
        data=data,
        is_dense=content.is_dense,
    )


def grid_message(grid: CostGrid, stamp_ns: int, frame_id: str) -> OccupancyGrid:
    """Return the message of a grid: 0 free to 100 occupied, -1 unknown."""
    message = OccupancyGrid(header=Header(stamp=time_message(stamp_ns), frame_id=frame_id))
    message.info.map_load_time = message.header.stamp
    message.info.resolution = grid.resolution_m
    message.info.height, message.info.width = grid.cost.shape
    message.info.origin.position.x, message.info.origin.position.y = grid.origin.tolist()
    message.data = array('b', grid.cost.tobytes())
    return message


def time_message(stamp_ns: int) -> Time:
    """Return a time in nanoseconds as a message."""
    sec, nanosec = divmod(stamp_ns, 10**9)
    return Time(sec=sec, nanosec=nanosec)
