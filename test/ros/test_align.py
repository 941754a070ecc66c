# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""~/align over DDS: its answer, the path, and the map."""

from __future__ import annotations

from importlib.util import find_spec
import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from nav_msgs.msg import Path

from surfel_mapper.config import Config
from surfel_mapper.geometry import pose_matrix, q_xyzw
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.pipeline import Mapper
from test.alignment.circuit import circuit, gap
from test.alignment.circuit import drifted as drifted_circuit
from test.alignment.street import drifted, relative_errors, street_scans
from test.ros.live import cloud, LATCHED, odometry, START_NS

NUM_SCANS = 4

BLOCK = ((0.0, 0.0), (40.0, 0.0), (40.0, 30.0), (0.0, 30.0), (0.0, 0.0), (36.0, 0.0))
"""Corners of a drive around a block, and along the first street again."""

SETTINGS = {
    'pose.source': 'odometry',
    'frames.base': 'lidar',
    'window.keep_points': True,
    'align.map_frame': 'map',
    'publish.diagnostics_rate_hz': 20.0,
}
ARGUMENTS = [
    '--ros-args',
    *(item for name, value in SETTINGS.items() for item in ('-p', f'{name}:={value}')),
]


def messages():
    """Return clouds of a street with the poses of a drifting odometry."""
    scans, true = street_scans(30)
    found = []
    for scan, pose in zip(scans, drifted(true[:NUM_SCANS], 0.02, 0.2), strict=False):
        message = odometry(scan.stamp_ns, pose[:3, 3], child='lidar')
        orientation = message.pose.pose.orientation
        orientation.x, orientation.y, orientation.z, orientation.w = q_xyzw(pose).tolist()
        points = scan.points[np.isfinite(scan.points).all(axis=1)][::4]
        found.append((cloud(scan.stamp_ns, points), message))
    return found


def driven(peer):
    """Publish the messages, and return them."""
    peer.advertise('/odom', '/points')
    sent = messages()
    for points, pose in sent:
        time.sleep(0.05)
        peer.publish('/odom', pose)
        peer.publish('/points', points)
    return sent


def aligned_twin(sent):
    mapper = Mapper(Config.from_mapping(SETTINGS))
    for points, pose in sent:
        xyz, q = pose.pose.pose.position, pose.pose.pose.orientation
        scan = to_scan(points)
        position, quaternion = (xyz.x, xyz.y, xyz.z), (q.x, q.y, q.z, q.w)
        mapper.add_pose('odom', 'lidar', scan.stamp_ns, position, quaternion)
        mapper.add_scan(scan)
        list(mapper.insert_ready())
    return mapper, mapper.align()


def test_align_moves_the_window_and_publishes_the_path(start, peer, tmp_path):
    node = start('node', *ARGUMENTS, '-p', f'output.directory:={tmp_path / "maps"}')
    refused = peer.call('align')
    paths = peer.collect(Path, '/surfel_mapper/path', LATCHED)
    sent = driven(peer)
    peer.diagnosis({'scans.mapped': NUM_SCANS})

    answer = peer.call('align')
    peer.spin_until(lambda: paths)
    saved = peer.call('save_map')

    assert not refused.success
    assert '0 scans in the map' in refused.message
    mapper, aligned = aligned_twin(sent)
    assert answer.success, answer.message
    assert answer.message == str(aligned)
    assert saved.message.endswith(mapper.map.digest())
    (path,) = paths
    assert path.header.frame_id == 'map'
    found = np.array([pose_of(stamped.pose) for stamped in path.poses])
    np.testing.assert_allclose(found, aligned.T_map_sensor, rtol=0, atol=1e-12)
    _, true = street_scans(30)
    drift = relative_errors(drifted(true[:NUM_SCANS], 0.02, 0.2), true[:NUM_SCANS], NUM_SCANS - 1)
    assert relative_errors(found, true[:NUM_SCANS], NUM_SCANS - 1)[0] < drift[0] / 4.0
    assert ('tf2_msgs' in node.output) == (find_spec('tf2_msgs') is None)
    assert 'Traceback' not in node.output


def pose_of(pose):
    xyz, q = pose.position, pose.orientation
    return pose_matrix((xyz.x, xyz.y, xyz.z), (q.x, q.y, q.z, q.w))


@pytest.mark.skipif(find_spec('tf2_msgs') is None, reason='tf2_msgs is not installed')
def test_map_to_odom_is_published_with_every_scan(start, peer):
    from tf2_msgs.msg import TFMessage

    start('node', *ARGUMENTS)
    transforms = peer.collect(TFMessage, '/tf')
    sent = driven(peer)

    peer.spin_until(lambda: len(transforms) == NUM_SCANS)

    (transform,) = transforms[-1].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ('map', 'odom')
    assert transform.header.stamp == sent[-1][0].header.stamp


def around_the_block():
    """Return clouds of a drive that returns, poses of odometry that drifts, and true poses."""
    seen = circuit(BLOCK)
    odometric = drifted_circuit(seen.poses, 0.1)
    found = []
    for number, (points, pose) in enumerate(zip(seen.scans, odometric, strict=True)):
        stamp_ns = START_NS + number * 100_000_000
        message = odometry(stamp_ns, pose[:3, 3], child='lidar')
        orientation = message.pose.pose.orientation
        orientation.x, orientation.y, orientation.z, orientation.w = q_xyzw(pose).tolist()
        found.append((cloud(stamp_ns, points[::2]), message))
    return found, odometric, seen.poses


def test_a_loop_moves_the_map_and_the_odometry_goes_on(start, peer, tmp_path):
    settings = {
        'loops.enabled': True,
        'loops.directory': str(tmp_path),
        'window.max_scans': 0,
        'window.keep_points': False,
    }
    extra = [item for k, v in settings.items() for item in ('-p', f'{k}:={v}')]
    node = start('node', *ARGUMENTS, *extra)
    peer.diagnosis({'scans.mapped': 0})
    paths = peer.collect(Path, '/surfel_mapper/path', LATCHED)
    peer.advertise('/odom', '/points', depth=1000)
    messages, odometric, true = around_the_block()
    before = len(messages) - 3

    def send(first, last):
        for number in range(first, last):
            points, pose = messages[number]
            peer.publish('/odom', pose)
            peer.publish('/points', points)
            if number % 8 == 7 or number + 1 == last:  # the node keeps 20 clouds
                peer.diagnosis({'scans.mapped': number + 1})

    send(0, before)
    closed = peer.call('align')
    peer.spin_until(lambda: paths)
    send(before, len(messages))
    again = peer.call('align')
    peer.spin_until(lambda: len(paths) == 2)

    assert closed.success, closed.message
    assert again.success, again.message
    corrected, after = (np.array([pose_of(p.pose) for p in path.poses]) for path in paths)
    assert len(corrected) == before
    assert gap(corrected, true, 5, before - 5) < 0.3 < 2.0 < gap(odometric, true, 5, before - 5)
    # scans after the jump continue from the corrected place by the steps of the odometry
    assert len(after) == len(messages)
    step = np.linalg.inv(odometric[before - 1]) @ odometric[-1]
    found = np.linalg.inv(after[before - 1]) @ after[-1]
    np.testing.assert_allclose(found, step, rtol=0, atol=0.02)
    assert gap(after, true, 5, len(true) - 1) < 0.4
    assert 'Traceback' not in node.output
