# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A drive through a room: settings of the node, messages to send, and a mapper without ROS."""

from __future__ import annotations

from surfel_mapper.config import Config
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.pipeline import Mapper
from test.messages.pose_messages import poses_in
from test.ros.live import cloud, odometry, room, START_NS

PERIOD_NS = 100_000_000
SETTINGS = {
    'pose.source': 'odometry',
    'frames.base_to_sensor': [0.1, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0],
    'window.max_scans': 3,
    'publish.normals_rate_hz': 20.0,
    'publish.markers_rate_hz': 20.0,
    'publish.diagnostics_rate_hz': 20.0,
}


def arguments(**changes):
    """Return the arguments of a node with ``SETTINGS`` and some changes."""
    pairs = [('-p', f'{name}:={value}') for name, value in {**SETTINGS, **changes}.items()]
    return ['--ros-args', *(item for pair in pairs for item in pair)]


ARGUMENTS = arguments()


def drive(num_scans):
    """Return clouds with their poses of a sensor that moves through a room."""
    stamps = [START_NS + i * PERIOD_NS for i in range(num_scans)]
    return [
        (cloud(stamp_ns, room(seed=i)), odometry(stamp_ns, (0.2 * i, 0.0, 0.0)))
        for i, stamp_ns in enumerate(stamps)
    ]


def send(peer, messages):
    """Send clouds with their poses."""
    for points, pose in messages:
        peer.spin_for(0.03)  # the subscription has a queue of 20
        peer.publish('/odom', pose)
        peer.publish('/points', points)


def mapped(messages, **changes):
    """Return the updates of a Mapper without ROS for the same messages, and the Mapper."""
    mapper = Mapper(Config.from_mapping({**SETTINGS, **changes}))
    updates = []
    for points, pose in messages:
        for found in poses_in('odometry', pose, 'base_link'):
            mapper.add_pose(*found)
        mapper.add_scan(to_scan(points))
        updates += mapper.insert_ready()
    return updates, mapper
