# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The inputs of a node over DDS: several lidars, any QoS, depth images, rolling shutter."""

from __future__ import annotations

from array import array
from itertools import count
import os
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField

from surfel_mapper import Mapper
from surfel_mapper.config import Config
from surfel_mapper.errors import ConfigError
from surfel_mapper.messages.images import CameraImage, depth_scan
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.ros.context import FASTDDS_VARIABLES
from surfel_mapper.ros.inputs import Inputs
from surfel_mapper.sensors.depth import PinholeCamera
from surfel_mapper.simulation import Lidar, Simulation, World
from test.messages.pose_messages import poses_in
from test.ros.live import cloud, odometry, room, stamp, START_NS, TIMEOUT_S

PERIOD_NS = 100_000_000
RELIABLE_QOS = QoSProfile(depth=50)
BEST_EFFORT = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
TURNED = [0.0, 0.0, 0.7071067811865476, 0.7071067811865476]
OPTICAL = [0.0, 0.0, 1.0, -0.5, 0.5, -0.5, 0.5]
FRONT, REAR = [1.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0], [-1.0, 0.3, 0.6, *TURNED]
SETTINGS = {
    'pose.source': 'odometry',
    'frames.base_to_sensor': FRONT,
    'publish.diagnostics_rate_hz': 20.0,
}


def arguments(**changes):
    settings = {**SETTINGS, **changes}
    pairs = [('-p', f'{name}:={value}') for name, value in settings.items()]
    return ['--ros-args', *(item for pair in pairs for item in pair)]


def digest_of(scans, poses, **changes):
    """Return the digest of a Mapper fed with scans and poses."""
    mapper = Mapper(Config.from_mapping({**SETTINGS, **changes}))
    for pose in poses:
        for found in poses_in('odometry', pose, 'base_link'):
            mapper.add_pose(*found)
    for scan in scans:
        mapper.add_scan(scan)
        list(mapper.insert_ready())
    assert mapper.counters.mapped == len(scans)
    return mapper.map.digest()


def node_digest(node):
    assert node.stop() == 0, node.output
    return node.output.rpartition('digest ')[2].split()[0]


def test_several_lidars_are_mapped_with_their_mounting_poses(start, peer):
    settings = {
        'input.topics': ['/front/points', '/rear/points'],
        'frames.sensors': ['front', 'rear'],
        'frames.base_to_sensor': [*FRONT, *REAR],
    }
    node = start('node', *arguments(**settings))
    peer.advertise('/odom', '/front/points', '/rear/points')
    clouds, poses = [], []
    for number in range(8):
        stamp_ns = START_NS + number * PERIOD_NS // 2
        side = ('front', 'rear')[number % 2]
        poses.append(odometry(stamp_ns, (0.1 * number, 0.0, 0.0)))
        clouds.append(cloud(stamp_ns, room(seed=number), frame_id=side))
        peer.spin_for(0.03)
        peer.publish('/odom', poses[-1])
        peer.publish(f'/{side}/points', clouds[-1])
    peer.diagnosis({'scans.mapped': 8})

    expected = digest_of([to_scan(message) for message in clouds], poses, **settings)
    assert node_digest(node) == expected
    assert 'reads /odom, /front/points, /rear/points' in node.output


def test_reliable_and_best_effort_publishers_are_mapped_after_a_restart(start, peer):
    node = start('node', *arguments())
    peer.advertise('/odom')
    number = 0
    for qos in (RELIABLE_QOS, BEST_EFFORT, RELIABLE_QOS):
        publisher = peer.node.create_publisher(PointCloud2, '/points', qos)
        peer.spin_until(publisher.get_subscription_count)
        peer.meet()
        for _ in range(2):
            stamp_ns = START_NS + number * PERIOD_NS
            peer.publish('/odom', odometry(stamp_ns, (0.1 * number, 0.0, 0.0)))
            publisher.publish(cloud(stamp_ns, room(seed=number, num=500)))
            peer.spin_for(0.1)
            number += 1
        used = 'best effort' if qos is BEST_EFFORT else 'reliable'
        peer.diagnosis({'scans.mapped': number, 'qos./points': used})
        peer.node.destroy_publisher(publisher)
    assert node.is_running()


def depth_image(stamp_ns, depth, encoding):
    message = Image(height=depth.shape[0], width=depth.shape[1], encoding=encoding)
    message.step = depth.strides[0]
    message.data = array('B', depth.tobytes())
    message.header.frame_id = 'camera'
    stamp(message, stamp_ns)
    return message


def camera_info(camera):
    K = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    return CameraInfo(width=camera.width, height=camera.height, k=K)


def test_depth_images_are_mapped_with_their_calibration(start, peer):
    settings = {'input.kind': 'depth', 'frames.base_to_sensor': OPTICAL}
    image, info = '/camera/depth/image_raw', '/camera/depth/camera_info'
    node = start(
        'node',
        *arguments(**settings),
        *('-r', f'depth/image:={image}'),
    )
    peer.advertise('/odom', image, info, kinds={image: Image, info: CameraInfo})
    camera = PinholeCamera(width=640, height=480, fx=560.0, fy=560.0, cx=319.5, cy=239.5)
    rng = np.random.default_rng(1)
    images, poses = [], []
    for number in range(4):
        stamp_ns = START_NS + number * PERIOD_NS
        depth = rng.uniform(2000.0, 2200.0, (480, 640)).astype(np.uint16)
        depth[:5] = 0
        images.append(depth_image(stamp_ns, depth, '16UC1'))
        poses.append(odometry(stamp_ns, (0.1 * number, 0.0, 0.0)))
        peer.publish('/odom', poses[-1])
        peer.publish(image, images[-1])
        if number == 1:  # the first images wait for the camera info
            peer.spin_for(0.2)
            peer.publish(info, camera_info(camera))
            peer.spin_for(0.2)
    bad = depth_image(START_NS + 4 * PERIOD_NS, np.zeros((60, 80), np.uint8), 'mono8')
    peer.publish(image, bad)
    _, values = peer.diagnosis({'scans.mapped': 4, 'scans.dropped.bad_cloud': 1})

    scans = [depth_scan(CameraImage(message, camera)) for message in images]
    assert node_digest(node) == digest_of(scans, poses, **settings)
    assert "encoding 'mono8', expected 16UC1 or 32FC1" in node.output
    assert values['scans.received'] == '5'


def rolling_cloud(scan):
    """Return a simulated scan as a cloud with a time per point, in the layout of Ouster."""
    dtype = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('t', '<u4')])
    points = np.zeros(len(scan), dtype)
    for axis, name in enumerate('xyz'):
        points[name] = scan.points[:, axis]
    points['t'] = np.rint(scan.columns['time'].astype(np.float64) * 1e9)
    message = cloud(scan.stamp_ns, np.zeros((1, 3)))
    message.fields.append(PointField(name='t', offset=12, datatype=6, count=1))
    message.width, message.point_step, message.row_step = len(scan), 16, 16 * len(scan)
    message.data = array('B', points.tobytes())
    return message


def test_live_deskewing_equals_offline_deskewing(start, peer):
    world = World.street(seed=0, length_m=40.0)
    simulation = Simulation(world, Lidar(beams=8, columns=256), num_scans=3, rolling=True)
    settings = {
        'deskew.enabled': 'true',
        'frames.base_to_sensor': list(simulation.drive.base_to_sensor),
    }
    node = start('node', *arguments(**settings))
    peer.advertise('/odom', '/points')
    clouds, poses = [], []
    for number in range(simulation.num_scans):
        clouds.append(rolling_cloud(simulation.scan(number)))
        first = simulation.stamp_ns(number)
        peer.publish('/points', clouds[-1])  # its poses follow
        for stamp_ns in range(first, first + PERIOD_NS, PERIOD_NS // 5):
            poses.append(moving(simulation, stamp_ns))
            peer.publish('/odom', poses[-1])
            peer.spin_for(0.02)
    poses.append(moving(simulation, first + PERIOD_NS))
    peer.publish('/odom', poses[-1])
    peer.diagnosis({'scans.mapped': 3})

    settings['deskew.enabled'] = True
    scans = [to_scan(message) for message in clouds]
    deskewed = digest_of(scans, poses, **settings)
    assert deskewed != digest_of(scans, poses, **{**settings, 'deskew.enabled': False})
    assert node_digest(node) == deskewed


def moving(simulation, stamp_ns):
    xyz, q_xyzw = simulation.drive.pose(stamp_ns)
    message = odometry(stamp_ns, xyz)
    orientation = message.pose.pose.orientation
    orientation.x, orientation.y, orientation.z, orientation.w = q_xyzw.tolist()
    return message


def inputs_of(config, publishers=()):
    node = SimpleNamespace(
        resolve_topic_name=lambda name: f'/{name}',
        get_publishers_info_by_topic=lambda topic: publishers,
        get_logger=lambda: SimpleNamespace(warning=lambda *_, **__: None),
        get_clock=Clock,
    )
    thread = SimpleNamespace(put_cloud=lambda *_: None, refuse_cloud=lambda *_: None)
    return Inputs(node, config, thread, on_failure=None)


@pytest.mark.parametrize(
    ('settings', 'message'),
    [
        ({'input.topics': ['bad topic']}, "^input.topics: 'bad topic' is no name of a topic: .*"),
        ({'input.topics': ['/a', '{nope}/y']}, "^input.topics: '{nope}/y' .*unknown substitution"),
        ({'input.topics': ['points', '/points']}, r"'/points'\], expected names that differ"),
        ({'input.topics': ['~/a', '/peer/a']}, r"'/peer/a'\], expected names that differ"),
        (
            {'layers.tsdf.color_topic': 'a b', 'layers.tsdf.color': True},
            "^layers.tsdf.color_topic: 'a b' is no name of a topic: .* characters",
        ),
    ],
)
def test_invalid_and_repeated_topics_are_refused_by_name(guarded_peer, settings, message):
    settings = {'input.kind': 'depth', 'layers.tsdf.enabled': True, **SETTINGS, **settings}
    with pytest.raises(ConfigError, match=message) as refused:
        Inputs(guarded_peer.node, Config.from_mapping(settings), None, on_failure=None)
    assert '.c:' not in str(refused.value)


def test_the_most_silent_of_several_lidars_is_found():
    inputs = inputs_of(Config.from_mapping({**SETTINGS, 'input.topics': ['front', 'rear']}))
    before = time.monotonic()
    inputs._on_cloud('/front', b'')
    topic, heard_s = inputs.most_silent
    assert topic == '/rear'
    assert heard_s <= before
    inputs._on_cloud('/rear', b'')
    assert inputs.most_silent[0] == '/front'


@pytest.mark.skipif(any(map(os.environ.get, FASTDDS_VARIABLES)), reason='Fast DDS is configured')
def test_lost_large_clouds_are_reported_with_a_remedy(start, peer):
    node = start('node', *arguments(**{'pose.source': 'identity'}))
    publisher = peer.node.create_publisher(PointCloud2, '/points', BEST_EFFORT)
    peer.spin_until(publisher.get_subscription_count)
    reports = peer.collect(DiagnosticArray, '/diagnostics')
    # of 4 MiB shared memory holds an eighth, of 0.5 MB all: such a cloud arrives, also under load
    large, small = np.zeros((350_000, 3), np.float32), np.zeros((42_000, 3), np.float32)
    stamps = count(START_NS, PERIOD_NS)

    def publish_until(is_reported):
        """Publish a small cloud after each report."""
        end, num_reports = time.monotonic() + TIMEOUT_S, 0
        while not is_reported():
            assert time.monotonic() < end, node.output
            if len(reports) > num_reports:
                publisher.publish(cloud(next(stamps), small))
                num_reports = len(reports)
            peer.spin_once()

    publish_until(lambda: 'too near' in node.output)  # losses count from the first that arrives
    with node.paused():  # a reader that takes nothing loses what shared memory cannot hold
        for _ in range(10):
            publisher.publish(cloud(next(stamps), large))
    publish_until(
        lambda: any('clouds lost on the way' in report.status[0].message for report in reports)
    )
    node.wait_for_output('fastdds_shm.xml')


def test_an_override_that_loses_large_clouds_is_named():
    publisher = SimpleNamespace(
        node_namespace='/robot', node_name='lidar', qos_profile=RELIABLE_QOS
    )
    inputs = inputs_of(Config.from_mapping(SETTINGS), [publisher])
    inputs.subscriptions.reliabilities = lambda: {'/points': 'best effort'}
    inputs._on_cloud('/points', bytes(4_000_000))
    inputs._on_lost('/points', 0, 5)
    assert inputs.clouds_lost == 5
    said = inputs.loss()
    assert said.endswith('their publisher is reliable, but qos_overrides says best_effort')
