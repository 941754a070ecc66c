# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
PointCloud2: any valid layout decodes, any invalid one is refused, columns encode.

The twin reads one number at a time with struct. Layouts, contents and damage come from
hypothesis; the layouts of real sensors stand by name. Messages are stand-ins with the attributes
that rclpy and rosbags share, and once each the real ones.

(Longer than other files: the layouts stand here by name, and decoding and encoding check each
other.)
"""

import array
from dataclasses import dataclass, replace
import struct
from types import SimpleNamespace

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from surfel_mapper.errors import CloudFormatError
from surfel_mapper.mapping.surfels import QUALITY, surfel_columns
from surfel_mapper.messages.pointcloud2 import (
    append_fields,
    Field,
    from_columns,
    parse_cloud,
    to_scan,
    warn_of_layout,
)
from test.bags.recorded import CLOUD, Entries, ROS1, ROS2
from test.messages.examples import make_surfels

CODES = {1: 'b', 2: 'B', 3: 'h', 4: 'H', 5: 'i', 6: 'I', 7: 'f', 8: 'd'}
NUMPY = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}


@dataclass
class Message:
    """A PointCloud2 as rclpy and rosbags show it."""

    height: int
    width: int
    fields: list
    point_step: int
    row_step: int
    data: object
    is_bigendian: bool = False
    is_dense: bool = True
    stamp: tuple = (1, 500)

    @property
    def header(self):
        stamp = SimpleNamespace(sec=self.stamp[0], nanosec=self.stamp[1])
        return SimpleNamespace(stamp=stamp, frame_id='lidar')


def message(fields, point_step, height=1, width=3, padding=0):
    """Return a message of random finite numbers with fields (name, offset, datatype[, count])."""
    row_step = width * point_step + padding
    data = np.random.default_rng(0).integers(0, 100, height * row_step, np.uint8)
    fields = [Field(*field) if len(field) == 4 else Field(*field, 1) for field in fields]
    return Message(height, width, fields, point_step, row_step, data)


def twin(msg, field):
    """Return one field of all points, a struct.unpack for every number."""
    order, code = '>' if msg.is_bigendian else '<', CODES[field.datatype]
    size, values = struct.calcsize(code), []
    for row in range(msg.height):
        for point in range(msg.width):
            start = row * msg.row_step + point * msg.point_step + field.offset
            numbers = [
                struct.unpack_from(order + code, bytes(msg.data), start + i * size)[0]
                for i in range(max(field.count, 1))
            ]
            values.append(numbers if field.count > 1 else numbers[0])
    return np.array(values, NUMPY[field.datatype])


def assert_decodes(msg):
    scan = to_scan(msg, 'points')
    first = {}
    for field in msg.fields:
        if field.name:
            first.setdefault(field.name, field)
    xyz = [twin(msg, first[name]) for name in 'xyz']
    expected = np.stack(xyz, axis=1)  # float64 if one of them is
    np.testing.assert_array_equal(np.stack(scan.xyz, axis=1), expected)
    assert scan.points.dtype == expected.dtype
    assert scan.points.flags.f_contiguous
    np.testing.assert_array_equal(scan.points, expected)
    assert set(scan.columns) == set(first) - {'x', 'y', 'z'}
    for name, column in scan.columns.items():
        expected = twin(msg, first[name])
        assert column.dtype == expected.dtype
        np.testing.assert_array_equal(column, expected)


XYZ = [('x', 0, 7), ('y', 4, 7), ('z', 8, 7)]

LAYOUTS = {
    'packed': (XYZ, 12),
    'padded to 16': ([*XYZ, ('intensity', 12, 7)], 16),
    '22 bytes': ([*XYZ, ('intensity', 12, 7), ('ring', 16, 4), ('time', 18, 7)], 22),
    '26 bytes, float64 time': ([*XYZ, ('intensity', 12, 7), ('ring', 16, 4), ('t', 18, 8)], 26),
    '32 bytes': ([*XYZ, ('intensity', 16, 7), ('ring', 20, 4), ('time', 24, 7)], 32),
    'behind a word, 16 bytes': ([('i', 0, 7), ('x', 4, 7), ('y', 8, 7), ('z', 12, 7)], 16),
    'between words, 16 bytes': ([('i', 0, 2), ('x', 1, 7), ('y', 5, 7), ('z', 9, 7)], 16),
    'backwards, 32 bytes': ([('z', 20, 7), ('y', 24, 7), ('x', 28, 7), ('t', 0, 8)], 32),
    '48 bytes': ([*XYZ, ('intensity', 16, 7), ('t', 20, 6), ('ring', 26, 2), ('n', 32, 6)], 48),
    'float64': ([('x', 0, 8), ('y', 8, 8), ('z', 16, 8)], 24),
    'float64, not aligned': ([('x', 1, 8), ('y', 9, 8), ('z', 17, 8), ('i', 0, 1)], 25),
    'mixed': ([('x', 0, 7), ('y', 4, 8), ('z', 12, 7)], 16),
    'float64 first': ([('x', 0, 8), ('y', 8, 7), ('z', 12, 7)], 16),
    'unordered': ([('t', 0, 8), ('z', 8, 7), ('x', 16, 7), ('y', 12, 7)], 20),
    'unordered, not aligned': ([('z', 1, 7), ('x', 9, 7), ('y', 5, 7)], 13),
    'vectors': ([*XYZ, ('normal', 12, 7, 3), ('histogram', 24, 2, 5)], 29),
    'count 0': ([('x', 0, 7, 0), ('y', 4, 7, 0), ('z', 8, 7, 0), ('ring', 12, 4, 0)], 14),
    'names missing': ([*XYZ, ('', 12, 7), ('', 16, 7), ('ring', 20, 4)], 24),
    'names twice': ([*XYZ, ('x', 0, 7), ('time', 12, 6), ('time', 16, 8)], 24),
    'name of two letters twice': ([*XYZ, ('xy', 12, 7), ('xy', 16, 7)], 20),
}


@pytest.mark.parametrize('big', [False, True], ids=['little', 'big'])
@pytest.mark.parametrize('name', LAYOUTS)
def test_a_layout_of_a_sensor_decodes(name, big):
    assert_decodes(replace(message(*LAYOUTS[name], width=7), is_bigendian=big))


def test_columns_are_read_only_views_into_the_message_and_points_are_not():
    msg = message(*LAYOUTS['48 bytes'])
    scan = to_scan(msg)
    for column in scan.columns.values():
        assert np.shares_memory(column, msg.data)
        assert not column.flags.writeable
    assert not np.shares_memory(scan.points, msg.data)
    assert scan.points.flags.writeable


def test_the_scan_has_stamp_and_frame_of_the_header():
    scan = to_scan(replace(message(XYZ, 12), stamp=(2**31 - 1, 999_999_999)))
    assert scan.stamp_ns == (2**31 - 1) * 10**9 + 999_999_999
    assert scan.frame_id == 'lidar'


@pytest.mark.parametrize(
    ('height', 'width', 'row_step', 'data'),
    [(0, 0, 0, b''), (1, 0, 0, b''), (0, 5, 60, b''), (2, 0, 3, b'123456')],
)
@pytest.mark.parametrize('fields', [[], [Field('x', 99, 99, 9)]])
def test_a_cloud_without_points_is_an_empty_scan(height, width, row_step, data, fields):
    scan = to_scan(Message(height, width, fields, 0, row_step, data))
    assert scan.points.shape == (0, 3)
    assert scan.points.dtype == np.float32
    assert scan.stamp_ns == 1_000_000_500


INVALID = {
    'no x': ({'fields': [Field('y', 4, 7, 1), Field('z', 8, 7, 1)]}, 'no field x among .*y, z'),
    'no field': ({'fields': []}, 'no field x among .*none'),
    'datatype 0': ({'fields': [Field('x', 0, 0, 1)]}, 'datatype 0, expected one of 1 to 8'),
    'datatype 9': ({'fields': [Field('x', 0, 9, 1)]}, "'x' has datatype 9"),
    'integer x': ({'fields': [Field(n, 0, 5, 1) for n in 'xyz']}, 'x has datatype 5 and count 1'),
    'count of x': ({'fields': [Field(n, 0, 7, 2) for n in 'xyz']}, 'x has datatype 7 and count 2'),
    'x beyond': ({'fields': [Field('x', 9, 7, 1)]}, 'ends at byte 13 .* point_step = 12'),
    'count beyond': ({'fields': [Field('i', 0, 2, 2**32 - 1)]}, 'ends at byte 4294967295'),
    'two x': ({'fields': [Field('x', 0, 7, 1), Field('x', 4, 7, 1)]}, 'two fields .* differ'),
    'data short': ({'data': bytes(35)}, '35 bytes of data, expected .* 36 \\* 1 = 36'),
    'padded rows short': ({'height': 3, 'row_step': 40, 'data': bytes(119)}, '119 bytes of data'),
    'no data': ({'data': b''}, '0 bytes of data'),
    'row_step': ({'row_step': 35, 'data': bytes(35)}, '35 bytes .* 12 \\* 3 \\* 1 = 36'),
    'height': ({'height': 2}, 'expected row_step \\* height = 36 \\* 2 = 72'),
    'no point_step': ({'point_step': 0}, 'point_step is 0'),
    'huge': (
        {'height': 2**32 - 1, 'width': 2**32 - 1, 'row_step': 2**32 - 1},
        '36 bytes of data',
    ),
    'list': ({'data': [0] * 36}, 'data is a list, expected a buffer of bytes'),
    'nanosec': ({'stamp': (0, 10**9)}, 'stamp of 0 s and 1000000000 ns'),
    'negative': ({'stamp': (-1, 0)}, 'stamp of -1 s'),
}


@pytest.mark.parametrize('name', INVALID)
def test_an_invalid_message_is_refused_by_topic_found_and_expected(name):
    changes, expected = INVALID[name]
    with pytest.raises(CloudFormatError, match=f'/lidar: .*{expected}'):
        to_scan(replace(message(XYZ, 12), **changes), '/lidar')


@pytest.mark.parametrize('row_step', [0, 4, 144, 2**32 - 1])
@pytest.mark.parametrize('height', [1, 3])
def test_packed_points_are_read_whatever_row_step_says(row_step, height, caplog):
    msg = message(XYZ, 12, width=12 // height, height=height)
    warn_of_layout.cache_clear()
    for _ in range(2):
        scan = to_scan(replace(msg, row_step=row_step), '/lidar')
        np.testing.assert_array_equal(scan.points, to_scan(msg).points)
    is_true = row_step == msg.row_step
    assert [r.message.partition(',')[0] for r in caplog.records] == (
        [] if is_true else [f'/lidar: row_step is {row_step}']
    )


@pytest.mark.parametrize(('height', 'row_step'), [(1, 36), (1, 0), (3, 36), (3, 40)])
def test_bytes_after_the_points_are_ignored_with_a_warning(height, row_step, caplog):
    msg = message(XYZ, 12, width=3, height=height, padding=max(row_step - 36, 0))
    warn_of_layout.cache_clear()
    longer = replace(msg, row_step=row_step, data=bytes(msg.data) + bytes(100))
    np.testing.assert_array_equal(to_scan(longer).points, to_scan(msg).points)
    assert len(caplog.records) == 1


def test_fields_that_repeat_a_name_are_named_and_the_first_is_read(caplog):
    warn_of_layout.cache_clear()
    assert_decodes(message([*XYZ, ('intensity', 12, 7), ('intensity', 16, 4)], 18))
    assert [r.message for r in caplog.records] == [
        "points: two fields 'intensity' that differ, the first is read"
    ]


def test_fields_are_appended_to_packed_points_whatever_row_step_says():
    msg, words = message(XYZ, 12, width=4, height=2), np.arange(8, dtype=np.uint32)[:, None]
    expected = append_fields(msg, words, [('n', 6, 1)])
    np.testing.assert_array_equal(
        append_fields(replace(msg, row_step=0), words, [('n', 6, 1)]).data, expected.data
    )


def test_data_that_is_not_contiguous_is_refused():
    with pytest.raises(CloudFormatError, match='expected a buffer of bytes'):
        to_scan(replace(message(XYZ, 12), data=memoryview(bytes(72))[::2]))


@st.composite
def valid_messages(draw):
    """Return a message of any layout: fields in any order, padding, either byte order."""
    names = [*'xyz', *draw(st.lists(st.sampled_from(['i', 'ring', 't', '', 'xy']), max_size=4))]
    fields, ends = [], [0]
    for name in draw(st.permutations(names)):
        coordinate = name in ('x', 'y', 'z')
        datatype = draw(st.sampled_from([7, 8] if coordinate else sorted(CODES)))
        count = draw(st.integers(0, 1 if coordinate else 3))
        offset = ends[-1] + draw(st.integers(0, 5))
        fields.append(Field(name, offset, datatype, count))
        ends.append(offset + max(count, 1) * struct.calcsize(CODES[datatype]))
    fields = draw(st.permutations(fields))
    point_step = ends[-1] + draw(st.integers(0, 9))
    height, width = draw(st.integers(1, 3)), draw(st.integers(1, 4))
    row_step = width * point_step + draw(st.integers(0, 9))
    data = np.random.default_rng(draw(st.integers(0, 99))).integers(
        0,
        120,
        row_step * height,
        np.uint8,  # below 127, so that no float is nan
    )
    big = draw(st.booleans())
    return Message(height, width, fields, point_step, row_step, data.tobytes(), is_bigendian=big)


@given(valid_messages())
@settings(max_examples=300, deadline=None)
def test_any_valid_layout_decodes_like_one_number_at_a_time(msg):
    assert_decodes(msg)


def filled(cloud, stamp=(1, 500)):
    """Return the columns of a message made of encoded bytes, as the decoder reads them."""
    names = ('height', 'width', 'fields', 'point_step', 'row_step', 'data', 'is_bigendian')
    return Message(**{name: getattr(cloud, name) for name in names}, stamp=stamp)


def test_columns_of_every_type_come_back_equal():
    rng = np.random.default_rng(3)
    columns = {
        name: rng.integers(0, 100, 50).astype(dtype)
        for name, dtype in [
            ('x', 'f4'),
            ('u1', 'u1'),
            ('y', 'f4'),
            ('z', 'f4'),
            ('i1', 'i1'),
            ('u2', 'u2'),
            ('f8', '>f8'),
            ('i2', 'i2'),
            ('i4', 'i4'),
            ('u4', 'u4'),
        ]
    }
    columns['normal'] = rng.normal(size=(50, 3)).astype(np.float32)
    cloud = from_columns(columns)
    msg = filled(cloud)
    scan = to_scan(msg)

    assert [field.name for field in cloud.fields] == [*columns]
    assert cloud.is_dense
    for field in cloud.fields:
        assert field.offset % struct.calcsize(CODES[field.datatype]) == 0
        np.testing.assert_array_equal(twin(msg, field), columns[field.name])
    np.testing.assert_array_equal(scan.columns['normal'], columns['normal'])
    np.testing.assert_array_equal(scan.points[:, 1], columns['y'])


@pytest.mark.parametrize('value', [np.nan, np.inf])
def test_a_number_that_is_not_finite_makes_a_cloud_not_dense(value):
    assert not from_columns({'x': np.array([0.0, value]), 'n': np.array([1, 2], 'u4')}).is_dense


@pytest.mark.parametrize(
    'columns',
    [
        {},
        {'x': np.zeros(3), 'y': np.zeros(4)},
        {'x': np.zeros((3, 1, 1))},
        {'x': np.float64(1.0)},
        {'': np.zeros(3)},
        {'x': np.zeros(3, np.int64)},
        {'x': np.array(['a'])},
    ],
)
def test_columns_of_different_lengths_are_refused(columns):
    with pytest.raises(ValueError, match='column'):
        from_columns(columns)


def test_surfels_become_the_columns_of_normals():
    surfels = replace(make_surfels(2), covariance=None)
    cloud = from_columns(surfel_columns(surfels))
    assert ' '.join(f.name for f in cloud.fields) == (
        'x y z normal_x normal_y normal_z curvature planarity num_points '
        'thickness normal_sigma radius num_scans size'
    )
    assert [f.datatype for f in cloud.fields] == [7] * 8 + [6, 7, 7, 7, 6, 7]
    assert cloud.data.tobytes() == b''.join(
        struct.pack(
            '<8fI3fIf',
            *surfels.position[i],
            *surfels.normal[i],
            surfels.curvature[i],
            surfels.planarity[i],
            surfels.num_points[i],
            *(getattr(surfels, name)[i] for name in QUALITY),
        )
        for i in range(2)
    )


def test_messages_of_rclpy_decode_and_take_the_bytes():
    messages = pytest.importorskip('sensor_msgs.msg')
    points = np.random.default_rng(1).normal(size=(20, 3))
    ring = np.arange(20, dtype=np.uint16)
    cloud = from_columns({**dict(zip('xyz', points.T, strict=True)), 'ring': ring})
    msg = messages.PointCloud2()
    msg.header.frame_id = 'lidar'
    msg.header.stamp.sec, msg.header.stamp.nanosec = 5, 6
    for name in ('height', 'width', 'point_step', 'row_step', 'is_bigendian', 'is_dense'):
        setattr(msg, name, getattr(cloud, name))
    msg.fields = [
        messages.PointField(name=f.name, offset=f.offset, datatype=f.datatype, count=f.count)
        for f in cloud.fields
    ]
    msg.data = array.array('B', cloud.data.tobytes())

    scan = to_scan(msg)

    np.testing.assert_array_equal(scan.points, points)
    np.testing.assert_array_equal(scan.columns['ring'], ring)
    assert (scan.stamp_ns, scan.frame_id) == (5_000_000_006, 'lidar')


names = st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=9)
uint32 = st.integers(0, 2**32 - 1)
fields = st.lists(st.tuples(names, uint32, st.integers(0, 255), uint32), max_size=5)


def cloud_message(store, fields, frame_id, sizes, data, flags, stamp):
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
        raw = bytes(
            ROS2.serialize_cdr(cloud_message(ROS2, *arguments), CLOUD, little_endian=order)
        )
        assert_same(parse_cloud(raw), ROS2.deserialize_cdr(raw, CLOUD))
    raw = bytes(ROS1.serialize_ros1(cloud_message(ROS1, *arguments), CLOUD))
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


def test_a_message_truncated_at_any_byte_is_refused():
    raw = drive_cloud()
    for size in range(len(raw)):
        with pytest.raises(CloudFormatError, match=f'/lidar: {size} bytes that are not a whole'):
            parse_cloud(raw[:size], topic='/lidar')


def test_counts_beyond_the_message_are_refused_before_the_loop():
    raw = bytearray(drive_cloud())
    at = raw.index(b'\4\0\0\0\2\0\0\0x\0')
    raw[at : at + 4] = b'\xff\xff\xff\xff'

    with pytest.raises(CloudFormatError, match='4294967295 fields announced'):
        parse_cloud(bytes(raw))


def test_an_encoding_other_than_plain_cdr_is_refused():
    raw = b'\x00\x07' + drive_cloud()[2:]

    with pytest.raises(CloudFormatError, match=r'encoding 0007, expected plain CDR'):
        parse_cloud(raw)


def test_a_name_that_is_not_utf8_is_refused():
    raw = drive_cloud().replace(b'intensity', b'intens\xff\xfey')

    with pytest.raises(CloudFormatError, match='utf-8'):
        parse_cloud(raw)
