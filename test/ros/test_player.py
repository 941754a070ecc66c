# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Playing a bag over DDS, as a process of its own."""

from __future__ import annotations

import json

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message
from rosbags import rosbag2
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from surfel_mapper.bags.reader import BagReader
from surfel_mapper.cli.main import main
from surfel_mapper.errors import DependencyError
from surfel_mapper.ros import context
from surfel_mapper.ros.message_types import message_type
from surfel_mapper.ros.pace import UNANSWERED
from test.bags.recorded import (
    drive,
    NUM_SCANS,
    PERIOD_NS,
    ROS1,
    ROS2,
    START_NS,
    write_ros1,
    write_rosbag2,
)
from test.ros.live import LATCHED


@pytest.fixture
def bag(tmp_path):
    entries = drive()
    for entry in list(entries):  # twice as long, so that there is something to pace
        topic, type_, record_ns, message = entry
        entries.append((topic, type_, record_ns + NUM_SCANS * PERIOD_NS, message))
    return write_rosbag2(tmp_path / 'bag', entries)


def recorded(bag, topic, kind):
    with BagReader(bag) as reader:
        return [deserialize_message(bytes(m.raw), kind) for m in reader.messages([topic])]


def report(process):
    assert process.wait() == 0, process.output
    return json.loads(process.output.splitlines()[-1])


def test_every_message_arrives_in_order_and_unchanged(start, peer, bag):
    clouds = peer.subscribe(PointCloud2, '/points')
    poses = peer.subscribe(Odometry, '/odom')

    playing = start('play', bag, '--rate', 2, '--wait-for', '/points', '/odom', '--json')
    peer.spin_until(lambda: len(clouds) == len(poses) == 12, what=lambda: playing.output)

    assert clouds == recorded(bag, '/points', PointCloud2)
    assert poses == recorded(bag, '/odom', Odometry)
    found = report(playing)
    assert found['published'] == {'/odom': 12, '/points': 12, '/pose': 12}
    assert set(found['skipped']) == {'/tf', '/tf_static'}
    assert 'tf2_msgs' in found['skipped']['/tf']
    assert found['seconds'] >= (2 * NUM_SCANS - 1) * PERIOD_NS / 1e9 / 2


def test_topics_are_selected_and_remapped_and_the_clock_runs(start, peer, bag):
    poses = peer.subscribe(PoseStamped, '/other')
    clock = peer.subscribe(Clock, '/clock')

    playing = start(
        *('play', bag, '--topics', '/pose', '--wait-for', '/pose', '--clock', '--json'),
        *('--ros-args', '-r', '/pose:=/other'),
    )

    def times():
        return [message.clock.sec * 10**9 + message.clock.nanosec for message in clock]

    last_ns = START_NS + (2 * NUM_SCANS - 1) * PERIOD_NS
    peer.spin_until(lambda: len(poses) == 12 and times()[-1:] == [last_ns])

    assert poses == recorded(bag, '/pose', PoseStamped)
    assert report(playing)['published'] == {'/pose': 12}
    assert times() == sorted(times())
    stamps = {START_NS + number * PERIOD_NS for number in range(2 * NUM_SCANS)}
    assert set(times()) - stamps  # between the messages too


def test_a_latched_topic_is_published_latched(start, peer, tmp_path):
    qos = Qos(
        history=QosHistory.KEEP_LAST,
        depth=1,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL,
        deadline=QosTime(0, 0),
        lifespan=QosTime(0, 0),
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=QosTime(0, 0),
        avoid_ros_namespace_conventions=False,
    )
    topic, type_, record_ns, message = next(entry for entry in drive() if entry[0] == '/pose')
    with rosbag2.Writer(tmp_path / 'bag', version=9) as writer:
        connection = writer.add_connection(
            topic, type_, typestore=ROS2, offered_qos_profiles=[qos]
        )
        writer.write(connection, record_ns, ROS2.serialize_cdr(message, type_))
        later_ns = record_ns + 60 * 10**9  # keeps the player alive
        writer.write(connection, later_ns, ROS2.serialize_cdr(message, type_))

    playing = start('play', tmp_path / 'bag')
    peer.spin_until(lambda: peer.node.count_publishers(topic) > 0)
    peer.spin_for(0.5)  # the only message of this minute is out by now
    late = peer.subscribe(PoseStamped, topic, LATCHED)

    peer.spin_until(lambda: late)
    assert playing.is_running()


def test_clouds_wait_for_the_answers_of_a_slow_node(start, peer, tmp_path):
    bag = write_rosbag2(tmp_path / 'bag', drive())
    clouds = peer.subscribe(PointCloud2, '/points')
    answers = peer.node.create_publisher(PointCloud2, '/answers', 10)

    playing = start(
        *('play', bag, '--rate', 1000, '--wait-for', '/points', '--paced-by', '/answers'),
        *('--timeout', 120, '--json'),
    )
    for number in range(NUM_SCANS - UNANSWERED - 1):
        peer.spin_until(lambda number=number: len(clouds) == number + UNANSWERED + 1)
        peer.spin_for(0.2)  # enough for all of the bag
        assert len(clouds) == number + UNANSWERED + 1
        answers.publish(PointCloud2(header=clouds[number].header))
    assert playing.is_running()
    answers.publish(PointCloud2(header=clouds[-1].header))  # answers all before it too
    peer.spin_until(lambda: len(clouds) == NUM_SCANS)
    answers.publish(PointCloud2(header=clouds[-1].header))
    assert report(playing)['published']['/points'] == NUM_SCANS


def test_a_node_that_does_not_answer_is_reported(domain, capsys, bag):
    assert main(['play', str(bag), '--paced-by', '/answers', '--timeout', '0.2']) == 1
    assert 'no publisher of /answers within 0.2 s' in capsys.readouterr().err


def test_a_missing_subscriber_is_reported_with_a_remedy(domain, capsys, bag):
    assert main(['play', str(bag), '--wait-for', '/points', '--timeout', '0.2']) == 1
    said = capsys.readouterr().err
    assert 'no subscriber of /points within 0.2 s' in said
    assert 'ROS_DOMAIN_ID' in said


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--topics', '/nothing'], 'no topic /nothing; its topics: /odom, /points'),
        (['--topics', '/points', '--wait-for', '/odom'], 'no topic /odom to wait for'),
        (['--ros-args', '--nonsense'], '--nonsense'),
    ],
)
def test_invalid_arguments_are_refused(domain, capsys, bag, arguments, message):
    assert main(['play', str(bag), *arguments]) == 1
    assert message in capsys.readouterr().err


def test_a_bag_of_ros_1_is_refused_with_how_to_convert_it(domain, capsys, tmp_path):
    bag = write_ros1(tmp_path / 'old.bag', drive(store=ROS1))
    assert main(['play', str(bag)]) == 1
    assert 'rosbags-convert' in capsys.readouterr().err


def test_a_user_configuration_of_fast_dds_is_kept(monkeypatch):
    for name in context.FASTDDS_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv('FASTDDS_BUILTIN_TRANSPORTS', 'UDPv4')
    context.enlarge_shared_memory()
    assert 'FASTRTPS_DEFAULT_PROFILES_FILE' not in context.os.environ


def test_a_type_of_a_bag_imports_no_module_from_the_working_directory(
    domain, tmp_path, monkeypatch
):
    package = tmp_path / 'evil_msgs' / 'msg'
    package.mkdir(parents=True)
    ran = tmp_path / 'ran'
    for folder in (package.parent, package):
        (folder / '__init__.py').write_text(f'open({str(ran)!r}, "w")\nclass Thing: ...\n')
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(DependencyError, match='evil_msgs'):
        message_type('evil_msgs/msg/Thing')
    assert not ran.exists()
