# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A node without settings finds its poses and its clouds, and states its choice."""

from __future__ import annotations

import time

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from surfel_mapper import Config
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.request import Request
from surfel_mapper.ros import pose_inputs
from surfel_mapper.ros.clock_watch import ClockWatch
from surfel_mapper.ros.pose_inputs import PoseInputs
from surfel_mapper.ros.topic_search import TopicSearch
from test.bags import recorded
from test.ros.driving import drive
from test.ros.live import Peer, START_NS

DEFAULTS = ['--ros-args', '-p', 'publish.diagnostics_rate_hz:=20.0']
PATIENT = [*DEFAULTS, '-p', 'pose.registration_after_s:=3600.0']  # on a loaded machine too
COVARIANCE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
MOUNT = ['-p', 'frames.base_to_sensor:=[0.1, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]']


def publishers(peer, *topics, kinds=None):
    """Create publishers, without waiting for readers."""
    for topic in topics:
        kind = (kinds or {}).get(topic, Odometry if topic.endswith('odom') else PointCloud2)
        peer._publishers[topic] = peer.node.create_publisher(kind, topic, 50)


def send(peer, messages, odom='/odom', points='/points'):
    """Send clouds with their poses."""
    for cloud, pose in messages:
        peer.publish(odom, pose)
        peer.publish(points, cloud)


def test_odometry_is_taken_and_clouds_before_the_choice_are_mapped(start, peer):
    node = start('node', *PATIENT, *MOUNT)
    peer.advertise('/odom', '/points')
    send(peer, drive(3))

    _, values = peer.diagnosis({'scans.mapped': 3, 'waiting': 0})

    assert values['pose_source'] == 'odometry'
    assert values['pose_reason'].startswith('/odom has them; not from tf: ')
    assert f'pose.source auto takes odometry: {values["pose_reason"]}' in node.output
    assert 'registration' not in node.output


def test_the_only_topics_of_clouds_and_odometry_need_no_setting(start, peer):
    publishers(peer, '/velodyne_points', '/husky/odom')
    node = start('node', *PATIENT, '-p', 'frames.base:=lidar')
    peer.wait_until_read('/velodyne_points', '/husky/odom')
    messages = drive(2)
    for _, pose in messages:
        pose.child_frame_id = 'lidar'
    send(peer, messages, '/husky/odom', '/velodyne_points')

    _, values = peer.diagnosis({'scans.mapped': 2})

    assert values['pose_reason'].startswith('/husky/odom has them (-r odom:=/husky/odom)')
    assert 'as with -r points:=/velodyne_points' in node.output


def test_scans_of_a_sensor_without_a_mount_are_dropped_with_the_remedy(start, peer):
    node = start('node', *PATIENT)
    peer.advertise('/odom', '/points')
    send(peer, drive(10))

    _, values = peer.diagnosis({'scans.dropped.no_pose': 4})  # those older by pose.max_wait_s

    assert (values['pose_source'], values['scans.mapped']) == ('odometry', '0')
    assert 'no transforms lead from odom to lidar: set frames.base_to_sensor' in node.output
    assert 'a sensor without a transform needs frames.base_to_sensor' in node.output


@pytest.mark.parametrize(
    ('parent', 'says'),
    [
        ('odom', 'from map to lidar: the poses are in odom: set frames.fixed: odom'),
        ('base_link', 'from map to lidar: the poses are of base_link in itself'),
    ],
)
def test_poses_in_another_frame_are_named_with_the_setting(start, peer, parent, says):
    node = start('node', *PATIENT, *MOUNT, '-p', 'frames.fixed:=map')
    peer.advertise('/odom', '/points')
    messages = drive(2)
    for _, pose in messages:
        pose.header.frame_id = parent
    send(peer, messages)
    node.wait_for_output(says)


def test_a_publisher_without_messages_is_named(start, peer):
    node = start('node', *PATIENT, *MOUNT)
    peer.advertise('/odom', '/points')
    for cloud, _ in drive(1):
        peer.publish('/points', cloud)
    node.wait_for_output('/odom: no message yet, scans wait for its poses')


def test_the_wait_for_the_choice_is_no_latency(start, peer):
    start('node', *PATIENT, *MOUNT, '-p', 'use_sim_time:=true')
    clock = peer.node.create_publisher(Clock, '/clock', 10)
    peer.spin_until(clock.get_subscription_count)
    peer.advertise('/odom', '/points')
    reports = peer.collect(DiagnosticArray, '/diagnostics')
    now = Clock()
    now.clock.sec = START_NS // 10**9 + 3

    def is_heard():
        clock.publish(now)
        return reports and reports[-1].header.stamp == now.clock

    peer.spin_until(is_heard)
    send(peer, drive(1))
    _, values = peer.diagnosis({'scans.mapped': 1})
    assert values['latency_ms.p99'] == '0.0'


def test_pose_messages_are_taken_without_odometry(start, peer):
    node = start('node', *PATIENT, '-p', 'frames.base:=lidar')
    peer.advertise('/pose', '/points', kinds={'/pose': PoseStamped})
    for cloud, moved in drive(2):
        peer.publish('/pose', PoseStamped(header=moved.header, pose=moved.pose.pose))
        peer.publish('/points', cloud)

    _, values = peer.diagnosis({'scans.mapped': 2})

    assert values['pose_source'] == 'pose', node.output
    assert 'not from odometry: no publisher of /odom' in values['pose_reason']


@pytest.mark.parametrize('source', ['auto', 'pose'])
def test_pose_messages_with_covariance_are_taken(start, peer, source):
    node = start('node', *PATIENT, *MOUNT, '-p', f'pose.source:={source}')
    kinds = {'/pose': PoseWithCovarianceStamped}
    publishers(peer, '/pose', '/points', kinds=kinds)
    peer.wait_until_read('/points')
    peer.spin_until(lambda: types_read(peer, '/pose') == {COVARIANCE}, what=lambda: node.output)
    peer.wait_until_read('/pose')
    messages = [
        (cloud, PoseWithCovarianceStamped(header=odom.header, pose=odom.pose))
        for cloud, odom in drive(3)
    ]
    send(peer, messages, odom='/pose')

    _, values = peer.diagnosis({'scans.mapped': 3, 'waiting': 0})

    assert values['pose_source'] == 'pose'


def types_read(peer, topic):
    """Return the types of the subscriptions to a topic."""
    return {info.topic_type for info in peer.node.get_subscriptions_info_by_topic(topic)}


def test_odometry_that_comes_after_the_clouds_is_taken(start, peer):
    node = start('node', *PATIENT, *MOUNT)
    peer.advertise('/points')
    (first, _), *others = drive(3)
    peer.publish('/points', first)
    peer.diagnosis({'waiting': 1, 'pose_source': 'not chosen yet'})
    peer.advertise('/odom')
    send(peer, others)

    _, values = peer.diagnosis({'scans.mapped': 2, 'pose_source': 'odometry'})

    assert values['scans.dropped.no_pose'] == '1', node.output  # before the first pose


def test_registration_is_taken_with_a_warning_if_no_poses_come(start, peer):
    node = start('node', *DEFAULTS, '-p', 'pose.registration_after_s:=1.0')
    peer.advertise('/points')
    cloud, _ = drive(1)[0]
    peer.publish('/points', cloud)

    status, values = peer.diagnosis({'scans.mapped': 1})

    assert values['pose_source'] == 'registration'
    for text in (status.message, node.output):
        assert 'pose.source auto takes registration: no topic gives the poses' in text
        assert 'not from odometry: no publisher of /odom' in text
        assert '-p pose.source:=tf, odometry or pose' in text
    assert status.level != status.OK


def test_several_topics_are_named_with_the_line_to_type(start, peer):
    publishers(peer, '/front', '/rear', '/a/odom', '/b/odom')
    node = start('node', *PATIENT)
    text = 'no publisher of /points; choose with -r points:=/front or -r points:=/rear'
    node.wait_for_output(text)
    status, values = peer.diagnosis({'pose_source': 'not chosen yet'})
    assert text in status.message
    assert 'choose with -r odom:=/a/odom or -r odom:=/b/odom' in values['pose_reason']


def test_a_configured_source_is_kept(start, peer):
    start('node', *PATIENT, *MOUNT, '-p', 'pose.source:=identity')
    peer.advertise('/points')
    _, values = peer.diagnosis({'state': 'active'})
    assert (values['pose_source'], values['pose_reason']) == ('identity', 'configured')


def test_only_topics_of_the_own_namespace_are_read_instead(domain):
    robot = Peer(['--ros-args', '-r', '__ns:=/robot', '-r', 'odom:=wheels'])
    try:
        search = TopicSearch(robot.node, 'points', PointCloud2)
        robot.node.create_publisher(PointCloud2, '/other/lidar', 1)
        search.look()
        assert (search.alternatives, search.only_alternative) == (['/other/lidar'], '')
        assert search.missing.startswith(
            'no publisher of /robot/points; choose with -r points:=/other/lidar'
        )
        robot.node.create_publisher(Odometry, '/robot/odometry', 1)
        remapped = TopicSearch(robot.node, 'odom', Odometry)
        remapped.look()
        assert (remapped.alternatives, remapped.only_alternative) == (['/robot/odometry'], '')
    finally:
        robot.close()


class Subscriptions:
    """Subscriptions without DDS: the callbacks, by topic."""

    def __init__(self):
        self.callbacks = {}

    def subscribe(self, message, name, callback, qos, **_):
        self.callbacks[name] = callback

    def unsubscribe(self, name):
        self.callbacks.pop(name, None)


class Poses:
    """The poses that a mapping thread is given, in order."""

    def __init__(self):
        self.edges = []

    def put_poses(self, poses, *, static=False):
        self.edges += [(pose.parent, pose.child, static) for pose in poses]


@pytest.fixture
def reading(guarded_peer, monkeypatch):
    """Return a function that reads the poses of a bag as a node does until it has chosen."""
    monkeypatch.setattr(pose_inputs, 'TREE_S', 0.0)
    monkeypatch.setattr(
        pose_inputs, 'transform_message', lambda: object
    )  # tf2_msgs is not on PyPI

    def read(entries, settings=None):
        kinds = {recorded.ODOMETRY: Odometry, recorded.POSE: PoseStamped}
        for topic, kind in {(row[0], row[1]) for row in entries if row[1] in kinds}:
            guarded_peer.node.create_publisher(kinds[kind], topic, 1)
        subscriptions, poses, choices = Subscriptions(), Poses(), []
        config = Config.from_mapping({'pose.registration_after_s': 0.0, **(settings or {})})
        node, on_choice = guarded_peer.node, choices.append
        clocks = ClockWatch(config.input, lambda text: None, time.time_ns)
        inputs = PoseInputs(node, config, poses, subscriptions, clocks, on_choice)
        inputs.subscribe()
        inputs.check()
        for topic, kind, _, message in entries:
            if topic in subscriptions.callbacks:
                subscriptions.callbacks[topic](recorded.ROS2.serialize_cdr(message, kind))
        inputs.note_cloud('lidar')
        inputs.check()
        assert choices == ([] if inputs.choice is None else [inputs.choice])
        return inputs, poses.edges, sorted(subscriptions.callbacks)

    return read


def messages_of(*kept):
    """Return the messages of a drive whose topic or type is among some."""
    return [row for row in recorded.drive() if row[0] in kept or row[1] in kept]


@pytest.mark.parametrize(
    ('kept', 'source'),
    [
        ((recorded.TF, recorded.ODOMETRY, recorded.POSE), 'tf'),
        ((recorded.ODOMETRY, recorded.POSE, '/tf_static'), 'odometry'),
        ((recorded.POSE, '/tf_static'), 'pose'),
        (('/tf_static',), 'registration'),
        ((), 'registration'),
    ],
)
def test_node_and_replay_choose_the_same_source(reading, tmp_path, kept, source):
    entries = messages_of(*kept, recorded.CLOUD)
    bag = recorded.write_rosbag2(tmp_path / 'bag', entries)
    with open_recording(Request(path=bag), Config()) as recording:
        replayed, reason = recording.config.pose.source, recording.describe()['poses_reason']

    choice = reading(entries)[0].choice

    assert (choice.source, replayed) == (source, source)
    if source in ('tf', 'odometry', 'pose'):
        assert choice.reason.startswith(f'{choice.topic} has them')
        assert reason.startswith(f'{choice.topic} has them')


def test_transforms_that_do_not_lead_to_the_cloud_leave_odometry(reading):
    entries = messages_of('/tf', recorded.ODOMETRY)

    inputs, edges, topics = reading(entries)

    assert inputs.source == 'odometry'
    assert inputs.reason.endswith('not from tf: no transforms lead from odom to lidar')
    assert edges == [('odom', 'base_link', False)] * recorded.NUM_SCANS
    assert topics == ['/odom', '/tf_static']  # the mount may still come


def test_a_configured_mount_completes_the_transforms(reading):
    mount = {'frames.base_to_sensor': [*recorded.MOUNT_M, 0.0, 0.0, 0.0, 1.0]}
    inputs, edges, topics = reading(messages_of('/tf', recorded.ODOMETRY), mount)
    assert inputs.source == 'tf'
    assert topics == ['/tf', '/tf_static']
    assert edges == [('odom', 'base_link', False)] * recorded.NUM_SCANS


def test_registration_is_never_taken_for_a_map_with_an_origin(reading):
    inputs, _, _ = reading([], {'map.origin': 'auto'})
    assert inputs.source == 'not chosen yet'
    assert 'map.origin needs poses' in inputs.warning
