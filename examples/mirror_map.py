# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The map of a running node in another process, equal to the bit.

    ros2 run surfel_mapper node --ros-args -p publish.moments:=true -r points:=/lidar/points
    python examples/mirror_map.py

A planner can use the copy like any SurfelMap, without calls to the node.
"""

from __future__ import annotations

import argparse
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2

from surfel_mapper import MapMirror

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def main() -> None:
    """Follow a node; print figures of the copy once a second."""
    parser = argparse.ArgumentParser(description=str(__doc__).strip().partition('\n')[0])
    parser.add_argument('--node', default='/surfel_mapper', help='name of the node (%(default)s)')
    parser.add_argument('--voxel-size', type=float, default=0.5, help='its map.voxel_size_m')
    parser.add_argument(
        '--seconds', type=float, default=float('inf'), help='end after this time, s'
    )
    args = parser.parse_args()

    rclpy.init()
    node = Node('map_mirror')
    mirror = MapMirror(voxel_size_m=args.voxel_size)
    node.create_subscription(PointCloud2, f'{args.node}/changed', mirror.change, 100)
    node.create_subscription(PointCloud2, f'{args.node}/normals', mirror.replace, LATCHED)

    end, shown_ns = time.monotonic() + args.seconds, -1
    next_s = time.monotonic() + 1.0
    try:
        while time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.1)
            if time.monotonic() > next_s and mirror.is_complete and mirror.stamp_ns != shown_ns:
                next_s, shown_ns = time.monotonic() + 1.0, mirror.stamp_ns
                show(mirror)
    except (KeyboardInterrupt, ExternalShutdownException):  # Ctrl-C, or a request to end
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def show(mirror: MapMirror) -> None:
    """Print figures that a planner may use."""
    surfels = mirror.map.surfels(min_points=5)
    level = surfels.is_good & (surfels.normal[:, 2] > 0.9)
    print(
        f'{mirror.stamp_ns / 1e9:.3f} s: {len(surfels)} surfels, {int(level.sum())} good and '
        f'level, digest {mirror.map.digest()}',
        flush=True,
    )


if __name__ == '__main__':
    main()
