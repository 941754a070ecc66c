# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A bag whose images are packed is mapped as one whose are not; damaged ones are counted."""

import numpy as np

from test.bags.recorded import Entries, PERIOD_NS, START_NS, write_rosbag2
from test.messages.test_compressed_image import packed, packed_depth
from test.offline.test_depth import camera_info, image, replayed
from test.offline.test_scene_feed import color_image, COLORED, RED

PACKED = 'sensor_msgs/msg/CompressedImage'
DEPTH_TOPIC, COLOR_TOPIC = '/camera/depth/image/compressedDepth', '/camera/color/image/compressed'
SETTINGS = {
    **COLORED,
    'input.topics': [DEPTH_TOPIC],
    'layers.tsdf.color_topic': COLOR_TOPIC.lstrip('/'),
}


def add_packed(entries, topic, number, message, damaged=False):
    """Record a packed image; one that is damaged ends in the middle."""
    stamp_ns = START_NS + number * PERIOD_NS
    data = np.frombuffer(message.data[: len(message.data) // 2 if damaged else None], np.uint8)
    made = entries.make(
        PACKED, header=entries.header(stamp_ns, 'optical'), format=message.format, data=data
    )
    entries.append((topic, PACKED, stamp_ns, made))


def recorded(path, damaged=()):
    """Return a bag of four packed images of depth and of colours, some damaged."""
    entries, plain = Entries(), Entries()
    camera_info(entries, START_NS - 10)
    for number in range(4):
        depth = np.asarray(image(plain, number).data).view('<u2').reshape(30, 40)
        add_packed(entries, DEPTH_TOPIC, number, packed_depth(depth), ('depth', number) in damaged)
        color = packed(np.full((30, 40, 3), RED, np.uint8), 'rgb8; png compressed bgr8')
        add_packed(entries, COLOR_TOPIC, number, color, ('color', number) in damaged)
    return write_rosbag2(path, entries)


def test_packed_images_make_the_map_and_the_colours_of_plain_ones(tmp_path):
    mapper, recording = replayed(recorded(tmp_path / 'packed'), SETTINGS)
    entries = Entries()
    camera_info(entries, START_NS - 10)
    for number in range(4):
        image(entries, number)
        color_image(entries, number, 0)
    expected, _ = replayed(write_rosbag2(tmp_path / 'plain', entries), COLORED)
    assert recording.topics == [DEPTH_TOPIC]
    assert mapper.counters.mapped == expected.counters.mapped == 4
    assert mapper.map.digest() == expected.map.digest()
    mesh, plain = mapper.tsdf.mesh(), expected.tsdf.mesh()
    np.testing.assert_array_equal(mesh.vertices, plain.vertices)
    assert set(map(tuple, mesh.colors.tolist())) == {RED}


def test_damaged_images_are_counted_and_the_others_mapped(tmp_path):
    bag = recorded(tmp_path / 'bag', {('depth', 1), ('color', 2), ('color', 3)})
    mapper, _ = replayed(bag, SETTINGS)
    assert mapper.counters.mapped == 3
    assert mapper.counters.dropped == {'bad_cloud': 1}
    assert mapper.counters.messages_ignored == {'bad_image': 2}


def test_packed_images_are_taken_where_there_are_no_others(tmp_path):
    entries, plain = Entries(), Entries()
    camera_info(entries, START_NS - 10)
    depth = np.asarray(image(plain, 0).data).view('<u2').reshape(30, 40)
    add_packed(entries, DEPTH_TOPIC, 0, packed_depth(depth))
    settings = {'input.kind': 'depth', 'pose.source': 'identity'}
    mapper, recording = replayed(write_rosbag2(tmp_path / 'bag', entries), settings)
    assert (recording.topics, mapper.counters.mapped) == ([DEPTH_TOPIC], 1)
