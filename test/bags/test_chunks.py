# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Messages in chunks are found in their place: in runs of equal size, mixed, and up to damage.

The files are made of bytes here, so that the expected messages are known without a reader.
"""

import bz2
import random
import struct

import pytest

from surfel_mapper.bags.compression import import_zstd
from surfel_mapper.bags.reader import BagReader
from surfel_mapper.bags.runs import CHECK_EVERY, RUN
from surfel_mapper.errors import BagError

TYPE = 'std_msgs/msg/String'
TOPICS = '/a', '/b'
UNKNOWN = 7
"""A channel that no record describes."""


class Mcap:
    """Records and chunks of mcap."""

    name = 'made.mcap'

    def record(self, kind, content):
        return struct.pack('<BQ', kind, len(content)) + content

    def text(self, content):
        return struct.pack('<I', len(content)) + content

    def described(self, *ids):
        """Return the records that describe channels, by the place of their topic."""
        schema = struct.pack('<H', 1) + self.text(TYPE.encode()) + self.text(b'ros2msg')
        channels = (
            struct.pack('<HH', key, 1)
            + self.text(TOPICS[key].encode())
            + self.text(b'cdr')
            + struct.pack('<I', 0)
            for key in ids
        )
        channels = b''.join(self.record(4, content) for content in channels)
        return self.record(3, schema + self.text(b'')) + channels

    def message(self, key, stamp_ns, content):
        return self.record(5, struct.pack('<HIQQ', key, 0, stamp_ns, 0) + content)

    def chunk(self, records, checksum=0):
        packed = import_zstd().compress(records)
        head = struct.pack('<QQQI', 0, 0, len(records), checksum) + self.text(b'zstd')
        return self.record(6, head + struct.pack('<Q', len(packed)) + packed)

    def file(self, chunks):
        head = b'\x89MCAP0\r\n' + self.record(1, self.text(b'ros2') + self.text(b''))
        return head + b''.join(map(self.chunk, chunks)) + self.record(15, bytes(4))


class Ros1:
    """Records and chunks of a ROS 1 bag."""

    name = 'made.bag'

    def fields(self, **values):
        parts = (name.encode() + b'=' + value for name, value in values.items())
        return b''.join(struct.pack('<I', len(part)) + part for part in parts)

    def record(self, content, **values):
        header = self.fields(**values)
        return struct.pack('<I', len(header)) + header + struct.pack('<I', len(content)) + content

    def described(self, *ids):
        """Return the records that describe connections, by the place of their topic."""
        return b''.join(
            self.record(
                self.fields(
                    topic=TOPICS[key].encode(),
                    type=b'std_msgs/String',
                    md5sum=b'x',
                    message_definition=b'string data',
                ),
                op=b'\x07',
                conn=struct.pack('<I', key),
                topic=TOPICS[key].encode(),
            )
            for key in ids
        )

    def message(self, key, stamp_ns, content):
        time = struct.pack('<II', *divmod(stamp_ns, 10**9))
        return self.record(content, conn=struct.pack('<I', key), op=b'\x02', time=time)

    def chunk(self, records):
        size = struct.pack('<I', len(records))
        return self.record(bz2.compress(records), op=b'\x05', compression=b'bz2', size=size)

    def file(self, chunks):
        numbers = {'conn_count': bytes(4), 'chunk_count': bytes(4), 'index_pos': bytes(8)}
        head = self.record(b'', op=b'\x03', **numbers)
        return b'#ROSBAG V2.0\n' + head + b''.join(map(self.chunk, chunks))


FORMATS = [Mcap(), Ros1()]
NAMES = ['mcap', 'ros1']


def read(path):
    """Return topic, record time and bytes of all messages, and the sentences about damage."""
    with BagReader(path) as reader:
        found = [(m.topic, m.record_ns, bytes(m.raw)) for m in reader.messages()]
        return found, reader.cuts


def mixture(rng, number):
    """Return messages, some in runs of equal size, as (topic, record time, content)."""
    found = []
    while len(found) < number:
        size, key = rng.choice((0, 1, 40, 300)), rng.randrange(2)
        for _ in range(rng.choice((1, 1, 2, RUN, RUN + 1, RUN + 2, 100, 3 * CHECK_EVERY))):
            key = rng.randrange(2) if rng.random() < 0.5 else key
            found.append((key, rng.randrange(10**15), rng.randbytes(size)))
    return found


@pytest.mark.parametrize('made', FORMATS, ids=NAMES)
@pytest.mark.parametrize('seed', range(4))
def test_runs_and_mixtures_of_sizes_are_read_alike(tmp_path, made, seed):
    rng = random.Random(seed)
    chunks = [mixture(rng, 3000) for _ in range(3)]
    contents = [
        made.described(0, 1) + b''.join(made.message(*message) for message in messages)
        for messages in chunks
    ]
    path = tmp_path / made.name
    path.write_bytes(made.file(contents))
    expected = [(TOPICS[key], ns, content) for part in chunks for key, ns, content in part]
    found, cuts = read(path)
    assert found == sorted(expected, key=lambda message: message[1])
    assert len(cuts) == 1  # no index, and no end
    assert f'the {len(expected)} messages found are read' in cuts[0]


@pytest.mark.parametrize('made', FORMATS, ids=NAMES)
@pytest.mark.parametrize('place', [0, 1, RUN - 1, RUN, RUN + 1, RUN + 2, 500, 1023, 1024, 1999])
def test_messages_before_a_damaged_one_of_a_run_are_read(tmp_path, made, place):
    messages = [made.message(0, number, b'1234') for number in range(2000)]
    messages[place] = made.message(UNKNOWN, place, b'1234')
    path = tmp_path / made.name
    whole = made.described(0, 1) + made.message(1, 5000, b'')
    path.write_bytes(made.file([made.described(0) + b''.join(messages), whole]))
    found, cuts = read(path)
    expected = [('/a', number, b'1234') for number in range(place)]
    assert found == [*expected, ('/b', 5000, b'')]
    assert any('damaged' in cut for cut in cuts)


@pytest.mark.parametrize('made', FORMATS, ids=NAMES)
@pytest.mark.parametrize('keep', [RUN, 900])
def test_messages_before_the_cut_of_a_run_are_read(tmp_path, made, keep):
    messages = [made.message(0, number, b'1234') for number in range(1000)]
    size = len(made.described(0)) + keep * len(messages[0]) + 3
    path = tmp_path / made.name
    path.write_bytes(made.file([(made.described(0) + b''.join(messages))[:size]]))
    found, _ = read(path)
    assert found == [('/a', number, b'1234') for number in range(keep)]


def test_a_time_beyond_the_calendar_ends_a_run_of_mcap(tmp_path):
    made = Mcap()
    messages = [made.message(0, number, b'') for number in range(100)]
    messages[50] = made.message(0, 2**63 + 5, b'')
    path = tmp_path / made.name
    path.write_bytes(made.file([made.described(0) + b''.join(messages)]))
    found, cuts = read(path)
    assert [number for _, number, _ in found] == [*range(50)]
    assert cuts


def test_chunks_read_through_an_index_that_fails_are_read_again(tmp_path):
    """Chunks are numbered by the index or by their place; a chunk must not pass for another."""
    made = Mcap()
    contents = [
        made.described(key) + b''.join(made.message(key, ns + key, b'%d' % key) for ns in (1, 3))
        for key in (0, 1)
    ]
    data = bytearray(b'\x89MCAP0\r\n' + made.record(1, made.text(b'ros2') + made.text(b'')))
    spans = []
    for content, checksum in zip(contents, (12345, 0), strict=True):  # the first is damaged
        chunk = made.chunk(content, checksum)
        spans.append((len(data), len(chunk)))
        data += chunk
    data += made.record(15, bytes(4))
    summary_at = len(data)
    data += made.described(0, 1)
    for key in (1, 0):  # the other order
        start, size = spans[key]
        span = struct.pack('<QQQQ', 1 + key, 3 + key, start, size)
        offset = struct.pack('<IHQ', 10, key, start + size) + struct.pack('<Q', 15 + 2 * 16)
        data += made.record(8, span + offset + made.text(b'zstd') + bytes(16))
    counts = struct.pack('<IHQHQ', 20, 0, 2, 1, 2)
    data += made.record(11, struct.pack('<QHIIIIQQ', 4, 1, 2, 0, 0, 2, 1, 4) + counts)
    data += made.record(2, struct.pack('<QQI', summary_at, 0, 0)) + b'\x89MCAP0\r\n'
    path = tmp_path / made.name
    path.write_bytes(data)
    found, cuts = read(path)
    assert found == [('/b', 2, b'1'), ('/b', 4, b'1')]
    assert any('wrong checksum' in cut for cut in cuts)


@pytest.mark.parametrize(
    ('made', 'number', 'size'), [(Mcap(), 4, 20_000_000), (Ros1(), 3, 8_000_000)], ids=NAMES
)
def test_chunks_that_unpack_to_much_more_than_the_file_are_refused(tmp_path, made, number, size):
    content = made.described(0) + made.message(0, 1, bytes(size))
    path = tmp_path / made.name
    path.write_bytes(made.file([content] * number))
    with pytest.raises(BagError, match=rf'{made.name}: chunks of over \d+ bytes unpacked in \d+'):
        read(path)
    path.write_bytes(made.file([content] * (number - 2)))
    assert len(read(path)[0]) == number - 2


def test_an_environment_variable_admits_chunks_that_pack_well(tmp_path, monkeypatch):
    made = Ros1()
    content = made.described(0) + made.message(0, 1, bytes(8_000_000))
    path = tmp_path / made.name
    path.write_bytes(made.file([content] * 3))
    monkeypatch.setenv('SURFEL_MAPPER_MAX_BYTES', '100000000')
    assert len(read(path)[0]) == 3


@pytest.mark.parametrize('made', FORMATS, ids=NAMES)
def test_places_that_are_kept_leave_room_for_chunks(tmp_path, made, monkeypatch):
    """The places of 90,000 messages are dropped when a chunk needs their memory."""
    monkeypatch.setenv('SURFEL_MAPPER_MAX_BYTES', str(25 << 20))
    many = made.described(0) + b''.join(made.message(0, n, b'') for n in range(90_000))
    large = made.described(1) + made.message(1, 10**6, bytes(12 << 20))
    path = tmp_path / made.name
    path.write_bytes(made.file([many, large]))
    found, _ = read(path)
    assert len(found) == 90_001
    assert found[-1][0] == '/b'


@pytest.mark.parametrize('made', FORMATS, ids=NAMES)
def test_iterations_left_early_give_their_memory_back(tmp_path, made):
    """The index of the chunk has 5 MB, of 64 MiB for the file."""
    messages = (made.message(0, number, b'') for number in range(50_000))
    path = tmp_path / made.name
    path.write_bytes(made.file([made.described(0) + b''.join(messages)]))
    with BagReader(path) as reader:
        for _ in range(30):
            assert next(reader.messages()).record_ns == 0
        assert sum(1 for _ in reader.messages()) == 50_000
