# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Publishers that send nothing to the node: of another type, or of another user."""

from __future__ import annotations

import os
import pwd
import subprocess
import sys
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from sensor_msgs.msg import LaserScan, PointCloud2
from std_msgs.msg import String

from surfel_mapper.cli._ros import check_middleware
from surfel_mapper.errors import DependencyError
from surfel_mapper.ros import publishers
from surfel_mapper.ros.context import UDP_PROFILE
from surfel_mapper.ros.publishers import of_other_types, other_users
from test.ros.driving import ARGUMENTS
from test.ros.live import ROOT

NOBODY = 65534

DRIVER = f"""
import os, time
import rclpy.type_description_service, rclpy.time_source, rclpy.lifecycle, rosgraph_msgs.msg
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
os.setgid({NOBODY})
os.setuid({NOBODY})
rclpy.init()
publisher = Node('driver').create_publisher(PointCloud2, '/points', 10)
while True:
    publisher.publish(PointCloud2())
    time.sleep(0.1)
"""


def test_a_publisher_of_another_type_is_named_with_its_type(peer):
    peer.node.create_publisher(String, '/points', 10)
    peer.spin_until(lambda: peer.node.count_publishers('/points'))
    assert of_other_types(peer.node, '/points', PointCloud2) == (
        '/peer publishes std_msgs/msg/String there, expected sensor_msgs/msg/PointCloud2'
    )
    assert of_other_types(peer.node, '/points', String) == ''


def test_log_and_diagnostics_name_the_type_that_is_published(start, peer):
    node = start('node', *ARGUMENTS)
    peer.node.create_publisher(LaserScan, '/points', 10)
    expected = (
        'publishes sensor_msgs/msg/LaserScan (to convert: laserscan_to_pointcloud_node of '
        'pointcloud_to_laserscan) there, expected sensor_msgs/msg/PointCloud2'
    )
    peer.spin_until(lambda: expected in peer.diagnosis()[0].message)
    node.wait_for_output(expected)
    node.check()


@pytest.mark.parametrize('driver', ['livox_ros_driver', 'livox_ros_driver2'])
def test_the_message_of_livox_is_named_with_the_option_of_its_driver(driver):
    kind = f'{driver}/msg/CustomMsg'
    endpoint = SimpleNamespace(node_namespace='/', node_name='livox', topic_type=kind)
    node = SimpleNamespace(get_publishers_info_by_topic=lambda topic: [endpoint])
    assert of_other_types(node, '/livox/lidar', PointCloud2) == (
        f'/livox publishes {kind} (to convert: livox_ros_driver2 publishes PointCloud2 with '
        'xfer_format 0) there, expected sensor_msgs/msg/PointCloud2'
    )


def test_topics_of_which_a_program_makes_clouds_are_named(start, peer):
    node = start('node', *ARGUMENTS)
    peer.node.create_publisher(LaserScan, '/scan', 10)
    expected = (
        'no publisher of /points; /scan has sensor_msgs/msg/LaserScan (to convert: '
        'laserscan_to_pointcloud_node of pointcloud_to_laserscan)'
    )
    peer.spin_until(lambda: expected in peer.diagnosis()[0].message)
    node.wait_for_output(f'no clouds: {expected}')
    node.check()


def test_other_users_are_those_with_ports_in_the_domain(tmp_path, monkeypatch):
    monkeypatch.setattr(publishers, 'SHARED_MEMORY', tmp_path)
    owner = tmp_path.stat().st_uid
    for name in ('fastrtps_port7400', 'fastrtps_port8150_el', 'fastrtps_0123456789abcdef'):
        (tmp_path / name).write_bytes(b'')
    assert other_users(0, owner) == ''
    assert other_users(0, owner + 1) == pwd.getpwuid(owner).pw_name
    assert other_users(3, owner + 1) == ''
    (tmp_path / 'fastrtps_port8399').write_bytes(b'')
    assert other_users(3, owner + 1) == pwd.getpwuid(owner).pw_name
    assert other_users(4, owner + 1) == ''


@pytest.mark.skipif(os.geteuid() != 0, reason='only root can start a process of another user')
def test_a_driver_of_another_user_is_found_with_both_remedies(start, peer, tmp_path):
    node = start('node', *ARGUMENTS)
    tmp_path.chmod(0o777)
    environment = {**os.environ, 'ROS_LOG_DIR': '/tmp', 'PYTHONPATH': str(ROOT)}
    with subprocess.Popen([sys.executable, '-c', DRIVER], env=environment) as driver:
        try:
            peer.spin_until(lambda: 'of another user (nobody)' in peer.diagnosis()[0].message)
            message = peer.diagnosis()[0].message
        finally:
            driver.kill()
    assert 'Run driver and node as the same user' in message
    assert f'FASTRTPS_DEFAULT_PROFILES_FILE={UDP_PROFILE}' in message
    assert 'of another user (nobody)' in node.output


def test_a_middleware_that_is_not_installed_is_one_line(tmp_path, monkeypatch):
    folder = tmp_path / 'share/ament_index/resource_index/rmw_typesupport'
    folder.mkdir(parents=True)
    for name in ('rmw_fastrtps_cpp', 'rmw_implementation'):
        (folder / name).write_bytes(b'')
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    check_middleware('')
    check_middleware('rmw_fastrtps_cpp')
    with pytest.raises(DependencyError) as refused:
        check_middleware('rmw_zenoh_cpp')
    assert str(refused.value) == (
        'RMW_IMPLEMENTATION is rmw_zenoh_cpp, which is not installed; installed: '
        'rmw_fastrtps_cpp. Unset it, or `sudo apt install ros-jazzy-rmw-zenoh-cpp`'
    )
