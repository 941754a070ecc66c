# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Programs that make PointCloud2 of the messages that drivers publish instead."""

from __future__ import annotations

import re

CONVERTERS = {
    r'livox\w*/msg/CustomMsg$': 'livox_ros_driver2 publishes PointCloud2 with xfer_format 0',
    r'velodyne_msgs/msg/VelodyneScan$': 'velodyne_transform_node of velodyne_pointcloud',
    r'ouster\w*/msg/PacketMsg$': '`ros2 launch ouster_ros replay.launch.xml`',
    r'(hesai|pandar)\w*/msg/': 'hesai_ros_driver, with packets of ROS as its source',
    r'nebula_msgs/msg/': 'nebula_ros with launch_hw false',
    r'rslidar\w*/msg/': 'rslidar_sdk with msg_source 2',
    r'CompressedPointCloud2$': '`ros2 run point_cloud_transport republish`',
    r'LaserScan$': 'laserscan_to_pointcloud_node of pointcloud_to_laserscan',
    r'sensor_msgs/msg/PointCloud$': 'convertPointCloudToPointCloud2 of sensor_msgs, in C++',
    r' as \w+$': 'the packages mcap-protobuf-support and mcap-ros2-support of Python',
}
"""Programs that make PointCloud2 of messages, by a regular expression of the type."""


def converter(type_name: str) -> str:
    """Return the program that makes PointCloud2 of messages of a type; empty without one."""
    programs = (text for kind, text in CONVERTERS.items() if re.search(kind, type_name))
    return next(programs, '')
