# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
All whole messages of a truncated bag are read, and a warning states the offset of the cut.

(Longer than other files: four formats are cut in the same places.)
"""

import logging
import shutil
import sqlite3
import struct

from mcap.writer import CompressionType, IndexType, Writer
import numpy as np
import pytest

from surfel_mapper.bags.compression import import_zstd
from surfel_mapper.bags.reader import BagReader
from surfel_mapper.bags.writer import BagWriter
from surfel_mapper.errors import BagError
from surfel_mapper.messages.poses import StampedPose
from test.bags.recorded import (
    cut,
    drive,
    Entries,
    NUM_SCANS,
    PERIOD_NS,
    ROS1,
    ROS2,
    START_NS,
    write_ros1,
    write_rosbag2,
)
from test.bags.test_reader import assert_is_the_drive, KINDS, read

KEPT = [0.02, 0.3, 0.5, 0.9, 0.999]


def raws(entries):
    """Return the bytes of every message, as ROS 2 serialises them."""
    return [ROS2.serialize_cdr(message, type_) for _, type_, _, message in entries]


def file_of(path):
    (file,) = (file for file in path.iterdir() if file.name != 'metadata.yaml')
    return file


def read_raws(path):
    with BagReader(path) as reader:
        return [bytes(message.raw) for message in reader.messages()], reader.cuts


@pytest.mark.parametrize('keep', KEPT)
@pytest.mark.parametrize(('storage', 'compression'), KINDS)
def test_the_whole_messages_of_a_truncated_file_are_read(
    tmp_path, caplog, storage, compression, keep
):
    written = raws(drive())
    path = write_rosbag2(tmp_path / 'drive', drive(), storage, compression)
    cut(file_of(path), keep)

    try:
        found, cuts = read_raws(path)
    except BagError:  # nothing was whole: zstd packs blocks of 128 KiB
        assert compression != 'none' or keep == KEPT[0]
        return

    # a database has rows of small messages before the further pages of a large one
    assert found == [raw for raw in written if raw in found]
    assert 0 < len(found) <= len(written)
    assert cuts
    assert all(f'{path}' in text for text in cuts)
    assert 'at byte ' in cuts[0]
    assert [record.message for record in caplog.records] == cuts


@pytest.mark.parametrize('keep', KEPT)
def test_every_message_before_the_cut_of_an_mcap_file_is_read(tmp_path, keep):
    path = write_rosbag2(tmp_path / 'drive', drive())
    cut(file_of(path), keep)
    left = file_of(path).read_bytes()
    expected = [raw for raw in raws(drive()) if raw in left]

    found, cuts = read_raws(path)

    assert found == expected
    offset = int(cuts[0].split('at byte ')[1].split()[0])
    assert offset <= len(left)
    assert all(left.index(raw) < len(left) for raw in expected)


@pytest.mark.parametrize('keep', KEPT)
@pytest.mark.parametrize('compression', [None, 'BZ2', 'LZ4'])
def test_every_message_before_the_cut_of_a_ros1_bag_is_read(tmp_path, compression, keep):
    written = [ROS1.serialize_ros1(m, type_) for _, type_, _, m in drive(ROS1)]
    path = write_ros1(tmp_path / 'drive.bag', drive(ROS1), compression)
    cut(path, keep)

    try:
        found, cuts = read_raws(path)
    except BagError:  # nothing was whole: bz2 packs blocks of 900 kB
        assert compression == 'BZ2' or (compression and keep == KEPT[0])
        return

    assert found == written[: len(found)]
    assert 'cut off or damaged at byte' in cuts[0]
    if compression is None:
        left = path.read_bytes()
        assert found == [raw for raw in written if raw in left]


@pytest.mark.parametrize('indexed', [True, False])
def test_a_chunk_of_mcap_with_a_wrong_checksum_is_skipped_and_counted(tmp_path, caplog, indexed):
    from mcap.writer import CompressionType, Writer

    path = tmp_path / 'a.mcap'
    with open(path, 'wb') as file:
        writer = Writer(file, chunk_size=2000, compression=CompressionType.NONE)
        writer.start('ros2', '')
        schema = writer.register_schema('std_msgs/msg/String', 'ros2msg', b'')
        channel = writer.register_channel('/a', 'cdr', schema)
        for i in range(100):
            writer.add_message(channel, i, bytes([i]) * 200, i)
        writer.finish()
    content = bytearray(path.read_bytes())
    content[content.index(bytes([50]) * 200)] ^= 1
    if not indexed:
        del content[-200:]
    path.write_bytes(content)

    found, cuts = read_raws(path)

    lost = sorted(set(range(100)) - {raw[0] for raw in found})
    assert 50 in lost
    assert lost == list(range(lost[0], lost[-1] + 1))  # one chunk
    assert len(lost) < 12
    assert [raw[0] for raw in found] == sorted(set(range(100)) - set(lost))
    assert any('1 damaged chunks are skipped' in cut and 'wrong checksum' in cut for cut in cuts)
    assert set(cuts) <= {record.message for record in caplog.records}


def test_a_ros1_bag_whose_index_disagrees_with_its_chunks_is_read_from_the_chunks(tmp_path):
    path = write_ros1(tmp_path / 'drive.bag', drive(ROS1))
    written = [ROS1.serialize_ros1(m, type_) for _, type_, _, m in drive(ROS1)]
    content = bytearray(path.read_bytes())
    at = content.rindex(b'topic=/odom')
    at = content.rindex(b'conn=', 0, at) + len('conn=')
    content[at] ^= 64
    path.write_bytes(content)

    found, cuts = read_raws(path)

    assert found == written
    assert cuts == []


def test_a_ros1_recording_that_was_killed_is_read(tmp_path):
    path = write_ros1(tmp_path / 'drive.bag', drive(ROS1))
    content = bytearray(path.read_bytes())
    at = content.index(b'index_pos=') + len('index_pos=')
    content[at : at + 8] = bytes(8)
    start = content.index(b'op=\x05') - 4
    while content[start : start + 4] != struct.pack('<I', 4):
        start -= 1
    # the header of the only chunk, and behind it the length of its data, which is written last
    header_at = content.rindex(b'#ROSBAG', 0, start) + len('#ROSBAG V2.0\n')
    (length,) = struct.unpack_from('<I', content, header_at)
    header_at += 4 + length
    (length,) = struct.unpack_from('<I', content, header_at)
    header_at += 4 + length  # behind the bag's own header and its padding
    (chunk_header,) = struct.unpack_from('<I', content, header_at)
    length_at = header_at + 4 + chunk_header
    (size,) = struct.unpack_from('<I', content, length_at)
    content[length_at : length_at + 4] = bytes(4)
    active = tmp_path / 'drive.bag.active'
    active.write_bytes(content[: length_at + 4 + size])

    with BagReader(active) as reader:
        assert reader.is_ros1
        assert reader.cuts
        assert_is_the_drive([(m, reader.decode(m)) for m in reader.messages()])


def many_small(number=3000):
    entries = Entries()
    for i in range(number):
        entries.odometry('/odom', START_NS + i * PERIOD_NS, (float(i), 0.0, 0.0))
    return entries


@pytest.mark.parametrize('keep', [0.1, 0.5, 0.97])
def test_rows_of_a_deep_database_are_read_though_the_tree_above_them_is_lost(tmp_path, keep):
    path = write_rosbag2(tmp_path / 'many', many_small(), 'sqlite3')
    written, file = raws(many_small()), file_of(path)
    cut(file, keep)
    whole = file.stat().st_size // 4096
    content, expected = file.read_bytes(), 0
    for page in range(whole):  # rows lie in the order of their number, and in one page each
        rows = content[4096 * page : 4096 * (page + 1)]
        while expected < len(written) and written[expected] in rows:
            expected += 1

    found, cuts = read_raws(path)

    assert found == written[:expected]
    assert expected > 0.8 * keep * len(written)
    assert f'at byte {4096 * whole} of ' in cuts[0]


def test_messages_in_the_journal_give_a_warning(tmp_path):
    path = write_rosbag2(tmp_path / 'drive', drive(), 'sqlite3')
    with sqlite3.connect(path / 'drive.db3') as database:
        database.execute('PRAGMA journal_mode=WAL')
        database.execute('DELETE FROM messages WHERE id = 1')
        database.commit()
        shutil.copytree(path, tmp_path / 'killed')

    with BagReader(tmp_path / 'killed' / 'drive.db3') as reader:
        assert 'drive.db3-wal: journal with messages that are not read' in reader.cuts[0]


def write_mcap(path, entries, **options):
    """Write an mcap file with the library of the format, as other recorders do."""
    with open(path, 'wb') as stream:
        writer = Writer(stream, **options)
        writer.start('ros2')
        channels = {}
        for topic, type_, record_ns, message in entries:
            if topic not in channels:
                schema = writer.register_schema(type_, 'ros2msg', b'')
                channels[topic] = writer.register_channel(topic, 'cdr', schema)
            raw = ROS2.serialize_cdr(message, type_)
            writer.add_message(channels[topic], record_ns, raw, record_ns)
        writer.finish()
    return path


LAYOUTS = {
    'lz4': {'compression': CompressionType.LZ4},
    'zstd': {'compression': CompressionType.ZSTD, 'chunk_size': 100_000},
    'no chunks': {'use_chunking': False, 'compression': CompressionType.NONE},
    'no index': {
        'index_types': IndexType.NONE,
        'use_statistics': False,
        'use_summary_offsets': False,
        'repeat_channels': False,
        'repeat_schemas': False,
    },
    'chunks without message index': {'index_types': IndexType.CHUNK},
}


@pytest.mark.parametrize('options', LAYOUTS.values(), ids=LAYOUTS)
def test_mcap_of_every_layout_reads_whole_and_without_a_warning(tmp_path, caplog, options):
    path = write_mcap(tmp_path / 'drive.mcap', drive(), **options)

    assert_is_the_drive(read(path))
    assert caplog.records == []


@pytest.mark.parametrize('options', LAYOUTS.values(), ids=LAYOUTS)
@pytest.mark.parametrize('keep', [0.4, 0.95])
def test_mcap_of_every_layout_reads_up_to_the_cut(tmp_path, options, keep):
    path = write_mcap(tmp_path / 'drive.mcap', drive(), **{'chunk_size': 100_000, **options})
    cut(path, keep)

    found, cuts = read_raws(path)

    assert found == raws(drive())[: len(found)]
    assert len(found) >= 0.4 * keep * len(raws(drive()))
    assert cuts


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('keep', [1.0, 0.9])
def test_latched_topics_are_found_with_and_without_index(tmp_path, storage, keep):
    pose = StampedPose('base_link', 'lidar', START_NS, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    with BagWriter(tmp_path / 'a', storage) as bag:
        bag.write_transform('/tf_static', START_NS, pose, latched=True)
        for i in range(200):
            bag.write_transform('/tf', START_NS + i, pose)
    cut(file_of(tmp_path / 'a'), keep)

    with BagReader(tmp_path / 'a') as reader:
        assert bool(reader.cuts) == (keep < 1.0)
        assert reader.is_latched('/tf_static')
        assert not reader.is_latched('/tf')


def test_messages_out_of_order_without_an_index_come_sorted(tmp_path):
    shuffled = list(drive())
    np.random.default_rng(2).shuffle(shuffled)
    path = write_mcap(tmp_path / 'drive.mcap', shuffled, **LAYOUTS['no chunks'])

    times = [message.record_ns for message, _ in read(path)]

    assert times == sorted(row[2] for row in drive())


def test_the_last_of_several_files_may_be_unreadable(tmp_path, caplog):
    path = write_rosbag2(tmp_path / 'drive', drive())
    (path / 'metadata.yaml').unlink()
    (path / 'drive_2.mcap').write_bytes(b'')

    assert_is_the_drive(read(path))
    assert 'drive_2.mcap: cannot be read' in caplog.text


def loose_files(directory, *parts):
    """Write messages into drive_1.mcap, drive_2.mcap and so on, without metadata.yaml."""
    directory.mkdir()
    for number, part in enumerate(parts, 1):
        write_mcap(directory / f'drive_{number}.mcap', part)
    return directory


@pytest.mark.parametrize('keep', [1.0, 0.5, 0.0])
@pytest.mark.parametrize('damage', [b'', b'damaged'])
def test_a_file_is_read_once_if_the_recorder_was_killed_while_it_packed_it(
    tmp_path, caplog, keep, damage
):
    path = loose_files(tmp_path / 'drive', drive()[:9], drive()[9:])
    packed = import_zstd().compress((path / 'drive_2.mcap').read_bytes())
    packed = damage + packed[: int(keep * len(packed))]
    (path / 'drive_2.mcap.zstd').write_bytes(packed)

    assert_is_the_drive(read(path))
    assert caplog.records == []


def test_the_last_of_several_files_may_be_packed_and_damaged(tmp_path, caplog):
    path = loose_files(tmp_path / 'drive', drive())
    (path / 'drive_2.mcap.zstd').write_bytes(b'damaged')

    assert_is_the_drive(read(path))
    assert 'file skipped, it cannot be read: ' in caplog.text
    assert 'drive_2.mcap.zstd: cannot be unpacked' in caplog.text


def test_the_first_of_several_files_must_be_readable(tmp_path):
    path = write_rosbag2(tmp_path / 'drive', drive())
    (path / 'metadata.yaml').unlink()
    (path / 'a.mcap').write_bytes(b'')

    with pytest.raises(BagError, match=r'a\.mcap: cannot be read'):
        BagReader(path)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3', 'ros1'])
def test_overwritten_bytes_in_a_truncated_file_give_messages_or_a_bag_error(tmp_path, storage):
    entries = drive(ROS1 if storage == 'ros1' else ROS2, num_scans=2)
    if storage == 'ros1':
        file = write_ros1(tmp_path / 'drive.bag', entries)
    else:
        file = file_of(write_rosbag2(tmp_path / 'drive', entries, storage))
    content = file.read_bytes()
    rng = np.random.default_rng(11)
    logging.disable(logging.WARNING)
    try:
        for _ in range(100):
            spoiled = bytearray(content[: int(rng.integers(len(content)))])
            start = int(rng.integers(max(len(spoiled) - 16, 1)))
            spoiled[start : start + 16] = rng.bytes(16)
            file.write_bytes(spoiled)
            try:
                assert len(read_raws(file)[0]) <= len(entries)
            except BagError:
                continue
    finally:
        logging.disable(logging.NOTSET)


def test_a_part_of_a_bag_by_record_time_is_read_alike_with_and_without_index(tmp_path):
    path = write_rosbag2(tmp_path / 'drive', drive())
    start, stop = START_NS + PERIOD_NS, START_NS + 3 * PERIOD_NS
    expected = [row[2] for row in drive() if start <= row[2] < stop]

    for keep in (1.0, 0.99):
        cut(file_of(path), keep)
        with BagReader(path) as reader:
            found = reader.messages(None, start, stop)
            assert [message.record_ns for message in found] == expected
    assert 0 < len(expected) < NUM_SCANS * 4
