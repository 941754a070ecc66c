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
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.replay import all_scans
from surfel_mapper.offline.request import Request
from test.bags.recorded import (
    CLOUD,
    drive,
    HEIGHT_M,
    MOUNT_M,
    NUM_SCANS,
    ODOMETRY,
    POSE,
    START_NS,
    TF,
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


COVARIANCE = 'geometry_msgs/msg/PoseWithCovarianceStamped'


def replayed(path, **request):
    """Replay a bag as the command line does; return the mapper and the summary of the poses."""
    with open_recording(Request(path=path, **request), Config.from_mapping(all_scans())) as bag:
        mapper = Mapper(bag.config)
        for _ in bag.replay(mapper):
            pass
        return mapper, bag.describe()


def in_namespace(name, entries):
    """Return entries with their topics below a name."""
    return [(f'/{name}{topic}', *rest) for topic, *rest in entries]


@pytest.mark.parametrize('start_s', [0.0, 0.2])
def test_static_transforms_hold_from_the_beginning_whenever_recorded(tmp_path, start_s):
    entries = drive()
    late = [
        (*row[:2], START_NS + 450_000_000, row[3]) for row in entries if row[0] == '/tf_static'
    ]
    moved = write_rosbag2(tmp_path / 'late', [*late, *entries[1:]])
    expected, _ = replayed(write_rosbag2(tmp_path / 'early', entries), start_s=start_s)
    mapper, _ = replayed(moved, start_s=start_s)
    assert mapper.counters.mapped == expected.counters.mapped == NUM_SCANS - round(start_s * 10)
    assert mapper.map.digest() == expected.map.digest()


def test_a_static_transform_that_changes_holds_from_its_message_on(tmp_path):
    entries = drive()
    entries.transform('/tf_static', START_NS + 250_000_000, 'base_link', 'lidar', (0, 0, 5.25))
    path = write_rosbag2(tmp_path / 'bag', sorted(entries, key=lambda row: row[2]))
    with open_recording(Request(path=path), Config()) as bag:
        heights = [update.T_map_sensor[2, 3] for update in bag.replay(Mapper(bag.config))]
    assert heights == [HEIGHT_M + MOUNT_M[2]] * 3 + [HEIGHT_M + 5.25] * 3


def test_a_bad_static_transform_is_counted_once(tmp_path):
    entries = drive()
    entries.transform('/tf_static', START_NS, 'base_link', 'camera', (0, 0, 0))
    entries[-1][3].transforms[0].transform.rotation.w = 0.5
    mapper, _ = replayed(write_rosbag2(tmp_path / 'bag', entries))
    assert dict(mapper.counters.messages_ignored) == {'bad_pose': 1}


def test_a_static_transform_that_is_not_finite_is_ignored(tmp_path):
    entries = drive()
    expected = expected_digest(entries)
    entries.transform('/tf_static', START_NS, 'base_link', 'camera', (float('nan'), 0, 0))
    mapper, _ = replayed(write_rosbag2(tmp_path / 'bag', entries))
    assert mapper.map.digest() == expected
    assert mapper.counters.messages_ignored['bad_pose'] > 0


@pytest.mark.parametrize('request_', [{}, {'pose_topic': '/a/tf'}])
def test_each_robot_of_a_bag_has_its_own_mount_and_poses(tmp_path, request_):
    entries, other = drive(), drive()
    other[0][3].transforms[0].transform.translation.z = 9.0
    both = [*in_namespace('a', entries), *in_namespace('b', other)]
    path = write_rosbag2(tmp_path / 'both', sorted(both, key=lambda row: row[2]))
    mapper, found = replayed(path, topics=('/a/points',), **request_)
    assert mapper.map.digest() == expected_digest(entries)
    assert found['pose_topics'] == ['/a/tf', '/a/tf_static']


def test_two_trees_of_transforms_have_to_be_chosen_from(tmp_path):
    entries, other = drive(), drive()
    rows = [*entries, *(('/b/tf', *row[1:]) for row in other if row[0] == '/tf')]
    rows = [('/a/tf', *row[1:]) if row[0] == '/tf' else row for row in rows]
    path = write_rosbag2(tmp_path / 'bag', sorted(rows, key=lambda row: row[2]))
    with pytest.raises(BagError, match=r'name one with --pose-topic; .* /a/tf, /b/tf'):
        replayed(path)
    assert replayed(path, pose_topic='/a/tf')[0].map.digest() == expected_digest(entries)


def test_static_transforms_that_disagree_are_refused_with_the_option(tmp_path):
    entries, other = drive(), drive()
    other[0][3].transforms[0].transform.translation.z = 9.0
    path = write_rosbag2(tmp_path / 'both', [('/b/tf_static', *other[0][1:]), *entries])
    mapper, _ = replayed(path)  # /b/tf_static is in no namespace of the clouds
    assert mapper.map.digest() == expected_digest(entries)
    named = {'static_topics': ('/tf_static', '/b/tf_static')}
    with pytest.raises(BagError, match=r'/tf_static disagree .* lidar: at .*--static-topic'):
        replayed(path, **named)


def test_transforms_that_differ_by_rounding_agree(tmp_path):
    entries, other = drive(), drive()
    other[0][3].transforms[0].transform.translation.z += 1e-6
    path = write_rosbag2(tmp_path / 'both', [('/b/tf_static', *other[0][1:]), *entries])
    mapper, _ = replayed(path, static_topics=('/tf_static', '/b/tf_static'))
    assert mapper.counters.mapped == NUM_SCANS


def test_poses_with_covariance_are_a_source_and_named(tmp_path):
    entries = drive()
    with_covariance = []
    for topic, type_, record_ns, message in entries:
        if type_ == POSE:
            pose = entries.make(
                'geometry_msgs/msg/PoseWithCovariance', pose=message.pose, covariance=np.zeros(36)
            )
            message = entries.make(COVARIANCE, header=message.header, pose=pose)
            with_covariance.append(('/amcl_pose', COVARIANCE, record_ns, message))
        elif type_ == CLOUD or topic == '/tf_static':
            with_covariance.append((topic, type_, record_ns, message))
    mapper, found = replayed(write_rosbag2(tmp_path / 'bag', with_covariance))
    assert mapper.map.digest() == expected_digest(entries)
    assert found['poses_from'] == 'pose'
    assert '/amcl_pose (PoseWithCovarianceStamped)' in found['poses_reason']
    by_hand = [('/initialpose', *row[1:]) for row in with_covariance if row[1] == COVARIANCE]
    twice = write_rosbag2(tmp_path / 'initial', [*with_covariance, *by_hand])
    assert replayed(twice)[1]['pose_topics'] == ['/amcl_pose']


def test_odometry_without_a_child_frame_moves_the_base(tmp_path):
    entries = [row for row in drive() if row[1] in (CLOUD, ODOMETRY) or row[0] == '/tf_static']
    for *_, message in entries:
        if hasattr(message, 'child_frame_id'):
            message.child_frame_id = ''
    mapper, found = replayed(write_rosbag2(tmp_path / 'bag', entries))
    assert mapper.map.digest() == expected_digest(entries)
    assert found['poses_from'] == 'odometry'
