# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A bag of depth and colour images: the mesh has the colours, whichever is recorded first."""

import numpy as np
import pytest

from test.bags.recorded import Entries, PERIOD_NS, START_NS, write_rosbag2
from test.offline.test_depth import camera_info, IMAGE, image, replayed, SETTINGS

TOPIC = '/camera/color/image'
COLORED = {
    **SETTINGS,
    'input.topics': ['/camera/depth/image'],
    'layers.tsdf.enabled': True,
    'layers.tsdf.voxel_size_m': 0.1,
    'layers.tsdf.color': True,
    'layers.tsdf.color_topic': 'camera/color/image',
}
RED = (240, 30, 10)


def color_image(entries, number, late_ns, encoding='rgb8'):
    stamp_ns = START_NS + number * PERIOD_NS
    pixels = np.full((30, 40, 3), RED, np.uint8)
    message = entries.make(
        IMAGE,
        header=entries.header(stamp_ns, 'optical'),
        height=30,
        width=40,
        encoding=encoding,
        is_bigendian=0,
        step=120,
        data=pixels.ravel(),
    )
    entries.append((TOPIC, IMAGE, stamp_ns + late_ns, message))


def recorded(tmp_path, late_ns=0, **changes):
    entries = Entries()
    camera_info(entries, START_NS - 10)
    for number in range(3):
        image(entries, number)
        color_image(entries, number, late_ns, **changes)
    entries.sort(key=lambda entry: entry[2])
    return write_rosbag2(tmp_path / 'bag', entries)


@pytest.mark.parametrize('late_ns', [-1000, 1000, 40_000_000])
def test_every_depth_image_gets_its_colours(tmp_path, late_ns):
    mapper, _ = replayed(recorded(tmp_path, late_ns), COLORED)
    assert mapper.counters.mapped == 3
    colors = mapper.tsdf.mesh().colors
    assert len(colors) > 100
    assert set(map(tuple, colors.tolist())) == {RED}


def test_images_that_cannot_be_read_are_counted_and_the_depth_is_mapped(tmp_path):
    mapper, _ = replayed(recorded(tmp_path, encoding='yuv422'), COLORED)
    assert mapper.counters.mapped == 3
    assert mapper.counters.messages_ignored == {'bad_image': 3}
    assert not mapper.tsdf.mesh().colors.any()


@pytest.mark.parametrize('number', [3, 80])
def test_images_without_camera_info_beside_a_lidar_cost_no_scan(tmp_path, number):
    entries, rng = Entries(), np.random.default_rng(3)
    across = rng.uniform(-2.0, 2.0, (4000, 2))
    wall = np.column_stack([np.full(4000, 4.0), across]).astype(np.float32)
    for scan in range(number):
        entries.cloud('/lidar', START_NS + scan * PERIOD_NS, wall)
        color_image(entries, scan, late_ns=-1000)
    entries.sort(key=lambda entry: entry[2])
    settings = {**COLORED, 'input.kind': 'cloud', 'input.topics': ['/lidar']}
    mapper, _ = replayed(write_rosbag2(tmp_path / 'bag', entries), settings)
    assert mapper.counters.mapped == number
    assert mapper.tsdf.summary()['scans'] == number
    mesh = mapper.tsdf.mesh()
    assert len(mesh) > 100
    assert not mesh.colors.any()
    ignored = mapper.counters.messages_ignored.get('bad_image', 0)
    assert (ignored > 0) == (number > 64), mapper.counters.messages_ignored
