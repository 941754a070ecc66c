# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The lidar and the odometry of the live bench, a process each, by the defaults of the middleware.

The lidar starts the odometry, and signals the begin of the drive. The drive goes back and forth
over the scans held in memory, so poses stay smooth for any duration. Clouds are stamped with the
time at which they are due; latency counts from there.
"""

from __future__ import annotations

from array import array
import json
import os
from pathlib import Path
import subprocess
import sys
import time

import numpy as np

from test.bench.options import Options
from test.bench.street import Street

NUM_SCANS = 60
"""Number of scans held in memory, 4 MiB each."""

ODOMETRY_HZ = 100.0
FASTEST_HZ = 100.0
"""Clouds that come faster show the same place."""

START_UP_S = 300.0
LEAD_S = 0.5
"""Odometry runs this long before the first cloud and after the last."""

AFTER_S = 5.0
"""Unread messages vanish with their publisher, and none learns what its reader has read."""


K = [525.0, 0.0, 319.5, 0.0, 525.0, 239.5, 0.0, 0.0, 1.0]
"""Calibration of the depth camera."""

P = [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]


def main(arguments):
    """Publish clouds at a rate, and write their stamps to a file as JSON; or the odometry."""
    import rclpy

    settings = json.loads(arguments[0])
    size = {name: settings[name] for name in ('beams', 'columns')}
    street = Street(Options(**size, cache=Path(settings['cache'])))
    rclpy.init()
    if settings['role'] == 'lidar':
        stamps = publish_clouds(rclpy.create_node('lidar'), street, settings)
        Path(settings['stamps']).write_text(json.dumps(stamps), encoding='utf-8')
    else:
        publish_odometry(rclpy.create_node('odometry'), street, settings)
    rclpy.shutdown()


def publish_clouds(node, street, settings):
    """Publish the clouds of a drive; return their stamps."""
    from surfel_mapper.memory import keep_freed_memory

    keep_freed_memory()
    publishers, clouds = sensors(node, street, settings)
    with odometry_process(settings) as odometry:
        for publisher in publishers:
            wait_for_reader(publisher)
        while (line := odometry.stdout.readline()) != 'ready\n':  # Fast DDS warns there too
            assert line, 'the odometry has ended'
        start_ns = time.time_ns() + round(2.0 * LEAD_S * 1e9)
        print(start_ns, file=odometry.stdin, flush=True)
        stamps = []
        for number in range(settings['num']):
            stamp_ns = start_ns + round(number / settings['rate_hz'] * 1e9)
            cloud = clouds[round(place(stamp_ns - start_ns, settings))]
            cloud.header.stamp.sec, cloud.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            if len(publishers) > 1:
                cloud.header.frame_id = f'lidar_{number % len(publishers)}'
            sleep_until(stamp_ns)
            publishers[number % len(publishers)].publish(cloud)
            stamps.append(stamp_ns)
        time.sleep(AFTER_S)
    return stamps


def sensors(node, street, settings):
    """Return the publishers of the sensors, which take turns, and their messages."""
    from sensor_msgs.msg import CameraInfo, Image, PointCloud2

    topics = settings.get('topics', ['points'])
    if topics == ['depth/image']:
        info = CameraInfo(height=480, width=640, k=K, p=P)
        info.header.frame_id = 'camera'
        calibration = node.create_publisher(CameraInfo, 'depth/camera_info', 10)
        publisher = node.create_publisher(Image, topics[0], 10)
        wait_for_reader(calibration)
        calibration.publish(info)
        return [publisher], [depth_image(Image, number) for number in range(settings['scans'])]
    clouds = [ros_cloud(street.message(number)) for number in range(settings['scans'])]
    return [node.create_publisher(PointCloud2, topic, 10) for topic in topics], clouds


def depth_image(kind, number):
    """Return an image of 640 x 480 of a wavy wall, 2 to 4 m away, in mm."""
    row, column = np.mgrid[:480, :640]
    depth = 3000.0 + 1000.0 * np.sin(0.02 * row + 0.013 * column + 0.1 * number)
    content = array('B', depth.astype('<u2').tobytes())
    message = kind(height=480, width=640, encoding='16UC1', step=1280, data=content)
    message.header.frame_id = 'camera'
    return message


def publish_odometry(node, street, settings):
    """Publish the poses of the drive, whose start comes on standard input."""
    from nav_msgs.msg import Odometry

    publisher = node.create_publisher(Odometry, 'odom', 10)
    wait_for_reader(publisher)
    print('ready', flush=True)
    start_ns = int(sys.stdin.readline())
    lead_ns = round(LEAD_S * 1e9)
    end_ns = start_ns + round(settings['num'] / settings['rate_hz'] * 1e9) + lead_ns
    for stamp_ns in range(start_ns - lead_ns, end_ns, round(1e9 / ODOMETRY_HZ)):
        message = odometry(street, place(stamp_ns - start_ns, settings))
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        sleep_until(stamp_ns)
        publisher.publish(message)
    time.sleep(AFTER_S)


def odometry_process(settings):
    """Start the odometry, by the defaults of the middleware whatever the lidar has."""
    environment = {name: value for name, value in os.environ.items() if 'PROFILES' not in name}
    return subprocess.Popen(
        [sys.executable, '-m', __spec__.name, json.dumps({**settings, 'role': 'odometry'})],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    )


def wait_for_reader(publisher):
    """Wait until the node subscribes."""
    end_s = time.monotonic() + START_UP_S
    while not publisher.get_subscription_count():
        if time.monotonic() > end_s:
            raise SystemExit('no subscriber appeared')
        time.sleep(0.05)
    time.sleep(0.5)  # the other side needs to know of us too


def place(since_start_ns, settings):
    """Return the number of the scan taken where the vehicle is, with fractions between scans."""
    last = settings['scans'] - 1
    scans = since_start_ns * 1e-9 * min(settings['rate_hz'], FASTEST_HZ)
    return last - abs(last - scans % (2 * last))


def sleep_until(stamp_ns):
    """Sleep until a time of the clock."""
    wait_s = (stamp_ns - time.time_ns()) * 1e-9
    if wait_s > 0.0:
        time.sleep(wait_s)


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


def odometry(street, number):
    """Return the pose of the vehicle at a scan, or between two, as a message."""
    from nav_msgs.msg import Odometry

    from surfel_mapper.simulation.recording import BASE, ODOM

    period_ns = street.simulation.stamp_ns(1) - street.simulation.stamp_ns(0)
    stamp_ns = street.simulation.stamp_ns(0) + round(number * period_ns)
    xyz, q_xyzw = street.simulation.drive.pose(stamp_ns)
    message = Odometry(child_frame_id=BASE)
    message.header.frame_id = ODOM
    pose = message.pose.pose
    pose.position.x, pose.position.y, pose.position.z = np.asarray(xyz, float).tolist()
    turned = pose.orientation
    turned.x, turned.y, turned.z, turned.w = np.asarray(q_xyzw, float).tolist()
    return message


if __name__ == '__main__':
    main(sys.argv[1:])
