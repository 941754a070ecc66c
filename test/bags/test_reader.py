# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags of every kind read the same; damaged ones are refused with a clear error."""

import logging
from pathlib import Path
import re
import shutil
import sqlite3

from mcap.writer import Writer
import numpy as np
import pytest
from rosbags import rosbag1, rosbag2

from surfel_mapper.bags.compression import import_zstd
from surfel_mapper.bags.reader import BagReader
from surfel_mapper.bags.topics import CLOUD, ODOMETRY, POSE, TF, Topic, Topics
from surfel_mapper.errors import BagError
from surfel_mapper.messages.pointcloud2 import to_scan
from test.bags import recorded
from test.bags.recorded import drive, NUM_SCANS, ROS1, write_ros1, write_rosbag2
from test.messages.test_livox import custom_message, DEFINITION
from test.messages.test_livox import TYPE as LIVOX

KINDS = [
    ('mcap', 'none'),
    ('mcap', 'storage'),
    ('mcap', 'file'),
    ('mcap', 'message'),
    ('sqlite3', 'none'),
    ('sqlite3', 'file'),
    ('sqlite3', 'message'),
]


def read(path):
    with BagReader(path) as reader:
        return [(message, reader.decode(message)) for message in reader.messages()]


def assert_is_the_drive(found):
    written = drive()
    assert [(m.topic, m.type, m.record_ns) for m, _ in found] == [row[:3] for row in written]
    for (_, got), (_, type_, _, expected) in zip(found, written, strict=True):
        if type_ == TF:
            got, expected = got.transforms[0], expected.transforms[0]
            assert got.transform.translation.x == expected.transform.translation.x
            assert got.child_frame_id == expected.child_frame_id
        if type_ == CLOUD:
            np.testing.assert_array_equal(got.data, expected.data)
        if type_ == ODOMETRY:
            assert got.pose.pose.position.x == expected.pose.pose.position.x
        if type_ == POSE:
            assert got.pose.position.x == expected.pose.position.x
        assert got.header.stamp.sec == expected.header.stamp.sec
        assert got.header.stamp.nanosec == expected.header.stamp.nanosec
        assert got.header.frame_id == expected.header.frame_id


@pytest.mark.parametrize(('storage', 'compression'), KINDS)
def test_a_rosbag2_directory_and_its_only_file_are_read(tmp_path, storage, compression):
    path = write_rosbag2(tmp_path / 'drive', drive(), storage, compression)

    assert_is_the_drive(read(path))
    (file,) = (file for file in path.iterdir() if file.name != 'metadata.yaml')

    assert_is_the_drive(read(file))


def unpack(file):
    with import_zstd().open(file) as packed:
        file.with_suffix('').write_bytes(packed.read())
    file.unlink()


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize(
    'change',
    [
        unpack,
        lambda file: file.rename(file.with_suffix('.zst')),
        lambda file: file.rename(file.with_suffix('')),  # packed, without the name of it
        lambda file: file.rename(file.with_name(f'renamed{"".join(file.suffixes)}')),
        lambda file: (unpack(file), file.with_suffix('').rename(file)),
    ],
    ids=['unpacked', 'zst', 'suffix removed', 'renamed', 'unpacked in place'],
)
def test_files_that_were_unpacked_or_renamed_are_read(tmp_path, storage, change):
    path = write_rosbag2(tmp_path / 'drive', drive(), storage, 'file')
    (file,) = (file for file in path.iterdir() if file.name != 'metadata.yaml')
    change(file)
    assert_is_the_drive(read(path))


def test_a_missing_file_of_several_is_refused_with_the_remedy(tmp_path):
    path = write_rosbag2(tmp_path / 'drive', drive())
    metadata = path / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('- drive.mcap', '- drive.mcap\n  - b.mcap'))
    with pytest.raises(BagError, match=r'b.mcap .*missing; without metadata.yaml .*: drive.mcap'):
        BagReader(path)


def write_encoded(path, encoding, entries):
    """Write an mcap file whose messages have another encoding than CDR."""
    with open(path, 'wb') as stream:
        writer = Writer(stream)
        writer.start(encoding)
        channels = {}
        for topic, type_, record_ns, message in entries:
            if topic not in channels:
                name, text = type_.replace('/msg/', '/'), b'\n\xa3\x01\xff protobuf'
                if encoding == 'ros1':
                    text = ROS1.generate_msgdef(type_, ros_version=1)[0].encode()
                schema = writer.register_schema(name, f'{encoding}msg', text)
                channels[topic] = writer.register_channel(topic, encoding, schema)
            raw = bytes(ROS1.serialize_ros1(message, type_))
            writer.add_message(channels[topic], record_ns, raw, record_ns)
        writer.finish()
    return path


def test_mcap_made_of_a_ros1_bag_is_read(tmp_path):
    assert_is_the_drive(read(write_encoded(tmp_path / 'drive.mcap', 'ros1', drive(ROS1))))


def test_another_encoding_is_named_with_the_packages_that_convert_it(tmp_path):
    path = write_encoded(tmp_path / 'drive.mcap', 'protobuf', drive(ROS1))
    says = r'/points \(sensor_msgs/PointCloud2 as protobuf\).*mcap-protobuf-support'
    with BagReader(path) as reader, pytest.raises(BagError, match=says):
        reader.topics.choose_cloud()


def test_a_bag_of_images_alone_is_refused_with_the_encodings_that_are_read():
    topics = Topics(Path('drive'), [Topic('/rgb/image', 'sensor_msgs/msg/Image', 9)])
    with pytest.raises(BagError, match=r'/rgb/image .*; images are read if they are .* 16UC1 or'):
        topics.choose_cloud()


@pytest.mark.parametrize(
    ('type_', 'program'),
    [
        ('velodyne_msgs/msg/VelodyneScan', 'velodyne_pointcloud'),
        ('ouster_sensor_msgs/msg/PacketMsg', 'ouster_ros'),
        ('hesai_ros_driver/msg/UdpFrame', 'hesai_ros_driver'),
        ('pandar_msgs/msg/PandarScan', 'hesai_ros_driver'),
        ('nebula_msgs/msg/NebulaPackets', 'nebula_ros'),
        ('rslidar_msg/msg/RslidarPacket', 'rslidar_sdk'),
        ('livox_ros_driver2/msg/CustomMsg', 'xfer_format 0'),
        ('sensor_msgs/msg/LaserScan', 'pointcloud_to_laserscan'),
        ('sensor_msgs/msg/PointCloud', 'convertPointCloudToPointCloud2'),
    ],
)
def test_messages_to_be_converted_are_named_with_the_program(type_, program):
    topics = Topics(Path('drive'), [Topic('/raw', type_, 9)])
    with pytest.raises(BagError, match=rf'/raw \({type_}\); to convert: {type_}: .*{program}'):
        topics.choose_cloud()


def with_livox(path, definition=DEFINITION):
    """Write the clouds of a drive as CustomMsg too, with a definition."""
    clouds = [row for row in drive() if row[1] == CLOUD]
    with rosbag2.Writer(path, version=9) as writer:
        connection = writer.add_connection(
            '/livox/lidar', LIVOX, msgdef=definition, rihs01=f'RIHS01_{64 * "0"}'
        )
        for _, _, record_ns, message in clouds:
            points = message.data.view('<f4').reshape(-1, 4)[:, :3]
            stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            raw = custom_message(points, stamp_ns=stamp_ns, frame_id='lidar')
            writer.write(connection, record_ns, raw)
    return path, clouds


def test_livox_messages_are_read_as_clouds(tmp_path):
    path, clouds = with_livox(tmp_path / 'drive')
    with BagReader(path) as reader:
        assert reader.topics.choose_cloud() == '/livox/lidar'
        decoded = [to_scan(reader.decode(message)) for message in reader.messages()]
    for scan, (*_, message) in zip(decoded, clouds, strict=True):
        np.testing.assert_array_equal(scan.points, to_scan(message).points)
        assert (scan.stamp_ns, scan.frame_id) == (to_scan(message).stamp_ns, 'lidar')


def test_livox_messages_of_a_ros1_bag_are_read(tmp_path):
    path, points = tmp_path / 'drive.bag', np.ones((5, 3), np.float32)
    name = LIVOX.replace('driver2', 'driver')
    definition = DEFINITION.replace('driver2', 'driver')
    with rosbag1.Writer(path) as writer:
        connection = writer.add_connection(
            '/livox/lidar', name, msgdef=definition, md5sum=32 * '0'
        )
        writer.write(connection, 10**9, custom_message(points, ros1=True))
    with BagReader(path) as reader:
        assert reader.topics.choose_cloud() == '/livox/lidar'
        (message,) = reader.messages()
        np.testing.assert_array_equal(to_scan(reader.decode(message)).points, points)


@pytest.mark.parametrize('definition', ['uint8 x', 'std_msgs/Header header\nfloat32[] points', ''])
def test_livox_messages_of_another_definition_are_refused(tmp_path, definition):
    path, _ = with_livox(tmp_path / 'drive', definition)
    with BagReader(path) as reader, pytest.raises(BagError, match=r'CustomMsg.*xfer_format 0'):
        reader.topics.choose_cloud()


def test_clouds_are_chosen_before_livox_messages():
    topics = [Topic('/livox', LIVOX, 1), Topic('/points', CLOUD, 1)]
    both = Topics(Path('drive'), topics, (CLOUD, LIVOX))
    assert both.choose_cloud() == '/points'
    assert both.choose_cloud('/livox') == '/livox'


def test_a_rosbag2_directory_may_have_the_suffix_of_ros1(tmp_path):
    assert_is_the_drive(read(write_rosbag2(tmp_path / 'drive.bag', drive())))


@pytest.mark.parametrize('compression', [None, 'BZ2', 'LZ4'])
def test_a_ros1_bag_yields_the_written_messages(tmp_path, compression):
    path = write_ros1(tmp_path / 'drive.bag', drive(ROS1), compression)

    assert_is_the_drive(read(path))


def test_a_recording_without_metadata_yields_all_its_files_in_order(tmp_path):
    messages = drive()
    path = tmp_path / 'drive'
    path.mkdir()
    for number, part in enumerate((messages[:9], messages[9:]), start=9):
        write_rosbag2(tmp_path / f'drive_{number}', part)
        shutil.copy(tmp_path / f'drive_{number}' / f'drive_{number}.mcap', path)

    assert_is_the_drive(read(path))


@pytest.mark.parametrize(
    ('stem', 'number', 'is_whole'), [('a', 1, True), ('a', 2, False), ('b', 9, True)]
)
def test_a_gap_in_the_numbers_of_files_without_metadata_is_named(
    tmp_path, caplog, stem, number, is_whole
):
    messages, path = drive(), tmp_path / 'drive'
    path.mkdir()
    for name, rows in (('a_0', messages[:9]), (f'{stem}_{number}', messages[9:])):
        write_rosbag2(tmp_path / name, rows)
        shutil.copy(tmp_path / name / f'{name}.mcap', path)
    read(path)
    assert [record.message for record in caplog.records] == (
        []
        if is_whole
        else [f'{path}: 2 files from a_0.mcap to a_2.mcap: is a part of the bag missing?']
    )


def test_a_file_that_metadata_does_not_list_is_named(tmp_path, caplog):
    path = write_rosbag2(tmp_path / 'drive', drive())
    shutil.copy(path / 'drive.mcap', path / 'drive_1.mcap')
    assert_is_the_drive(read(path))
    assert [record.message for record in caplog.records] == [
        f'{path}: drive_1.mcap is not in its metadata.yaml and not read'
    ]


def test_files_that_overlap_in_time_are_merged(tmp_path):
    messages = drive()
    path = tmp_path / 'drive'
    path.mkdir()
    for name, part in (('a', messages[::2]), ('b', messages[1::2])):
        write_rosbag2(tmp_path / name, part)
        shutil.copy(tmp_path / name / f'{name}.mcap', path)

    times = [message.record_ns for message, _ in read(path)]

    assert times == sorted(row[2] for row in messages)


def test_only_the_topics_asked_for_are_read(tmp_path):
    path = write_rosbag2(tmp_path / 'drive', drive())

    with BagReader(path) as reader:
        found = [message.topic for message in reader.messages(['/odom', '/pose'])]
        assert found == ['/odom', '/pose'] * NUM_SCANS
        assert reader.topics.num_messages(['/odom', '/tf_static']) == NUM_SCANS + 1
        assert list(reader.messages(['/none'])) == []


def test_record_times_are_stated_to_the_nanosecond(tmp_path):
    with BagReader(write_rosbag2(tmp_path / 'drive', drive())) as reader:
        assert reader.start_ns == recorded.START_NS
        assert reader.end_ns == recorded.START_NS + (NUM_SCANS - 1) * recorded.PERIOD_NS + 1000


def test_a_topic_is_chosen_by_name_else_default_else_as_the_only_one(tmp_path):
    messages = drive()
    messages.odometry('/wheel_odom', messages[-1][2] + 1, (0.0, 0.0, 0.0))
    with BagReader(write_rosbag2(tmp_path / 'drive', messages)) as reader:
        assert reader.topics.choose(CLOUD) == '/points'
        assert reader.topics.choose(ODOMETRY, '/wheel_odom') == '/wheel_odom'
        assert reader.topics.choose(ODOMETRY, default='/odom') == '/odom'
        assert reader.topics.choose(POSE, default='/not_there') == '/pose'


@pytest.mark.parametrize(
    ('type_', 'name', 'says'),
    [
        (
            ODOMETRY,
            None,
            'several topics .* name one with --pose-topic; Odometry topics: /odom, /wheel_odom',
        ),
        (CLOUD, '/pionts', 'no topic /pionts; PointCloud2 topics: /points'),
        (CLOUD, '/odom', '/odom is of type nav_msgs/msg/Odometry, not PointCloud2; .*: /points'),
        (
            'sensor_msgs/msg/Imu',
            None,
            r'no topic of .*/Imu; its topics: /odom \(nav_msgs/msg/Odometry\), ',
        ),
        ('sensor_msgs/msg/Imu', '/imu', 'no topic /imu; Imu topics: none'),
    ],
)
def test_a_choice_that_cannot_be_made_names_the_candidates(tmp_path, type_, name, says):
    messages = drive()
    messages.odometry('/wheel_odom', messages[-1][2] + 1, (0.0, 0.0, 0.0))
    path = write_rosbag2(tmp_path / 'drive', messages)
    with BagReader(path) as reader, pytest.raises(BagError, match=f'drive: {says}'):
        reader.topics.choose(type_, name)


def test_a_path_without_a_bag_is_refused(tmp_path):
    (tmp_path / 'notes.txt').write_text('no bag')
    (tmp_path / 'empty').mkdir()
    for day in ('mon', 'tue'):
        (tmp_path / 'days' / day).mkdir(parents=True)
    for name, says in (
        ('nothing', 'no such file or directory'),
        ('notes.txt', '.txt is not read; expected a bag'),
        ('empty', 'files in it: none; expected a bag: a directory with metadata.yaml'),
        ('days', 'files in it: none; its folders: mon, tue; expected a'),
    ):
        with pytest.raises(BagError, match=f'{name}: .*{says}'):
            BagReader(tmp_path / name)


@pytest.mark.parametrize(
    ('name', 'tool'), [('a.mcap', 'mcap'), ('a.db3', 'sqlite3'), ('a.bag', 'rosbag')]
)
@pytest.mark.parametrize('content', [b'', b'\x89MCAP0\r\n', b'#ROSBAG V2.0\n', bytes(100)])
def test_a_file_of_something_else_is_refused(tmp_path, name, tool, content):
    (tmp_path / name).write_bytes(content)

    is_of_kind = content[:4] == {'mcap': b'\x89MCA', 'rosbag': b'#ROS'}.get(tool)
    says = f'`{tool} ' if is_of_kind else f'begins with {re.escape(repr(content[:16]))}, expected'
    with pytest.raises(BagError, match=f'{name}: cannot be read: .*; .*{says}'):
        BagReader(tmp_path / name)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_rosbag2_without_messages_is_refused(tmp_path, storage):
    path = write_rosbag2(tmp_path / 'drive', drive(num_scans=0)[:0], storage)

    with pytest.raises(BagError, match='drive: a bag without messages'):
        BagReader(path)


def test_a_ros1_bag_without_messages_is_refused(tmp_path):
    path = write_ros1(tmp_path / 'drive.bag', [])

    with pytest.raises(BagError, match=r'drive\.bag: a bag without messages'):
        BagReader(path)


NOTHING_READ = r'fewer messages than its index states: .*/pose 0 of 6'


def test_a_topic_without_any_message_read_is_an_error(tmp_path):
    path = write_rosbag2(tmp_path / 'drive', drive(), 'sqlite3')
    with sqlite3.connect(path / 'drive.db3') as database:
        for raw in raw_of(path, '/pose'):
            database.execute('DELETE FROM messages WHERE data = ?', (raw,))

    with pytest.raises(BagError, match=NOTHING_READ):
        read(path)


def test_messages_that_are_not_cdr_are_passed_over(tmp_path, caplog):
    path = tmp_path / 'drive.mcap'
    with open(path, 'wb') as stream:
        writer = Writer(stream)
        writer.start('ros2')
        schema = writer.register_schema('foxglove.Log', 'jsonschema', b'{}')
        log = writer.register_channel('/log', 'json', schema)
        channels = {}
        for topic, type_, record_ns, message in drive():
            if topic not in channels:
                schema = writer.register_schema(type_, 'ros2msg', b'')
                channels[topic] = writer.register_channel(topic, 'cdr', schema)
            raw = recorded.ROS2.serialize_cdr(message, type_)
            writer.add_message(channels[topic], record_ns, raw, record_ns)
            writer.add_message(log, record_ns, b'{"message": "a scan"}', record_ns)
        writer.finish()

    assert_is_the_drive(read(path))
    assert caplog.records == []
    with BagReader(path) as reader:
        assert reader.topics.num_messages(['/log']) == len(drive())


def raw_of(path, topic):
    with BagReader(path) as reader:
        return [bytes(message.raw) for message in reader.messages([topic])]


def test_fewer_messages_than_the_index_states_give_a_warning(tmp_path, caplog):
    path = write_rosbag2(tmp_path / 'drive', drive())
    metadata = path / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace(f'count: {NUM_SCANS}\n', 'count: 50\n'))

    with caplog.at_level(logging.WARNING), BagReader(path) as reader:
        assert len([*reader.messages()]) == 4 * NUM_SCANS + 1

    says = f'fewer messages than its index states: /odom {NUM_SCANS} of 50, '
    assert says in caplog.text
    assert says in reader.cuts[0]


def test_a_message_that_is_not_of_its_type_is_a_bag_error(tmp_path):
    with BagReader(write_rosbag2(tmp_path / 'drive', drive())) as reader:
        message = next(iter(reader.messages(['/odom'])))
        for raw in (b'', message.raw[:100]):
            with pytest.raises(BagError, match=f'/odom: {len(raw)} bytes that are no nav_msgs'):
                reader.decode(message._replace(raw=raw))
        with pytest.raises(BagError, match='/odom: 724 bytes that are no my_msgs/msg/Unknown'):
            reader.decode(message._replace(type='my_msgs/msg/Unknown'))


@pytest.mark.parametrize('name', ['hall_os0_full', 'hall_os0_long'])
def test_real_bags_yield_as_many_messages_as_they_state(data_folder, name):
    with BagReader(data_folder / 'data' / 'bags' / name) as reader:
        scans = [reader.decode(message) for message in reader.messages(['/points'])]
        assert len(scans) == reader.topics.num_messages(['/points']) > 20
    assert all(scan.width * scan.point_step == len(scan.data) for scan in scans)


@pytest.mark.parametrize(
    ('content', 'says'),
    [
        (': : :', 'not the metadata of a bag'),
        ('{}', 'not the metadata of a bag: KeyError'),
        ('rosbag2_bagfile_information: 3', 'not the metadata of a bag: TypeError'),
        ('rosbag2_bagfile_information: {relative_file_paths: 3}', 'expected a list of names'),
        ('rosbag2_bagfile_information: {relative_file_paths: [drive.mcap]}', 'KeyError'),
    ],
)
def test_damaged_metadata_is_refused(tmp_path, content, says):
    path = write_rosbag2(tmp_path / 'drive', drive())
    (path / 'metadata.yaml').write_text(content)

    with pytest.raises(BagError, match=f'drive.*: .*{says}'):
        BagReader(path)
