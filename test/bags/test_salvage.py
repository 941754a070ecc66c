# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A cut mcap file is read up to the cut; other cut bags name the command that mends them."""

from pathlib import Path
import re
import shutil
import sqlite3
import struct
import subprocess

from mcap.writer import CompressionType, IndexType
import numpy as np
import pytest

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
    write_mcap,
    write_ros1,
    write_rosbag2,
)
from test.bags.test_reader import assert_is_the_drive, read

LAYOUTS = {
    'plain': {'compression': CompressionType.NONE},
    'lz4': {'compression': CompressionType.LZ4},
    'zstd': {'compression': CompressionType.ZSTD},
    'no chunks': {'use_chunking': False, 'compression': CompressionType.NONE},
    'no index': {
        'index_types': IndexType.NONE,
        'use_statistics': False,
        'use_summary_offsets': False,
        'repeat_channels': False,
        'repeat_schemas': False,
    },
    'no channels in the summary': {'repeat_channels': False, 'repeat_schemas': False},
    'chunks without message index': {'index_types': IndexType.CHUNK},
}


def raws(entries):
    """Return the bytes of every message, as ROS 2 serialises them."""
    return [ROS2.serialize_cdr(message, type_) for _, type_, _, message in entries]


def file_of(path):
    (file,) = (file for file in path.iterdir() if file.name != 'metadata.yaml')
    return file


def read_raws(path):
    with BagReader(path) as reader:
        return [bytes(message.raw) for message in reader.messages()], reader.cuts


@pytest.mark.parametrize('options', LAYOUTS.values(), ids=LAYOUTS)
def test_mcap_of_every_layout_reads_whole_and_without_a_warning(tmp_path, caplog, options):
    path = write_mcap(tmp_path / 'drive.mcap', drive(), **options)

    assert_is_the_drive(read(path))
    assert caplog.records == []


@pytest.mark.parametrize('options', LAYOUTS.values(), ids=LAYOUTS)
@pytest.mark.parametrize('keep', [0.3, 0.5, 0.9, 0.999])
def test_mcap_of_every_layout_is_read_up_to_a_chunk_before_the_cut(
    tmp_path, caplog, options, keep
):
    path = write_mcap(tmp_path / 'drive.mcap', drive(num_scans=30), **options)
    cut(path, keep)
    written = raws(drive(num_scans=30))

    messages, cuts = read_raws(path)

    assert messages == written[: len(messages)]
    assert len(messages) >= keep * len(written) - 4 * 2  # a chunk, and a scan that is not whole
    offset, size = map(int, re.search(r'at byte (\d+) of (\d+); ', cuts[0]).groups())
    assert offset <= size == path.stat().st_size
    assert f'the {len(messages)} messages found are read' in cuts[0]
    assert [record.message for record in caplog.records] == cuts


def test_a_cut_bag_of_chunks_that_overlap_in_time_is_read_in_order(tmp_path):
    shuffled = list(drive(num_scans=30))
    np.random.default_rng(2).shuffle(shuffled)
    path = write_mcap(tmp_path / 'drive.mcap', shuffled)
    cut(path, 0.8)

    with BagReader(path) as reader:
        times = [message.record_ns for message in reader.messages()]

    assert times == sorted(times)
    assert len(times) > 0.6 * len(shuffled)


@pytest.mark.parametrize('compression', ['file', 'message'])
def test_a_cut_file_of_packed_messages_is_read_up_to_the_cut(tmp_path, compression):
    entries = Entries()
    for row in drive(num_scans=80):
        entries.append(row)
    path = write_rosbag2(tmp_path / 'drive', entries, 'mcap', compression)
    cut(file_of(path), 0.9)

    messages, cuts = read_raws(path)

    assert messages == raws(entries)[: len(messages)]
    assert len(messages) > 0.5 * len(entries)
    assert 'cut off' in cuts[0]


@pytest.mark.parametrize('indexed', [True, False])
def test_a_damaged_chunk_of_mcap_ends_the_file_or_is_refused_with_the_remedy(tmp_path, indexed):
    path = tmp_path / 'a.mcap'
    entries = Entries()
    for i in range(100):
        entries.odometry('/odom', START_NS + i * PERIOD_NS, (float(i), 0.0, 0.0))
    write_mcap(path, entries, chunk_size=5000, compression=CompressionType.NONE)
    content = bytearray(path.read_bytes())
    content[content.index(raws(entries)[50]) + 700] ^= 1
    path.write_bytes(content if indexed else content[:-200])

    if indexed:
        with pytest.raises(
            BagError, match=rf'damaged after \d+ messages.*`mcap recover {path} -o'
        ):
            read_raws(path)
        return
    messages, cuts = read_raws(path)
    assert messages == raws(entries)[: len(messages)]
    assert 41 < len(messages) <= 50
    assert 'cut off or damaged at byte ' in cuts[0]


@pytest.mark.parametrize('keep', [0.3, 0.5, 0.9, 0.999])
def test_a_cut_database_is_refused_with_a_command_that_mends_it(tmp_path, monkeypatch, keep):
    entries = drive(num_scans=30)
    path = file_of(write_rosbag2(tmp_path / 'drive', entries, 'sqlite3'))
    cut(path, keep)
    monkeypatch.chdir(tmp_path)

    with pytest.raises(BagError, match=r'drive\.db3: cannot be read: .*') as refused:
        BagReader(path)

    if shutil.which('sqlite3') is None:
        pytest.skip('no sqlite3')
    recover, dump = re.findall('`(.*?)`', str(refused.value))
    assert recover == f'sqlite3 {path} .recover | sqlite3 mended.db3'
    subprocess.run(dump, shell=True, check=True, capture_output=True)
    messages, cuts = read_raws(Path('mended.db3'))
    written = raws(entries)
    assert len([raw for raw in messages if raw not in written]) <= 1  # in the page that was cut
    assert len(messages) > 0.9 * keep * len(entries)
    assert cuts == []


def test_a_cut_database_is_mended_by_recovery(tmp_path, monkeypatch):
    path = file_of(write_rosbag2(tmp_path / 'drive', drive(num_scans=30), 'sqlite3'))
    recover = f'sqlite3 {path} .recover | sqlite3 mended.db3'
    monkeypatch.chdir(tmp_path)
    done = subprocess.run(recover, shell=True, check=False, capture_output=True)
    if done.stderr:
        pytest.skip('this sqlite3 cannot recover, not even a whole database')
    Path('mended.db3').unlink()
    cut(path, 0.7)

    subprocess.run(recover, shell=True, check=True, capture_output=True)

    messages, _ = read_raws(Path('mended.db3'))
    assert len(messages) > 0.6 * len(drive(num_scans=30))


@pytest.mark.parametrize('keep', [0.02, 0.5, 0.999])
@pytest.mark.parametrize('compression', [None, 'BZ2', 'LZ4'])
def test_a_cut_ros1_bag_is_refused_with_the_command_that_mends_it(tmp_path, compression, keep):
    path = write_ros1(tmp_path / 'drive.bag', drive(ROS1), compression)
    cut(path, keep)

    with pytest.raises(BagError, match=r'drive\.bag: cannot be read: .*`rosbag reindex .*bag`'):
        read(path)


def test_a_ros1_recording_that_was_killed_is_refused_with_the_command_that_mends_it(tmp_path):
    path = write_ros1(tmp_path / 'drive.bag', drive(ROS1))
    content = bytearray(path.read_bytes())
    at = content.index(b'index_pos=') + len('index_pos=')
    content[at : at + 8] = bytes(8)
    active = tmp_path / 'drive.bag.active'
    active.write_bytes(content[: struct.unpack_from('<Q', path.read_bytes(), at)[0]])

    with pytest.raises(BagError, match=r'Bag is not indexed.*`rosbag reindex .*bag\.active`'):
        BagReader(active)


def test_messages_in_the_journal_give_a_warning(tmp_path):
    path = write_rosbag2(tmp_path / 'drive', drive(), 'sqlite3')
    with sqlite3.connect(path / 'drive.db3') as database:
        database.execute('PRAGMA journal_mode=WAL')
        database.execute('DELETE FROM messages WHERE id = 1')
        database.commit()
        shutil.copytree(path, tmp_path / 'killed')

    with BagReader(tmp_path / 'killed' / 'drive.db3') as reader:
        assert 'drive.db3-wal: journal with messages that are not read' in reader.cuts[0]


def test_a_bag_with_all_messages_in_its_journal_is_refused_with_the_remedy(tmp_path):
    path = write_rosbag2(tmp_path / 'drive', drive(), 'sqlite3')
    with sqlite3.connect(path / 'drive.db3') as database:
        rows = database.execute('SELECT topic_id, timestamp, data FROM messages').fetchall()
        database.execute('DELETE FROM messages')
        database.commit()
        database.execute('PRAGMA journal_mode=WAL')
        insert = 'INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)'
        database.execute('PRAGMA wal_autocheckpoint=0')
        database.executemany(insert, rows)
        database.commit()
        shutil.copytree(path, tmp_path / 'killed')
    file = tmp_path / 'killed' / 'drive.db3'

    with pytest.raises(BagError, match=r'without messages; .*-wal: journal with .* not read'):
        BagReader(file)

    with sqlite3.connect(file) as database:  # the remedy
        database.execute('PRAGMA wal_checkpoint(TRUNCATE)')
    with BagReader(file) as reader:
        assert sum(1 for _ in reader.messages()) == len(rows)


@pytest.mark.parametrize(('storage', 'keep'), [('mcap', 1.0), ('mcap', 0.9), ('sqlite3', 1.0)])
def test_latched_topics_are_found_with_and_without_index(tmp_path, storage, keep):
    pose = StampedPose('base_link', 'lidar', START_NS, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    with BagWriter(tmp_path / 'a', storage) as bag:
        bag.write_transform('/tf_static', START_NS, pose, latched=True)
        for i in range(15_000):
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


def test_the_first_of_several_files_must_be_readable(tmp_path):
    path = write_rosbag2(tmp_path / 'drive', drive())
    (path / 'metadata.yaml').unlink()
    (path / 'a.mcap').write_bytes(b'')

    with pytest.raises(BagError, match=r'a\.mcap: cannot be read'):
        BagReader(path)


def test_a_part_of_a_bag_by_record_time_is_read_alike_with_and_without_index(tmp_path):
    path = write_mcap(tmp_path / 'drive.mcap', drive())
    start, stop = START_NS + PERIOD_NS, START_NS + 3 * PERIOD_NS
    expected = [row[2] for row in drive() if start <= row[2] < stop]

    for keep in (1.0, 0.99):
        cut(path, keep)
        with BagReader(path) as reader:
            messages = reader.messages(None, start, stop)
            assert [message.record_ns for message in messages] == expected
    assert 0 < len(expected) < NUM_SCANS * 4
