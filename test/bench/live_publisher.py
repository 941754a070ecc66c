# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The lidar of the live bench, a process of its own: clouds and odometry at a rate, by defaults.

The drive goes forth and back over the scans held in memory, so that poses stay smooth however
long it lasts. A cloud is stamped right before it is published, from which latency is counted.
"""

from __future__ import annotations

from array import array
import json
from pathlib import Path
import sys
import time

import numpy as np

from test.bench.options import Options
from test.bench.street import Street

NUM_SCANS = 60
"""Held in memory, 4 MiB each."""

START_UP_S = 300.0


def main(arguments):
    """Publish a number of clouds at a rate, and write their stamps to a file as JSON."""
    from nav_msgs.msg import Odometry
    import rclpy
    from sensor_msgs.msg import PointCloud2

    from surfel_mapper.memory import keep_freed_memory
    from surfel_mapper.simulation.recording import BASE, ODOM

    settings = json.loads(arguments[0])
    size = {name: settings[name] for name in ('beams', 'columns')}
    street = Street(Options(**size, cache=Path(settings['cache'])))
    keep_freed_memory()
    clouds = [ros_cloud(street.message(number)) for number in range(settings['scans'])]
    poses = [odometry(street, number, ODOM, BASE) for number in range(settings['scans'])]
    rclpy.init()
    node = rclpy.create_node('lidar')
    points = node.create_publisher(PointCloud2, 'points', 10)
    odom = node.create_publisher(Odometry, 'odom', 10)
    end_s = time.monotonic() + START_UP_S
    while not (points.get_subscription_count() and odom.get_subscription_count()):
        if time.monotonic() > end_s:
            raise SystemExit('no subscriber appeared')
        time.sleep(0.05)
    time.sleep(0.5)  # the other side needs to know of us too
    stamps = drive(settings, clouds, poses, points, odom)
    # Unread messages vanish with their publisher, and none learns what its reader has read; a wait
    # that is too short shows as lost clouds.
    time.sleep(5.0)
    Path(settings['stamps']).write_text(json.dumps(stamps), encoding='utf-8')
    rclpy.shutdown()


def drive(settings, clouds, poses, points, odom):
    """Publish; return the stamps."""
    there_and_back = [*range(len(clouds)), *range(len(clouds) - 2, 0, -1)]
    stamps, start = [], time.perf_counter()
    for number in range(settings['num']):
        which = there_and_back[number % len(there_and_back)]
        wait_s = start + number / settings['rate_hz'] - time.perf_counter()
        if wait_s > 0.0:
            time.sleep(wait_s)
        stamp_ns = time.time_ns()
        for message, publisher in ((poses[which], odom), (clouds[which], points)):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            publisher.publish(message)
        stamps.append(stamp_ns)
    return stamps


def ros_cloud(raw):
    """Return a cloud as a message."""
    from sensor_msgs.msg import PointCloud2, PointField

    message = PointCloud2(
        height=raw.height,
        width=raw.width,
        fields=[
            PointField(name=f.name, offset=f.offset, datatype=f.datatype, count=f.count)
            for f in raw.fields
        ],
        point_step=raw.point_step,
        row_step=raw.row_step,
        data=array('B', bytes(raw.data)),
        is_dense=raw.is_dense,
    )
    message.header.frame_id = raw.header.frame_id
    return message


def odometry(street, number, parent, child):
    """Return the pose of the vehicle at a scan as a message."""
    from nav_msgs.msg import Odometry

    xyz, q_xyzw = street.simulation.drive.pose(street.simulation.stamp_ns(number))
    message = Odometry(child_frame_id=child)
    message.header.frame_id = parent
    pose = message.pose.pose
    pose.position.x, pose.position.y, pose.position.z = np.asarray(xyz, float).tolist()
    turned = pose.orientation
    turned.x, turned.y, turned.z, turned.w = np.asarray(q_xyzw, float).tolist()
    return message


if __name__ == '__main__':
    main(sys.argv[1:])
