# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The node without any odometry, talked to over DDS: it finds its poses and publishes them."""

from __future__ import annotations

import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path

from surfel_mapper.config import Config
from surfel_mapper.files.map_state import save_map
from surfel_mapper.files.ply import write_points
from surfel_mapper.geometry import pose_matrix, q_xyzw
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.pipeline import Mapper
from surfel_mapper.ros.pose_outputs import covariance
from test.alignment.test_registration import map_of, points_on, ROOM
from test.pipeline.test_registered_poses import in_hall, pose_at, scan_at
from test.ros.live import cloud, LATCHED, RVIZ, START_NS

PERIOD_NS = 100_000_000
SETTINGS = {'pose.source': 'registration', 'registration.noise_m': 0.005}


def arguments(**more):
    settings = {**SETTINGS, **{name.replace('__', '.'): value for name, value in more.items()}}
    parameters = (item for name, value in settings.items() for item in ('-p', f'{name}:={value}'))
    return ['--ros-args', *parameters]


def clouds(numbers):
    return [cloud(START_NS + n * PERIOD_NS, scan_at(n).points) for n in numbers]


def pose_of(message):
    p, q = message.pose.pose.position, message.pose.pose.orientation
    return pose_matrix((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def send(peer, messages):
    for message in messages:
        time.sleep(0.05)
        peer.publish('/points', message)


def test_odometry_and_track_are_those_that_a_mapper_finds(start, peer):
    node = start('node', *arguments())
    node.wait_for_output('ready')
    found = peer.collect(Odometry, '/surfel_mapper/odometry', RVIZ)
    tracks = peer.collect(Path, '/surfel_mapper/track', LATCHED)
    peer.advertise('/points')
    messages = clouds(range(6))

    send(peer, messages)
    peer.spin_until(lambda: len(found) == 6, what=lambda: node.output)

    mapper = Mapper(Config.from_mapping(SETTINGS))
    for message, odometry in zip(messages, found, strict=True):
        mapper.add_scan(to_scan(message))
        (update,) = mapper.insert_ready()
        np.testing.assert_allclose(pose_of(odometry), update.T_fixed_body, rtol=0.0, atol=1e-12)
        linear = odometry.twist.twist.linear
        np.testing.assert_allclose(
            [linear.x, linear.y, linear.z], mapper.registered.twist[:3], atol=1e-12
        )
        assert (odometry.header.frame_id, odometry.child_frame_id) == ('odom', 'lidar')
    assert 0.0 < found[-1].pose.covariance[0] < 1e-3
    assert tracks[0].header.frame_id == 'odom'
    assert node.stop() == 0
    assert mapper.map.digest() in node.output


def test_registration_on_a_frozen_map_starts_from_an_initial_pose(start, peer, tmp_path):
    save_map(tmp_path / 'room.npz', map_of(ROOM))
    far_off = '[40.0, -30.0, 0.0, 0.0, 0.0, 0.0, 1.0]'
    node = start(
        'node',
        *arguments(map__mode='frozen', map__load='room.npz', registration__start=far_off),
    )
    node.wait_for_output('ready')
    found = peer.collect(Odometry, '/surfel_mapper/odometry', RVIZ)
    peer.advertise('/points')
    peer.advertise('/initialpose', kinds={'/initialpose': PoseWithCovarianceStamped})
    send(peer, clouds([0]))
    node.wait_for_output('cells meet a surfel')

    message = PoseWithCovarianceStamped()
    message.header.frame_id = 'x' * 10**4
    peer.publish('/initialpose', message)
    node.wait_for_output('initial pose ignored: frame ')
    message.header.frame_id = '/odom'  # the slash of ROS 1 is no part of the name
    p, q = message.pose.pose.position, message.pose.pose.orientation
    p.x, p.y, p.z = (pose_at(0)[:3, 3] + [0.4, -0.3, 0.0]).tolist()
    q.x, q.y, q.z, q.w = q_xyzw(pose_at(0)).tolist()
    peer.publish('/initialpose', message)
    node.wait_for_output('continues from the initial pose ')
    send(peer, clouds([1, 2]))
    peer.spin_until(lambda: len(found) == 2, what=lambda: node.output)

    for number, odometry in enumerate(found, 1):
        np.testing.assert_allclose(pose_of(odometry), pose_at(number), atol=5e-3)
    assert node.stop() == 0
    assert map_of(ROOM).digest() in node.output


def test_a_cloud_is_a_map_to_localise_on_without_an_initial_pose(start, peer, tmp_path):
    columns = dict(zip('xyz', points_on(ROOM, 100, seed=50).astype(np.float32).T, strict=True))
    write_points(tmp_path / 'room.ply', columns)
    node = start('node', *arguments(map__mode='frozen', map__load='room.ply'))
    node.wait_for_output('ready')
    odometry = peer.collect(Odometry, '/surfel_mapper/odometry', RVIZ)
    peer.advertise('/points')

    send(peer, clouds(range(6)))
    peer.spin_until(lambda: len(odometry) == 6, what=lambda: node.output)

    for number, message in enumerate(odometry):
        np.testing.assert_allclose(pose_of(message), pose_at(number), atol=5e-3)
    assert 'its initial pose is unknown, and searched for in the map' in node.output
    assert 'first scan localised: ' in node.output
    assert node.stop() == 0


def test_diagnostics_name_the_reason_and_the_remedy_without_a_place(start, peer, tmp_path):
    save_map(tmp_path / 'room.npz', map_of(ROOM))
    more = arguments(map__mode='frozen', map__load='room.npz', publish__diagnostics_rate_hz=20.0)
    node = start('node', *more)
    node.wait_for_output('ready')
    peer.advertise('/points')
    scans = [in_hall(number, np.eye(4)) for number in range(3)]

    send(peer, [cloud(START_NS + n * PERIOD_NS, scan.points) for n, scan in enumerate(scans)])

    text = 'the newest 3 scans have no certain place on the map: its initial pose is unknown'
    peer.spin_until(lambda: text in peer.diagnosis()[0].message, what=lambda: node.output)
    message = peer.diagnosis()[0].message
    assert 'publish the pose of the robot on /initialpose' in message
    assert 'is mapped yet' not in message
    assert node.stop() == 0


def test_covariance_is_huge_without_information():
    information = np.diag([1e4, 0.0, 1e4, 1e6, 1e6, 1e6])

    found = np.diag(covariance(information))

    assert found[0] == pytest.approx(1e-4)
    assert found[1] == pytest.approx(1e6)
