# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The outputs of a node over DDS: changes, mirrors, scan normals, markers, grids."""

from __future__ import annotations

from array import array
from functools import partial

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetMap
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from scipy.spatial import cKDTree
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from surfel_mapper import MapMirror, Surfels
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.messages.scan_normals import ADDED
from surfel_mapper.messages.surfel_markers import normal_colors, SEGMENTS, shades
from test.ros.driving import arguments, drive, mapped, PERIOD_NS, send
from test.ros.live import LATCHED, RVIZ, START_NS

MANY = QoSProfile(depth=200)
BASE = '/surfel_mapper'


def stamp_of(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def start_node(start, peer, **changes):
    node = start('node', *arguments(**changes))
    peer.advertise('/odom', '/points')
    return node


def digest_of(peer):
    """Return the digest of the node's map after everything sent before."""
    return peer.call('save_map').message.rpartition('digest ')[2]


def test_a_mirror_equals_the_map_of_the_node(start, peer, tmp_path):
    settings = {'map.intensity': 'true', 'publish.moments': 'true'}
    node = start_node(start, peer, **settings, **{'output.directory': tmp_path / 'maps'})
    mirror = MapMirror(0.5, ('intensity',))
    for topic, take, qos in (
        ('changed', mirror.change, MANY),
        ('normals', mirror.replace, LATCHED),
    ):
        peer.node.create_subscription(PointCloud2, f'{BASE}/{topic}', take, qos)
    peer.spin_until(lambda: peer.node.count_publishers(f'{BASE}/changed'))
    messages = [(with_intensity(points), pose) for points, pose in drive(9)]

    def is_up_to_date():
        digest = digest_of(peer)
        peer.spin_for(0.2)
        return mirror.map.digest() == digest

    send(peer, messages[:6])
    peer.spin_until(is_up_to_date, what=lambda: f'{mirror.map.digest()}: {node.output}')
    assert len(mirror.map) > 500
    peer.call('clear_radius')
    peer.spin_until(is_up_to_date, what=lambda: node.output)
    send(peer, messages[6:])
    peer.spin_until(is_up_to_date, what=lambda: node.output)
    assert mirror.stamp_ns == START_NS + 8 * PERIOD_NS
    peer.call('clear')
    peer.spin_until(is_up_to_date, what=lambda: node.output)
    assert len(mirror.map) == 0


def with_intensity(points):
    """Return a cloud whose intensity is its y."""
    old = np.frombuffer(points.data, np.uint8).reshape(-1, points.point_step)
    start, offset = points.fields[1].offset, points.point_step
    field = type(points.fields[1])(name='intensity', offset=offset, datatype=7, count=1)
    points.fields = [*points.fields, field]
    points.point_step = offset + 4
    points.row_step = points.width * points.point_step
    points.data = array('B', np.hstack([old, old[:, start : start + 4]]).tobytes())
    return points


def test_adaptive_surfels_are_published_with_their_changes(start, peer):
    node = start_node(start, peer, **{'publish.adaptive': 'true', 'publish.covariance': 'true'})
    changed = peer.collect(PointCloud2, f'{BASE}/changed', MANY)
    removed = peer.collect(PointCloud2, f'{BASE}/removed', MANY)
    normals = peer.collect(PointCloud2, f'{BASE}/normals', LATCHED)
    markers = peer.collect(MarkerArray, f'{BASE}/markers', LATCHED)
    messages = drive(8)
    send(peer, messages)
    expected = mapped(messages)[1].map.adaptive(5)
    assert len(np.unique(expected.size)) > 2
    peer.spin_until(
        lambda: normals and normals[-1].width == len(expected), what=lambda: node.output
    )
    peer.spin_until(lambda: markers and len(changed) == len(removed) >= len(messages))

    def cells(message):
        columns = to_scan(message).columns
        if not columns:
            return set()
        rows = [columns[name] for name in ('size', 'voxel_x', 'voxel_y', 'voxel_z')]
        return set(zip(*(row.tolist() for row in rows), strict=True))

    known = set()
    for now, gone in zip(changed, removed, strict=True):
        assert cells(gone) <= known
        known = (known - cells(gone)) | cells(now)
    assert known == cells(normals[-1])
    index = expected.voxel_index.tolist()
    assert known == {(s, *i) for s, i in zip(expected.size.tolist(), index, strict=True)}
    assert 'cov_xx' in to_scan(normals[-1]).columns
    assert Surfels.from_message(normals[-1]).num_points.sum() == expected.num_points.sum()


def test_the_full_map_is_published_on_request(start, peer):
    start_node(start, peer, **{'publish.normals_rate_hz': 0.0})
    late = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    messages = drive(2)
    send(peer, messages)
    peer.diagnosis({'scans.mapped': 2})
    normals = peer.collect(PointCloud2, f'{BASE}/normals', late)
    peer.spin_for(0.5)  # within which it would come at the usual rate
    assert normals == []

    answer = peer.call('publish_normals')

    number = len(mapped(messages)[1].map.surfels(5))
    assert (answer.success, answer.message) == (True, f'{number:,} surfels published')
    peer.spin_until(lambda: normals)
    assert normals[0].width == number
    again = peer.collect(PointCloud2, f'{BASE}/normals', late)
    peer.spin_until(lambda: again)
    assert again[0].width == number


def test_coarser_levels_are_published(start, peer):
    start_node(start, peer, **{'publish.levels': 2, 'map.min_points': 3})
    clouds = [peer.collect(PointCloud2, f'{BASE}/level_{n}/normals', LATCHED) for n in (1, 2)]
    messages = drive(4)
    send(peer, messages)
    surfel_map = mapped(messages)[1].map
    peer.diagnosis({'scans.mapped': 4})
    for level, received in enumerate(clouds, 1):
        surfels = surfel_map.coarsen(level).surfels(3)
        peer.spin_until(partial(holds_all, received, surfels))


def holds_all(received, surfels):
    """Return whether the last message holds these surfels, in any order."""
    if not received or received[-1].width != len(surfels):
        return False
    found = to_scan(received[-1])
    distance_m, match = cKDTree(surfels.position).query(found.points)
    numbers = found.columns['num_points'].tolist()
    return bool(
        distance_m.max() <= 1e-5
        and len(set(match)) == len(surfels)
        and numbers == surfels.num_points[match].tolist()
    )


def test_surfels_have_mean_intensity_and_covariance_if_configured(start, peer):
    start_node(start, peer, **{'map.intensity': 'true', 'publish.covariance': 'true'})
    normals = peer.collect(PointCloud2, f'{BASE}/normals', LATCHED)
    send(peer, [(with_intensity(points), pose) for points, pose in drive(1)])
    peer.spin_until(lambda: normals and normals[-1].width)
    scan = to_scan(normals[-1])
    assert 'intensity' in scan.columns
    # the intensity of a point is its y, and the sensor is not turned
    np.testing.assert_allclose(scan.columns['intensity'], scan.points[:, 1], atol=0.01)
    surfels = Surfels.from_message(normals[-1])
    xx, xy, xz, yy, yz, zz = surfels.covariance.T
    flat = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    radius = np.sqrt(2.0 * np.linalg.eigvalsh(flat)[:, 1:].sum(axis=1))
    np.testing.assert_allclose(radius, surfels.radius, rtol=1e-3, atol=1e-4)


def test_scan_normals_keep_every_field_of_the_cloud(start, peer):
    node = start_node(start, peer)
    messages = drive(4)
    send(peer, messages[:3])
    peer.diagnosis({'scans.mapped': 3})
    found = peer.collect(PointCloud2, f'{BASE}/scan_normals')
    send(peer, messages[3:])
    peer.spin_until(lambda: found, what=lambda: node.output)

    (message,), sent = found, messages[3][0]
    assert (message.header, message.height) == (sent.header, sent.height)
    given, again = to_scan(sent), to_scan(message)
    np.testing.assert_array_equal(again.points, given.points)
    assert list(again.columns) == [*given.columns, *ADDED]
    for name, values in given.columns.items():
        np.testing.assert_array_equal(again.columns[name], values)
    known = again.columns['num_points'] > 0
    assert 0.3 < known.mean() < 1.0
    assert (np.isfinite(again.columns['planarity']) == known).all()


def colors_of(marker):
    colors = np.array([(c.r, c.g, c.b, c.a) for c in marker.colors], np.float32)
    return colors[:: 3 * (SEGMENTS - 2)]


def test_markers_follow_colour_limit_and_clearing(start, peer):
    start_node(start, peer, **{'publish.marker_color': 'normal'})
    messages = drive(3)
    send(peer, messages)
    surfels = mapped(messages)[1].map.surfels(5)
    markers = peer.collect(MarkerArray, f'{BASE}/markers', RVIZ)
    peer.spin_until(lambda: markers and len(markers[-1].markers[1].points) == 2 * len(surfels))

    def is_shown(expected):
        shown = colors_of(markers[-1].markers[0])
        return len(shown) == len(expected) and np.array_equal(
            np.unique(shown, axis=0), np.unique(expected, axis=0)
        )

    assert is_shown(normal_colors(surfels.normal))
    client = peer.parameters()

    def change(name, value):
        done = peer.result(client.set_parameters([Parameter(name, value=value)]))
        assert done.results[0].successful

    change('publish.marker_color', 'planarity')
    peer.spin_until(lambda: is_shown(shades(surfels.planarity)))
    change('publish.marker_color', 'age')
    peer.spin_until(lambda: 1 < len(np.unique(colors_of(markers[-1].markers[0]), axis=0)) <= 3)
    assert peer.call('clear').success
    peer.spin_until(lambda: {m.action for m in markers[-1].markers} == {Marker.DELETE})


def test_the_grid_is_published_latched_and_returned_on_request(start, peer):
    start_node(start, peer, **{'grid.size_m': 20.0})
    assert set(peer.call('get_grid', GetMap).map.data) == {-1}
    send(peer, drive(3))
    peer.diagnosis({'scans.mapped': 3})
    client = peer.parameters()
    done = peer.result(client.set_parameters([Parameter('grid.rate_hz', value=10.0)]))
    assert done.results[0].successful
    grids = peer.collect(OccupancyGrid, f'{BASE}/grid', LATCHED)
    peer.spin_until(lambda: grids)
    for grid in (grids[-1], peer.call('get_grid', GetMap).map):
        check_grid(grid)


def check_grid(grid):
    assert (grid.header.frame_id, grid.info.resolution) == ('odom', 0.5)
    assert stamp_of(grid) == START_NS + 2 * PERIOD_NS
    assert (grid.info.width, grid.info.height) == (40, 40)
    cost = np.array(grid.data).reshape(40, 40)
    origin = grid.info.origin.position
    # the floor under the sensor is free, the wall at y = 3.3 is not
    column, row = int((0.9 - origin.x) / 0.5), int((0.0 - origin.y) / 0.5)
    assert 0 <= cost[row, column] < 50
    assert cost[int((3.3 - origin.y) / 0.5), column] == 100
    assert cost[0, 0] == -1
