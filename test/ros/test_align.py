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
from test.alignment.street import drifted, relative_errors, street_scans
from test.ros.live import cloud, LATCHED, odometry

NUM_SCANS = 4
SETTINGS = {
    'pose.source': 'odometry',
    'frames.base': 'lidar',
    'window.keep_points': True,
    'align.key_distance_m': 0.0,
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


def test_align_closes_loops_if_their_points_are_kept(start, peer, tmp_path):
    settings = {'loops.enabled': True, 'loops.directory': str(tmp_path), 'window.max_scans': 0}
    extra = [item for k, v in settings.items() for item in ('-p', f'{k}:={v}')]
    node = start('node', *ARGUMENTS, *extra)
    paths = peer.collect(Path, '/surfel_mapper/path', LATCHED)
    sent = driven(peer)
    peer.diagnosis({'scans.mapped': NUM_SCANS})

    answer = peer.call('align')
    peer.spin_until(lambda: paths)

    assert answer.success, answer.message
    loops, _, window = answer.message.partition('; ')
    assert loops == 'no loops found'  # four scans in a row: only the window moves
    assert window == str(aligned_twin(sent)[1])
    assert len(paths[-1].poses) == NUM_SCANS
    assert 'Traceback' not in node.output
