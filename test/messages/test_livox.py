# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""CustomMsg of Livox's drivers, written by rosbags from its definition, reads as a PointCloud2."""

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

from surfel_mapper.errors import CloudFormatError
from surfel_mapper.messages.livox import parse_livox
from surfel_mapper.messages.pointcloud2 import to_scan

TYPE = 'livox_ros_driver2/msg/CustomMsg'

DEFINITION = f"""std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
{'=' * 80}
MSG: livox_ros_driver2/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""

STORES = {False: get_typestore(Stores.ROS2_JAZZY), True: get_typestore(Stores.ROS1_NOETIC)}
for store in STORES.values():
    store.register(get_types_from_msg(DEFINITION, TYPE))


def custom_message(points, *, ros1=False, stamp_ns=1_700_000_000_000_000_005, frame_id='livox'):
    """Return a serialised CustomMsg of points 10 us apart; all else are their numbers."""
    types = STORES[ros1].types
    time = types['builtin_interfaces/msg/Time'](stamp_ns // 10**9, stamp_ns % 10**9)
    seq = {'seq': 3} if ros1 else {}
    make = types['livox_ros_driver2/msg/CustomPoint']
    rows = [make(10**4 * k, *map(float, xyz), k % 256, 16, k % 4) for k, xyz in enumerate(points)]
    message = types[TYPE](
        types['std_msgs/msg/Header'](stamp=time, frame_id=frame_id, **seq),
        timebase=stamp_ns,
        point_num=len(rows),
        lidar_id=1,
        rsvd=np.zeros(3, np.uint8),
        points=rows,
    )
    write = STORES[ros1].serialize_ros1 if ros1 else STORES[ros1].serialize_cdr
    return write(message, TYPE)


@pytest.mark.parametrize('ros1', [False, True])
@pytest.mark.parametrize('number', [0, 1, 2, 300])
def test_points_times_and_reflectivity_are_read(ros1, number):
    points = np.random.default_rng(2).uniform(-9.0, 9.0, (number, 3)).astype(np.float32)
    scan = to_scan(parse_livox(custom_message(points, ros1=ros1), ros1=ros1), '/livox')
    np.testing.assert_array_equal(scan.points, points)
    assert (scan.stamp_ns, scan.frame_id) == (1_700_000_000_000_000_005, 'livox')
    if number:
        np.testing.assert_array_equal(scan.columns['offset_time'], 10**4 * np.arange(number))
        np.testing.assert_array_equal(scan.columns['intensity'], np.arange(number) % 256)
        np.testing.assert_array_equal(scan.columns['line'], np.arange(number) % 4)


@pytest.mark.parametrize('ros1', [False, True])
def test_a_message_truncated_at_any_byte_is_refused(ros1):
    raw = bytes(custom_message(np.ones((3, 3)), ros1=ros1))
    for size in range(len(raw)):
        with pytest.raises(CloudFormatError, match=f'/livox: {size} bytes that are not a whole'):
            parse_livox(raw[:size], ros1=ros1, topic='/livox')


def test_a_number_of_points_beyond_the_message_is_refused():
    raw = bytearray(custom_message(np.ones((1, 3))))
    raw[-23:-19] = b'\xff' * 4
    with pytest.raises(CloudFormatError, match='bytes announced'):
        parse_livox(bytes(raw))
