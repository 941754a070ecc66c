# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surfels of a running node as arrays, for a node of your own.

    ros2 run surfel_mapper node --ros-args -r points:=/lidar/points
    python examples/subscribe.py --topic /surfel_mapper/normals
"""

import argparse
from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2

from surfel_mapper import Surfels


def show(msg: PointCloud2) -> None:
    """Print figures of a map."""
    surfels = Surfels.from_message(msg)
    is_level = surfels.is_good & (surfels.normal[:, 2] > 0.9)
    heights = surfels.position[is_level, 2]
    print(f'{len(surfels)} surfels, {len(heights)} good and level', flush=True)


parser = argparse.ArgumentParser(description=str(__doc__).strip().partition('\n')[0])
parser.add_argument('--topic', default='/surfel_mapper/normals', help='topic (%(default)s)')
args = parser.parse_args()

rclpy.init()
node = rclpy.create_node('surfel_subscriber')
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # the map at once
node.create_subscription(PointCloud2, args.topic, show, latched)
with suppress(KeyboardInterrupt, ExternalShutdownException):  # Ctrl-C, or a request to end
    rclpy.spin(node)
