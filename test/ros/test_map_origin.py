# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A node with poses in UTM over DDS: topics about its origin, files in UTM, and a second node."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from geometry_msgs.msg import PointStamped
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from surfel_mapper.files.map_state import load_map
from surfel_mapper.files.ply import read_points
from surfel_mapper.messages.pointcloud2 import to_scan
from test.ros.driving import arguments, mapped, send
from test.ros.live import cloud, LATCHED, odometry, room, START_NS
from test.ros.test_outputs import BASE

UTM = np.array([500_123.25, 5_400_321.5, 250.0])
"""Start of the drive; adding it to the poses of the drive is exact."""

NEAR = {
    'auto': [500_224.0, 5_400_576.0, 0.0],
    '500123 5400321.5 250': [500_123.0, 5_400_321.5, 250],
}
"""Values of ``map.origin`` and the origins expected; auto rounds to 1024 voxels of 0.5 m."""

FIXED = {'frames.fixed': 'utm'}


def drive_in_utm(num_scans):
    """Return the messages of a drive that begins at UTM; steps are exact in float64 there."""
    found = []
    for i in range(num_scans):
        stamp_ns = START_NS + i * 100_000_000
        place = UTM + np.array([0.25 * i, -0.125 * i, 0.0])
        points = cloud(stamp_ns, room(seed=i))
        found.append((points, odometry(stamp_ns, place, parent='utm')))
    return found


def about(messages, origin):
    """Return the same messages with poses about an origin."""
    moved = []
    for points, pose in messages:
        p = pose.pose.pose.position
        stamp_ns = points.header.stamp.sec * 10**9 + points.header.stamp.nanosec
        place = np.array([p.x, p.y, p.z]) - origin
        moved.append((points, odometry(stamp_ns, place, parent='utm')))
    return moved


def ordered(places, decimals=3):
    return places[np.lexsort(np.round(places.T, decimals))]


@pytest.mark.parametrize('setting', NEAR)
def test_a_node_in_utm(start, peer, tmp_path, setting):
    origin = np.array(NEAR[setting])
    settings = {'map.origin': setting, 'output.directory': tmp_path / 'maps', 'grid.rate_hz': 20.0}
    node = start('node', *arguments(**FIXED, **settings))
    places = peer.collect(PointStamped, f'{BASE}/origin', LATCHED)
    kinds = {
        'normals': PointCloud2,
        'changed': PointCloud2,
        'removed': PointCloud2,
        'markers': MarkerArray,
        'grid': OccupancyGrid,
    }
    heard = {name: peer.collect(kind, f'{BASE}/{name}') for name, kind in kinds.items()}
    filtered = peer.collect(PointCloud2, f'{BASE}/filtered')
    if setting == 'auto':
        peer.call('clear')
        assert not places, 'the origin is unknown before the first pose'
    peer.advertise('/odom', '/points')
    messages = drive_in_utm(5)
    send(peer, messages)
    peer.diagnosis({'scans.mapped': 5})

    saved = peer.call('save_map')

    assert saved.success, saved.message
    expected = mapped(about(messages, origin), **FIXED)[1].map
    assert saved.message.rpartition('digest ')[2] == expected.digest()
    peer.spin_until(lambda: places)
    assert {message.header.frame_id for message in places} == {'utm'}
    assert [places[-1].point.x, places[-1].point.y, places[-1].point.z] == origin.tolist()
    surfels = expected.surfels(5)
    peer.spin_until(
        lambda: heard['normals'] and heard['normals'][-1].width == len(surfels),
        what=lambda: node.output,
    )
    check_frames(peer, heard)
    found = ordered(to_scan(heard['normals'][-1]).points)
    np.testing.assert_array_equal(found, ordered(surfels.position.astype(np.float32)))
    peer.spin_until(lambda: len(filtered) == 5)
    assert {message.header.frame_id for message in filtered} == {'lidar'}
    check_files(tmp_path / 'maps', surfels, origin)
    assert 'Traceback' not in node.output


def check_frames(peer, heard):
    """Check that all topics of the map are in the frame of its origin."""
    peer.spin_until(lambda: all(heard.values()))
    for name, messages in heard.items():
        parts = messages[-1].markers if name == 'markers' else messages[-1:]
        assert {part.header.frame_id for part in parts} == {'utm_local'}, name


def check_files(directory, surfels, origin):
    """Check that files have UTM coordinates as doubles, and the exact map its origin."""
    columns = read_points(directory / 'map.ply')
    found = np.stack([columns[axis] for axis in 'xyz'], axis=1)
    assert found.dtype == np.float64
    np.testing.assert_allclose(
        ordered(found - origin), ordered(surfels.position), rtol=0, atol=2e-9
    )
    assert load_map(directory / 'map.npz')[0].origin_m.tolist() == origin.tolist()


def test_without_the_setting_the_log_names_it(start, peer):
    node = start('node', *arguments(**FIXED))
    peer.advertise('/odom', '/points')
    send(peer, drive_in_utm(1))

    node.wait_for_output('map.origin')

    topics = {name for name, _ in peer.node.get_topic_names_and_types()}
    assert f'{BASE}/origin' not in topics
