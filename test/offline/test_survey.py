# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A replay with the settings of a survey finds the poses that the survey promises."""

from itertools import pairwise
import sqlite3

import pytest

from surfel_mapper import Config, Mapper
from surfel_mapper.bags.reader import BagReader
from surfel_mapper.offline.bag_recording import feed
from surfel_mapper.offline.pose_sources import pose_topics
from surfel_mapper.offline.replay import all_scans
from surfel_mapper.offline.survey import offers, survey
from test.bags.recorded import (
    CLOUD,
    drive,
    NUM_SCANS,
    ODOMETRY,
    PERIOD_NS,
    START_NS,
    TF,
    write_rosbag2,
)


def surveyed(path):
    with BagReader(path) as reader:
        found = survey(reader)
    return found, offers(found)


def test_topics_are_listed_with_frames_and_rates(tmp_path):
    found, _ = surveyed(write_rosbag2(tmp_path / 'a', drive()))

    assert {name: seen.frames for name, seen in found.topics.items()} == {
        '/odom': ['odom -> base_link'],
        '/points': ['lidar'],
        '/pose': ['odom -> base_link'],
        '/tf': ['odom -> base_link'],
        '/tf_static': ['base_link -> lidar'],
    }
    assert found.topics['/points'].rate_hz == pytest.approx(1e9 / PERIOD_NS)
    assert found.topics['/tf_static'].rate_hz is None


def test_every_source_is_offered_and_its_settings_map_every_scan(tmp_path):
    path = write_rosbag2(tmp_path / 'a', drive())

    _, made = surveyed(path)

    assert [offer.settings['pose.source'] for offer in made] == ['tf', 'odometry', 'pose']
    for offer in made:
        assert (offer.covered, offer.total, offer.missing) == (NUM_SCANS, NUM_SCANS, '')
        mapper = Mapper(Config.from_mapping({**all_scans(), **offer.settings}))
        with BagReader(path) as reader:
            poses = pose_topics(reader.topics, mapper.config, offer.poses)
            assert sum(1 for _ in feed(reader, mapper, offer.clouds, poses)) == NUM_SCANS


def test_a_mounting_over_two_transforms_is_their_product(tmp_path):
    entries = [row for row in drive() if row[0] != '/tf_static']
    poles = drive(num_scans=0)
    poles.clear()
    poles.transform('/tf_static', START_NS, 'base_link', 'pole', (1.0, 2.0, 3.0))
    poles.transform('/tf_static', START_NS, 'pole', 'lidar', (0.5, 0.25, 0.125))

    _, made = surveyed(write_rosbag2(tmp_path / 'a', [*poles, *entries]))

    assert made[1].settings['frames.base_to_sensor'] == [1.5, 2.25, 3.125, 0.0, 0.0, 0.0, 1.0]


def test_a_mounting_that_is_not_in_the_bag_is_reported(tmp_path):
    path = write_rosbag2(tmp_path / 'a', [row for row in drive() if row[1] in (CLOUD, ODOMETRY)])

    _, (offer,) = surveyed(path)

    assert offer.covered == NUM_SCANS
    assert offer.settings['frames.base_to_sensor'] == []
    missing = 'no place of lidar in base_link in the bag: measure frames.base_to_sensor'
    assert offer.missing == missing


def test_clouds_without_a_pose_are_counted(tmp_path):
    entries = drive()
    last_ns = START_NS + (NUM_SCANS - 1) * PERIOD_NS
    cut = [row for row in entries if row[1] == CLOUD or START_NS < row[2] < last_ns]
    cut = [*[row for row in entries if row[0] == '/tf_static'], *cut]

    _, made = surveyed(write_rosbag2(tmp_path / 'a', cut))

    assert {offer.covered for offer in made} == {NUM_SCANS - 2}
    assert all('newer than all of' in offer.missing for offer in made)


def test_clouds_in_a_gap_of_the_poses_count_as_without(tmp_path):
    entries = drive(num_scans=40)
    first_ns, last_ns = START_NS + 5 * PERIOD_NS, START_NS + 35 * PERIOD_NS
    kept = [
        row
        for row in entries
        if row[1] == CLOUD or row[0] == '/tf_static' or not first_ns < row[2] < last_ns
    ]

    _, made = surveyed(write_rosbag2(tmp_path / 'a', kept))

    assert {offer.covered for offer in made} == {40 - 29}
    assert all('in a gap of 3.000 s' in offer.missing for offer in made)


def test_a_bag_without_poses_offers_none(tmp_path):
    found, made = surveyed(write_rosbag2(tmp_path / 'a', [r for r in drive() if r[1] == CLOUD]))

    assert made == []
    assert list(found.stamps) == [('/points', 'lidar')]


@pytest.mark.parametrize(
    ('parents', 'fixed'),
    [
        (['lidar', 'base_link', 'odom', 'map', 'earth'], 'odom'),
        (['lidar', 'base_link', 'map', 'earth'], 'map'),
        (['lidar', 'vehicle', 'utm'], 'utm'),
    ],
)
def test_the_fixed_frame_is_odom_or_map_or_the_root(tmp_path, parents, fixed):
    entries = [row for row in drive() if row[1] != TF]
    tree = drive(num_scans=0)
    tree.clear()
    for child, parent in pairwise(parents):
        tree.transform('/tf_static', START_NS, parent, child, (1.0, 0.0, 0.0))

    _, made = surveyed(write_rosbag2(tmp_path / 'a', [*tree, *entries]))

    (offer,) = (offer for offer in made if offer.settings['pose.source'] == 'tf')
    assert offer.settings['frames.fixed'] == fixed
    assert offer.covered == NUM_SCANS


@pytest.mark.parametrize(('base', 'fixed'), [('lidar', 'odom'), ('base_link', 'odom_lidar')])
def test_odometry_that_is_published_upside_down_is_used(tmp_path, base, fixed):
    entries = [row for row in drive() if row[0] == '/points']
    tree = drive(num_scans=0)
    tree.clear()
    if base != 'lidar':
        tree.transform('/tf_static', START_NS, base, 'lidar', (0.0, 0.0, 1.0))
    for k in range(NUM_SCANS):
        stamp_ns = START_NS + k * PERIOD_NS
        for child, x in ((fixed, -0.1 * k), ('wheel', 0.0)):
            tree.transform('/tf', stamp_ns, base, child, (x, 0.0, 0.0))

    _, (offer,) = surveyed(write_rosbag2(tmp_path / 'a', [*tree, *entries]))

    assert (offer.settings['frames.fixed'], offer.covered) == (fixed, NUM_SCANS)


def test_refused_poses_and_clouds_in_the_fixed_frame_are_named(tmp_path):
    entries = [row for row in drive() if row[0] in ('/points', '/odom', '/tf_static')]
    for topic, _, _, message in entries:
        if topic == '/odom':
            message.pose.pose.orientation.w = 0.0
    _, made = surveyed(write_rosbag2(tmp_path / 'a', entries))
    (offer,) = (offer for offer in made if offer.poses == '/odom')
    assert 'pose of base_link in odom: quaternion [0.0, 0.0, 0.0, 0.0] has norm' in offer.missing

    entries = [row for row in drive() if row[0] in ('/points', '/odom')]
    for topic, _, _, message in entries:
        if topic == '/points':
            message.header.frame_id = 'odom'
    _, (offer,) = surveyed(write_rosbag2(tmp_path / 'b', entries))
    assert offer.missing == 'poses and clouds are in odom; --poses-from identity maps them'


def test_odometry_of_a_frame_in_itself_has_no_poses(tmp_path):
    entries = [row for row in drive() if row[0] in ('/points', '/odom', '/tf_static')]
    for topic, _, _, message in entries:
        if topic == '/odom':
            message.header.frame_id = message.child_frame_id
    _, made = surveyed(write_rosbag2(tmp_path / 'a', entries))
    (offer,) = (offer for offer in made if offer.poses == '/odom')
    assert (offer.covered, offer.missing) == (0, 'it is of base_link in itself')


def test_damaged_messages_are_counted(tmp_path):
    entries = drive()
    entries[4][3].fields[0].name = 'x'
    path = write_rosbag2(tmp_path / 'a', entries, 'sqlite3')
    with sqlite3.connect(path / 'a.db3') as database:
        database.execute('UPDATE messages SET data = substr(data, 1, 30) WHERE id = 5')

    found, _ = surveyed(path)

    assert found.undecodable == 1
