# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The map of a bag is that of its scans and poses, for every source of poses."""

import sqlite3

import numpy as np
import pytest

from surfel_mapper import Config, Mapper, SurfelMap
from surfel_mapper.bags.reader import BagReader
from surfel_mapper.errors import BagError
from surfel_mapper.offline.bag_recording import feed
from surfel_mapper.offline.pose_sources import pose_topics
from surfel_mapper.offline.replay import all_scans
from test.bags.recorded import (
    CLOUD,
    drive,
    HEIGHT_M,
    MOUNT_M,
    NUM_SCANS,
    ODOMETRY,
    POSE,
    ROS1,
    START_NS,
    TF,
    write_ros1,
    write_rosbag2,
)

MOUNTED = {'frames.base_to_sensor': [*MOUNT_M, 0.0, 0.0, 0.0, 1.0]}


def mapped(path, settings, pose_topic=None, cloud_topic='/points'):
    """Replay a bag and return the mapper."""
    mapper = Mapper(Config.from_mapping({**all_scans(), **settings}))
    with BagReader(path) as reader:
        poses = pose_topics(reader.topics, mapper.config, pose_topic)
        for _ in feed(reader, mapper, cloud_topic, poses):
            pass
    return mapper


def points_of(message):
    columns = message.data.view('<f4').reshape(-1, 4)
    return columns[:, :3].astype(np.float64)


def expected_digest(entries):
    """Map the drive by hand: it does not turn, so every pose is a shift."""
    surfel_map = SurfelMap(Config().map.voxel_size_m)
    clouds = [message for _, type_, _, message in entries if type_ == CLOUD]
    for i, message in enumerate(clouds):
        origin = np.array([0.5 * i, 0.0, HEIGHT_M]) + MOUNT_M
        surfel_map.add(points_of(message) + origin, origin=origin)
    return surfel_map.digest()


@pytest.mark.parametrize('source', ['tf', 'odometry', 'pose'])
@pytest.mark.parametrize('mount', [{}, MOUNTED])
def test_every_source_of_poses_gives_the_map_made_by_hand(tmp_path, source, mount):
    entries = drive()

    mapper = mapped(write_rosbag2(tmp_path / 'a', entries), {'pose.source': source, **mount})

    assert mapper.counters.mapped == NUM_SCANS
    assert mapper.map.digest() == expected_digest(entries)


def test_a_ros1_bag_gives_the_same_map(tmp_path):
    mapper = mapped(write_ros1(tmp_path / 'a.bag', drive(ROS1)), {})

    assert mapper.map.digest() == expected_digest(drive())


def test_with_identity_clouds_are_mapped_as_they_are(tmp_path):
    entries = [row for row in drive() if row[1] == CLOUD]

    mapper = mapped(write_rosbag2(tmp_path / 'a', entries), {'pose.source': 'identity'})

    expected = SurfelMap(Config().map.voxel_size_m)
    for *_, message in entries:
        expected.add(points_of(message))
    assert mapper.map.digest() == expected.digest()


def test_transforms_under_a_name_of_their_own_are_used(tmp_path):
    names = {'/tf': '/robot/tf', '/tf_static': '/robot/tf_static'}
    entries = [(names.get(name, name), *rest) for name, *rest in drive()]

    mapper = mapped(write_rosbag2(tmp_path / 'a', entries), {})

    assert mapper.counters.mapped == NUM_SCANS


def test_static_transforms_alone_do_for_a_sensor_at_rest(tmp_path):
    entries = [row for row in drive() if row[0] in ('/tf_static', '/points')]

    mapper = mapped(write_rosbag2(tmp_path / 'a', entries), {'frames.fixed': 'base_link'})

    assert mapper.counters.mapped == NUM_SCANS


def test_a_cloud_that_cannot_be_decoded_is_counted_and_the_rest_is_mapped(tmp_path):
    entries = drive()
    bad = [message for _, type_, _, message in entries if type_ == CLOUD][2]
    bad.point_step = 15

    mapper = mapped(write_rosbag2(tmp_path / 'a', entries), {})

    assert mapper.counters.received == NUM_SCANS
    assert mapper.counters.mapped == NUM_SCANS - 1
    assert mapper.counters.dropped_by_frame == {'lidar': {'bad_cloud': 1}}  # as the node counts


def test_a_pose_message_of_another_content_is_counted_and_its_scan_dropped(tmp_path):
    path = write_rosbag2(tmp_path / 'a', drive(), 'sqlite3')
    with BagReader(path) as reader:
        raw = [bytes(message.raw) for message in reader.messages(['/odom'])][3]
    with sqlite3.connect(path / 'a.db3') as database:
        database.execute('UPDATE messages SET data = ? WHERE data = ?', (raw[:50], raw))

    mapper = mapped(path, {'pose.source': 'odometry', 'pose.max_wait_s': 0.0})

    assert sum(mapper.counters.messages_ignored.values()) == 1
    assert mapper.counters.mapped >= NUM_SCANS - 1  # between two others the pose is interpolated


def test_scans_before_the_first_pose_are_dropped_and_counted(tmp_path):
    entries = [row for row in drive() if row[1] not in (ODOMETRY, TF) or row[2] != START_NS]
    settings = {'pose.source': 'odometry', **MOUNTED}

    mapper = mapped(write_rosbag2(tmp_path / 'a', entries), settings)

    assert mapper.counters.mapped == NUM_SCANS - 1
    assert dict(mapper.counters.dropped) == {'no_pose': 1}


@pytest.mark.parametrize(
    ('kept', 'source', 'topic', 'says'),
    [
        ((CLOUD, ODOMETRY), 'tf', None, r'pose.source is tf, .* offers odometry \(/odom\)'),
        ((CLOUD, POSE, TF), 'odometry', None, r'offers tf \(/tf, /tf_static\), pose \(/pose\)'),
        ((CLOUD,), 'pose', None, 'offers no poses at all; identity maps'),
        ((CLOUD, ODOMETRY), 'odometry', '/odm', 'no topic /odm; Odometry topics: /odom'),
        ((CLOUD, TF), 'tf', '/points', '/points is of type .*, not TFMessage; .*: /tf,'),
    ],
)
def test_a_source_that_the_bag_lacks_is_refused_with_what_it_offers(
    tmp_path, kept, source, topic, says
):
    path = write_rosbag2(tmp_path / 'a', [row for row in drive() if row[1] in kept])

    with pytest.raises(BagError, match=says):
        mapped(path, {'pose.source': source}, topic)


def test_one_of_two_odometries_has_to_be_named_unless_it_is_called_odom(tmp_path):
    entries = drive()
    both = [*entries, *(('/wheels', *row[1:]) for row in entries if row[1] == ODOMETRY)]
    neither = [('/lidar' if row[0] == '/odom' else row[0], *row[1:]) for row in both]
    settings = {'pose.source': 'odometry'}

    assert mapped(write_rosbag2(tmp_path / 'a', both), settings).counters.mapped == NUM_SCANS
    path = write_rosbag2(tmp_path / 'b', sorted(neither, key=lambda row: row[2]))
    with pytest.raises(BagError, match='Odometry topics: /lidar, /wheels'):
        mapped(path, settings)
    assert mapped(path, settings, '/wheels').counters.mapped == NUM_SCANS
