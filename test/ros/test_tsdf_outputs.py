# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The mesh and the slice of a node's TSDF, seen over DDS."""

from __future__ import annotations

from array import array

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from nav_msgs.msg import OccupancyGrid
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from surfel_mapper.sensors.depth import PinholeCamera
from test.messages.test_compressed_image import packed, packed_depth
from test.ros.live import cloud, LATCHED, odometry, stamp, START_NS
from test.ros.test_inputs import arguments, camera_info, OPTICAL
from test.ros.test_node import PERIOD_NS
from test.ros.test_outputs import BASE, start_node
from test.tsdf.scenes import lidar_rays

RADIUS_M = 5.0
SETTINGS = {
    'layers.tsdf.enabled': 'true',
    'layers.tsdf.voxel_size_m': 0.2,
    'layers.tsdf.truncation_m': 0.6,
    'layers.tsdf.mesh_rate_hz': 10.0,
    'layers.tsdf.slice_rate_hz': 10.0,
    'layers.tsdf.slice_height_m': 0.5,
}

MESHES = QoSProfile(depth=50, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def shown(arrays):
    """Return the markers that a viewer shows after some MarkerArrays, by id."""
    found = {}
    for marker in (marker for message in arrays for marker in message.markers):
        if marker.action == Marker.DELETEALL:
            found.clear()
        elif marker.action == Marker.DELETE:
            found.pop(marker.id, None)
        else:
            found[marker.id] = marker
    return found


def num_complete(arrays):
    """Return the number of complete sets in some MarkerArrays; each replaces all before."""
    markers = (marker for message in arrays for marker in message.markers)
    return sum(marker.action == Marker.DELETEALL for marker in markers)


def test_the_sphere_around_a_lidar_comes_as_mesh_slice_and_distances(start, peer):
    rates = {'esdf.rate_hz': 10.0, 'esdf.slice_rate_hz': 10.0, 'esdf.max_m': 1.0}
    start_node(start, peer, **SETTINGS, **rates)
    esdf = peer.collect(PointCloud2, f'{BASE}/esdf', LATCHED)
    esdf_slices = peer.collect(OccupancyGrid, f'{BASE}/esdf_slice', LATCHED)
    meshes = peer.collect(MarkerArray, f'{BASE}/mesh_tiles', MESHES)
    slices = peer.collect(OccupancyGrid, f'{BASE}/tsdf_slice', LATCHED)
    directions = lidar_rays(32, 360, 60.0).reshape(-1, 3)
    peer.publish('/odom', odometry(START_NS, (0.0, 0.0, 0.0)))
    peer.publish('/points', cloud(START_NS, RADIUS_M * directions))

    peer.spin_until(lambda: shown(meshes))
    (mesh,) = shown(meshes).values()  # the tile about the origin
    corners = np.array([(p.x, p.y, p.z) for p in mesh.points])
    middle = (0.1, 0.0, 0.5)  # where the sensor is on the robot
    assert (mesh.type, mesh.action, mesh.header.frame_id) == (Marker.TRIANGLE_LIST, 0, 'odom')
    assert len(corners) == len(mesh.colors) > 3000
    assert len(corners) % 3 == 0
    assert np.abs(np.linalg.norm(corners - middle, axis=1) - RADIUS_M).max() <= 0.1

    whole = peer.collect(Marker, f'{BASE}/mesh', LATCHED)  # the same triangles in one marker
    peer.spin_until(lambda: whole and len(whole[-1].points) == len(corners))
    assert (whole[-1].type, whole[-1].action, whole[-1].header.frame_id) == (11, 0, 'odom')
    one = np.array([(p.x, p.y, p.z) for p in whole[-1].points])
    assert np.array_equal(np.sort(one, axis=0), np.sort(corners, axis=0))

    peer.spin_until(lambda: slices and slices[-1].data)
    grid = slices[-1]
    cost = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    assert grid.info.resolution == pytest.approx(0.2)
    y, x = np.nonzero(cost == 100)
    distance = np.hypot(
        grid.info.origin.position.x + (x + 0.5) * 0.2 - middle[0],
        grid.info.origin.position.y + (y + 0.5) * 0.2,
    )
    assert len(distance) > 50
    assert distance.min() > RADIUS_M - 0.4
    assert (cost == 0).sum() > 500  # the space that rays passed through
    check_distances(peer, esdf, esdf_slices)


def check_distances(peer, clouds, slices):
    peer.spin_until(lambda: clouds and clouds[-1].width > 1000)
    assert [field.name for field in clouds[-1].fields] == ['x', 'y', 'z', 'distance']
    assert clouds[-1].header.frame_id == 'odom'
    rows = np.frombuffer(clouds[-1].data, np.float32).reshape(-1, 4)
    away = RADIUS_M - np.linalg.norm(rows[:, :3] - (0.1, 0.0, 0.5), axis=1)
    level = (np.abs(rows[:, 2] - 0.5) < 1.0) & (away > 0.0)  # the sphere above and below is open
    assert level.sum() > 500
    # between centres of voxels: half a diagonal of 0.2 m, and the half voxel in front
    assert np.abs(rows[level, 3] - away[level]).max() < 0.3
    assert rows[:, 3].min() == 0.0
    assert rows[:, 3].max() < 1.0

    peer.spin_until(lambda: slices and slices[-1].data)
    cost = np.array(slices[-1].data)
    assert {-1, 0, 100} <= set(cost.tolist())
    assert ((cost > 0) & (cost < 100)).sum() > 300


def test_packed_images_are_taken_and_damaged_ones_counted(start, peer):
    depth_topic, info = '/cam/depth/compressedDepth', '/cam/camera_info'
    color_topic = '/cam/color/compressed'
    settings = {
        'input.kind': 'depth',
        'input.topics': [depth_topic],
        'frames.base_to_sensor': OPTICAL,
        'layers.tsdf.enabled': 'true',
        'layers.tsdf.mesh_rate_hz': 10.0,
        'layers.tsdf.color': 'true',
        'layers.tsdf.color_topic': color_topic,
    }
    kinds = {depth_topic: CompressedImage, info: CameraInfo, color_topic: CompressedImage}
    start('node', *arguments(**settings))
    peer.advertise('/odom', *kinds, kinds=kinds)
    meshes = peer.collect(MarkerArray, f'{BASE}/mesh_tiles', MESHES)
    camera = PinholeCamera(width=80, height=60, fx=70.0, fy=70.0, cx=39.5, cy=29.5)
    depth = packed_depth(np.full((60, 80), 2000, np.uint16))
    color = packed(np.full((60, 80, 3), (200, 100, 0), np.uint8), 'rgb8; jpeg compressed', 'JPEG')
    peer.publish(info, camera_info(camera))
    for number in range(2):
        stamp_ns = START_NS + number * PERIOD_NS
        peer.publish('/odom', odometry(stamp_ns, (0.0, 0.0, 0.0)))
        for topic, image in ((color_topic, color), (depth_topic, depth)):
            message = CompressedImage(format=image.format)
            message.data = array('B', image.data[: len(image.data) // (1 + number)])
            message.header.frame_id = 'camera'
            stamp(message, stamp_ns)
            peer.publish(topic, message)
    peer.spin_until(lambda: shown(meshes))
    colors = np.array([(c.r, c.g, c.b) for m in shown(meshes).values() for c in m.colors])
    np.testing.assert_allclose(colors, np.tile([200, 100, 0], (len(colors), 1)) / 255, atol=0.02)
    peer.diagnosis(
        {
            'scans.mapped': 1,
            'scans.dropped.bad_cloud': 1,
            'messages_ignored.bad_image': 1,
        }
    )


def test_a_late_reader_gets_the_whole_mesh_and_then_changes_only(start, peer):
    coarse = {'layers.tsdf.voxel_size_m': 0.4, 'layers.tsdf.truncation_m': 1.2}
    start_node(start, peer, **{**SETTINGS, **coarse, 'layers.tsdf.max_range_m': 100.0})
    meshes = peer.collect(MarkerArray, f'{BASE}/mesh_tiles', MESHES)
    peer.spin_until(lambda: num_complete(meshes) == 1)  # before the first scan, without triangles
    directions = lidar_rays(32, 360, 60.0).reshape(-1, 3)
    half = directions[:, 0] > 0.0
    level = np.abs(directions[:, 2]) < 0.1
    ranges = np.where(half, np.where(level, 30.0, np.nan), RADIUS_M)[:, None]
    peer.publish('/odom', odometry(START_NS, (0.0, 0.0, 0.0)))
    peer.publish('/points', cloud(START_NS, ranges * directions))
    peer.spin_until(lambda: len(shown(meshes)) > 5)
    late = peer.collect(MarkerArray, f'{BASE}/mesh_tiles', MESHES)
    peer.spin_until(lambda: num_complete(meshes) == 2)  # the complete set, for all readers
    peer.spin_until(lambda: late and shown(late).keys() == shown(meshes).keys())
    assert {n: m.points for n, m in shown(late).items()} == {
        n: m.points for n, m in shown(meshes).items()
    }

    # The sphere comes 0.4 m nearer, the half at 30 m stays out of the image.
    near = np.where(half, np.nan, RADIUS_M - 0.4)[:, None] * directions
    peer.publish('/odom', odometry(START_NS + PERIOD_NS, (0.0, 0.0, 0.0)))
    peer.publish('/points', cloud(START_NS + PERIOD_NS, near))

    def changed():
        markers = [marker for message in meshes for marker in message.markers]
        return {marker.id for marker in markers if marker.header.stamp.nanosec == PERIOD_NS}

    peer.spin_until(changed)
    assert changed() < shown(meshes).keys()
