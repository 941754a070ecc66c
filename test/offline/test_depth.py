# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A bag of depth images: each is mapped with the calibration of its camera, as in the node."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surfel_mapper import Config, Mapper
from surfel_mapper.cluster.map_reduce import map_bags
from surfel_mapper.cluster.shards import cut
from surfel_mapper.cluster.workers import Workers
from surfel_mapper.errors import BagError
from surfel_mapper.messages.images import CameraImage, depth_scan
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.request import Request
from surfel_mapper.sensors.depth import PinholeCamera
from test.bags.recorded import Entries, PERIOD_NS, START_NS, write_rosbag2

IMAGE, INFO = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CameraInfo'
TOPIC, INFO_TOPIC = '/camera/depth/image', '/camera/depth/camera_info'
CAMERA = PinholeCamera(width=40, height=30, fx=35.0, fy=35.0, cx=19.5, cy=14.5)
SETTINGS = {'input.kind': 'depth', 'pose.source': 'identity', 'map.min_points': 1}


def camera_info(entries, record_ns, focal=35.0, topic=INFO_TOPIC):
    K = np.array([focal, 0.0, 19.5, 0.0, focal, 14.5, 0.0, 0.0, 1.0])
    roi = entries.make(
        'sensor_msgs/msg/RegionOfInterest',
        x_offset=0,
        y_offset=0,
        height=0,
        width=0,
        do_rectify=False,
    )
    message = entries.make(
        INFO,
        header=entries.header(record_ns, 'optical'),
        height=30,
        width=40,
        distortion_model='plumb_bob',
        d=np.zeros(5),
        k=K,
        r=np.eye(3).ravel(),
        p=np.zeros(12),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )
    entries.append((topic, INFO, record_ns, message))


def image(entries, number):
    stamp_ns = START_NS + number * PERIOD_NS
    depth = np.random.default_rng(number).integers(1000, 1400, (30, 40)).astype('<u2')
    message = entries.make(
        IMAGE,
        header=entries.header(stamp_ns, 'optical'),
        height=30,
        width=40,
        encoding='16UC1',
        is_bigendian=0,
        step=80,
        data=depth.view(np.uint8).ravel(),
    )
    entries.append((TOPIC, IMAGE, stamp_ns, message))
    return message


def replayed(bag, settings=SETTINGS, **request):
    config = Config.from_mapping(settings)
    with open_recording(Request(path=bag, **request), config) as recording:
        mapper = Mapper(recording.config)
        list(recording.replay(mapper))
        return mapper, recording


def test_images_wait_for_the_first_calibration_and_are_mapped_with_it(tmp_path):
    entries = Entries()
    images = [image(entries, number) for number in range(2)]
    camera_info(entries, START_NS + PERIOD_NS + 10)
    images += [image(entries, number) for number in range(2, 4)]
    mapper, recording = replayed(write_rosbag2(tmp_path / 'bag', entries))

    expected = Mapper(Config.from_mapping(SETTINGS))
    for message in images:
        expected.add_scan(depth_scan(CameraImage(message, CAMERA)))
        list(expected.insert_ready())
    assert mapper.counters.mapped == 4
    assert recording.topics == [TOPIC]
    assert mapper.map.digest() == expected.map.digest()


@pytest.mark.parametrize(
    ('infos', 'focal'),
    [
        ({-1: 35.0}, 35.0),
        ({-1: 70.0, 10: 35.0}, 35.0),
        ({-1: 70.0, 65: 35.0}, 35.0),  # in the margin before the part
        ({-1: 35.0, 75: 70.0}, 35.0),  # in the part, after its images
    ],
)
def test_a_part_has_the_last_calibration_before_it(tmp_path, infos, focal):
    entries = Entries()
    for at, recorded_focal in infos.items():
        camera_info(entries, START_NS + at * PERIOD_NS + 10, focal=recorded_focal)
    images = [image(entries, number) for number in range(73)]
    entries.sort(key=lambda entry: entry[2])
    bag = write_rosbag2(tmp_path / 'bag', entries)
    mapper, _ = replayed(bag, start_s=7.05, duration_s=0.35)  # from image 70 on

    expected = Mapper(Config.from_mapping(SETTINGS))
    for message in images[70:]:
        camera = replace(CAMERA, fx=focal, fy=focal)
        expected.add_scan(depth_scan(CameraImage(message, camera)))
        list(expected.insert_ready())
    assert mapper.counters.mapped == 3
    assert mapper.map.digest() == expected.map.digest()


def test_an_invalid_camera_is_counted_and_the_next_one_taken(tmp_path):
    entries = Entries()
    camera_info(entries, START_NS - 20, focal=0.0)
    camera_info(entries, START_NS - 10)
    image(entries, 0)
    mapper, _ = replayed(write_rosbag2(tmp_path / 'bag', entries))
    assert mapper.counters.messages_ignored['bad_message'] == 1
    assert mapper.counters.mapped == 1


def test_without_images_the_topics_are_named(tmp_path):
    entries = Entries()
    entries.cloud('/points', START_NS, np.ones((3, 3)))
    with pytest.raises(BagError, match=r'no topic of type sensor_msgs/msg/Image.*/points'):
        replayed(write_rosbag2(tmp_path / 'bag', entries))


def test_the_topics_of_the_configuration_are_those_of_the_bag(tmp_path):
    entries = Entries()
    for number, side in enumerate(('front', 'rear')):
        stamp_ns = START_NS + number * PERIOD_NS
        entries.cloud(f'/{side}/points', stamp_ns, np.ones((3, 3)), frame_id=side)
    entries.cloud('/other', START_NS, np.ones((3, 3)))
    settings = {
        'input.topics': ['front/points', '/rear/points'],
        'pose.source': 'identity',
        'frames.sensors': ['front', 'rear'],
        'frames.base_to_sensor': [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0] * 2,
    }
    mapper, recording = replayed(write_rosbag2(tmp_path / 'bag', entries), settings)
    assert recording.topics == ['/front/points', '/rear/points']
    assert mapper.counters.mapped == 2


def depth_bag(path, *, moves=True, second=''):
    """Write four depth images of a moving camera, each with an image of colours."""
    entries = Entries()
    camera_info(entries, START_NS - 10)
    for number in range(4):
        image(entries, number)
        stamp_ns = START_NS + number * PERIOD_NS
        colour = entries.make(
            IMAGE,
            header=entries.header(stamp_ns, 'optical'),
            height=1,
            width=1,
            encoding='rgb8',
            is_bigendian=0,
            step=3,
            data=np.zeros(3, np.uint8),
        )
        entries.append(('/camera/color/image', IMAGE, stamp_ns + 1, colour))
        if second:
            entries.append((second, IMAGE, stamp_ns + 2, entries[-2][3]))
        if moves:
            entries.transform('/tf', stamp_ns, 'world', 'optical', (0.1 * number, 0.0, 0.0))
    return write_rosbag2(path, entries)


def test_a_bag_of_depth_images_alone_needs_no_settings(tmp_path):
    mapper, recording = replayed(depth_bag(tmp_path / 'bag'), {'map.min_points': 1})

    assert recording.topics == [TOPIC]
    assert recording.config.pose.source == 'tf'
    assert recording.config.frames.fixed == 'world'
    assert mapper.counters.mapped == 4
    settings = {**SETTINGS, 'pose.source': 'tf', 'frames.fixed': 'world', 'input.topics': [TOPIC]}
    expected, _ = replayed(tmp_path / 'bag', {**settings, 'map.voxel_size_m': 0.08})
    assert mapper.map.digest() == expected.map.digest()


def test_a_bag_of_depth_images_without_poses_is_registered(tmp_path):
    _, recording = replayed(depth_bag(tmp_path / 'bag', moves=False), {})

    assert recording.config.input.kind == 'depth'
    assert recording.config.pose.source == 'registration'


def test_one_of_several_topics_of_depth_images_has_to_be_named(tmp_path):
    bag = depth_bag(tmp_path / 'bag', second='/other/depth/image')

    with pytest.raises(BagError, match=f'name one with --topic: {TOPIC}, /other/depth/image'):
        replayed(bag, {})
    _, recording = replayed(bag, {}, topics=(TOPIC,))
    assert recording.topics == [TOPIC]


def test_shards_of_depth_images_make_the_map_of_one_go(tmp_path):
    entries = Entries()
    camera_info(entries, START_NS)
    for number in range(20):
        image(entries, number)
    bag = write_rosbag2(tmp_path / 'depth', entries)
    expected, _ = replayed(bag, {**SETTINGS, 'window.max_scans': 0})

    shards = cut(Request(path=bag), Config.from_mapping(SETTINGS), 0.5)

    assert len(shards) > 2
    mapped = map_bags([shards], Workers())
    assert mapped.mapper.map == expected.map
    assert mapped.counts['scans']['mapped'] == 20
