# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""PointCloud2 read in place gives what rosbags' deserialiser gives, and copies nothing."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from surfel_mapper.errors import CloudFormatError
from surfel_mapper.messages.raw_cloud import parse_cloud
from test.bags.recorded import CLOUD, Entries, ROS1, ROS2

names = st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=9)
uint32 = st.integers(0, 2**32 - 1)
fields = st.lists(st.tuples(names, uint32, st.integers(0, 255), uint32), max_size=5)


def message(store, fields, frame_id, sizes, data, flags, stamp):
    make = Entries(store).make
    header = Entries(store).header(stamp, frame_id)
    rows = [
        make('sensor_msgs/msg/PointField', name=name, offset=offset, datatype=type_, count=count)
        for name, offset, type_, count in fields
    ]
    sizes = dict(zip(('height', 'width', 'point_step', 'row_step'), sizes, strict=True))
    data = np.frombuffer(data, np.uint8)
    flags = dict(zip(('is_bigendian', 'is_dense'), flags, strict=True))
    return make(CLOUD, header=header, fields=rows, data=data, **sizes, **flags)


def assert_same(got, expected):
    assert got.header.stamp.sec == expected.header.stamp.sec
    assert got.header.stamp.nanosec == expected.header.stamp.nanosec
    assert got.header.frame_id == expected.header.frame_id
    for name in ('height', 'width', 'point_step', 'row_step', 'is_bigendian', 'is_dense'):
        assert getattr(got, name) == getattr(expected, name), name
    columns = [(f.name, f.offset, f.datatype, f.count) for f in expected.fields]
    assert [(f.name, f.offset, f.datatype, f.count) for f in got.fields] == columns
    np.testing.assert_array_equal(got.data, expected.data)


@settings(max_examples=200, deadline=None)
@given(
    fields,
    names,
    st.tuples(uint32, uint32, uint32, uint32),
    st.binary(max_size=50),
    st.tuples(st.booleans(), st.booleans()),
    st.integers(0, 2**31 * 10**9 - 1),
)
def test_any_message_reads_as_rosbags_reads_it(fields, frame_id, sizes, data, flags, stamp):
    arguments = (fields, frame_id, sizes, data, flags, stamp)
    for order in (True, False):
        raw = bytes(ROS2.serialize_cdr(message(ROS2, *arguments), CLOUD, little_endian=order))
        assert_same(parse_cloud(raw), ROS2.deserialize_cdr(raw, CLOUD))
    raw = bytes(ROS1.serialize_ros1(message(ROS1, *arguments), CLOUD))
    assert_same(parse_cloud(raw, ros1=True), ROS1.deserialize_ros1(raw, CLOUD))


def drive_cloud():
    entries = Entries()
    entries.cloud('/points', 10**18, np.arange(30.0).reshape(10, 3))
    return bytes(ROS2.serialize_cdr(entries[0][3], CLOUD))


def test_the_data_is_a_view_of_the_message():
    raw = drive_cloud()

    data = parse_cloud(raw).data

    assert np.shares_memory(data, np.frombuffer(raw, np.uint8))
    assert not data.flags.writeable


def test_a_message_that_ends_early_is_refused_wherever_it_ends():
    raw = drive_cloud()
    for size in range(len(raw)):
        with pytest.raises(CloudFormatError, match=f'/lidar: {size} bytes that are no whole'):
            parse_cloud(raw[:size], topic='/lidar')


def test_counts_beyond_the_message_are_refused_before_they_are_followed():
    raw = bytearray(drive_cloud())
    at = raw.index(b'\4\0\0\0\2\0\0\0x\0')
    raw[at : at + 4] = b'\xff\xff\xff\xff'

    with pytest.raises(CloudFormatError, match='4294967295 fields announced'):
        parse_cloud(bytes(raw))


def test_an_encoding_other_than_plain_cdr_is_refused():
    raw = b'\x00\x07' + drive_cloud()[2:]

    with pytest.raises(CloudFormatError, match=r'encoding 0007, expected plain CDR'):
        parse_cloud(raw)


def test_a_name_that_is_no_text_is_refused():
    raw = drive_cloud().replace(b'intensity', b'intens\xff\xfey')

    with pytest.raises(CloudFormatError, match='utf-8'):
        parse_cloud(raw)
