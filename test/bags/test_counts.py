# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Bags of more records, chunks, topics or types than recordings have are refused early.

Each took seconds for a few megabytes, or for a few kilobytes packed. The work is counted here, not
timed: no limit is passed by more than the records that are counted together.
"""

from __future__ import annotations

import struct

import pytest

from surfel_mapper.bags import bag_file, chunked, decoders, mcap
from surfel_mapper.bags.reader import BagReader
from surfel_mapper.bags.runs import CHECK_EVERY
from surfel_mapper.errors import BagError
from test.bags.records import packed_as, record, text

HEAD = b'\x89MCAP0\r\n' + record(1, text(b'ros2') + text(b''))
SCHEMA = record(3, struct.pack('<H', 1) + text(b'a/msg/A') + text(b'ros2msg') + text(b''))
UNKNOWN = record(99, b'')


def channel(key=1, topic=b'/a'):
    return record(4, struct.pack('<HH', key, 1) + text(topic) + text(b'cdr') + bytes(4))


def message(key=1):
    return record(5, struct.pack('<HIQQ', key, 0, 5, 5))


def chunk(records, packing=b''):
    packed = packed_as(packing, records)
    head = struct.pack('<QQQI', 5, 5, len(records), 0) + text(packing)
    return record(6, head + struct.pack('<Q', len(packed)) + packed)


def fields(**values):
    parts = [name.encode() + b'=' + value for name, value in values.items()]
    return b''.join(struct.pack('<I', len(part)) + part for part in parts)


def record1(content, **values):
    header = fields(**values)
    return struct.pack('<I', len(header)) + header + struct.pack('<I', len(content)) + content


def connection(key=0, type_=b'a/A'):
    topic = b'/t%d' % key
    described = fields(
        topic=topic, type=type_, md5sum=b'x', message_definition=b'uint8 a\nuint8 b'
    )
    return record1(described, op=b'\x07', conn=struct.pack('<I', key), topic=topic)


def message1(key=0):
    values = {'op': b'\x02', 'conn': struct.pack('<I', key), 'time': bytes(8)}
    return record1(b'\1\2', **values)


def chunk1(records, packing=b'none'):
    packed = packed_as(packing, records)
    return record1(packed, op=b'\x05', compression=packing, size=struct.pack('<I', len(records)))


def bag1(*parts):
    header = {'index_pos': bytes(8), 'conn_count': bytes(4), 'chunk_count': bytes(4)}
    return b'#ROSBAG V2.0\n' + record1(b'', op=b'\x03', **header) + b''.join(parts)


MANY = chunked.MAX_OTHERS + CHECK_EVERY
START = chunk(SCHEMA + channel() + message())
START1 = chunk1(connection() + message1())
REFUSED = {
    'channels.mcap': lambda: HEAD + SCHEMA + channel() * MANY + message(),
    'packed channels.mcap': lambda: HEAD + chunk(SCHEMA + channel() * MANY + message(), b'zstd'),
    'unknown.mcap': lambda: HEAD + START + UNKNOWN * MANY,
    'packed unknown.mcap': lambda: HEAD + START + chunk(UNKNOWN * MANY, b'zstd'),
    'few in many.mcap': lambda: HEAD + START + chunk(UNKNOWN * 100, b'zstd') * (MANY // 100),
    'damaged.mcap': lambda: HEAD + START + chunk(UNKNOWN * 100 + b'x', b'zstd') * (MANY // 100),
    'connections.bag': lambda: bag1(chunk1(connection() * MANY + message1(), b'bz2')),
    'unknown.bag': lambda: bag1(START1, record1(b'', op=b'\x63') * MANY),
    'packed unknown.bag': lambda: bag1(START1, chunk1(record1(b'', op=b'\x63') * MANY, b'bz2')),
}


@pytest.mark.parametrize('name', REFUSED)
def test_many_records_beside_messages_are_refused(tmp_path, monkeypatch, name):
    path = tmp_path / name
    content = REFUSED[name]()
    assert len(content) < 32 * MANY
    path.write_bytes(content)
    counted = []
    count_others = chunked.ChunkedFile._count_others

    def noted(self, number):
        counted.append(self._others)
        count_others(self, number)

    monkeypatch.setattr(chunked.ChunkedFile, '_count_others', noted)
    with pytest.raises(BagError, match='records beside messages'):
        BagReader(path)
    assert chunked.MAX_OTHERS < sum(counted) <= MANY


@pytest.mark.parametrize('content', [HEAD + START + chunk(message()) * 4000, None])
def test_many_small_chunks_are_refused(tmp_path, content):
    path = tmp_path / ('a.bag' if content is None else 'a.mcap')
    path.write_bytes(content or bag1(START1, chunk1(message1()) * 4000))
    with pytest.raises(BagError, match='over 4000 chunks'):
        BagReader(path)


def test_many_topics_are_refused(tmp_path):
    numbers = range(bag_file.MAX_CONNECTIONS + 1)
    made = {
        'a.mcap': HEAD + SCHEMA + b''.join(channel(n, b'/t%d' % n) for n in numbers) + message(),
        'a.bag': bag1(chunk1(b''.join(map(connection, numbers)) + message1())),
    }
    for name, content in made.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(BagError, match='over 4096 topics'):
            BagReader(path)


def test_a_variable_admits_more_topics_chunks_and_records(tmp_path, monkeypatch):
    monkeypatch.setenv('SURFEL_MAPPER_MAX_BYTES', str(1 << 27))
    path = tmp_path / 'a.mcap'
    channels = b''.join(channel(n, b'/t%d' % n) for n in range(10_000))
    path.write_bytes(HEAD + chunk(SCHEMA + channels + message()) + chunk(message()) * 5000)
    with BagReader(path) as bag:
        assert len([*bag.topics]) == 10_000
        assert max(topic.count for topic in bag.topics) == 5001


def test_a_channel_that_each_chunk_repeats_is_parsed_once(tmp_path, monkeypatch):
    parsed = []
    made = mcap.ros2_connection
    monkeypatch.setattr(
        mcap, 'ros2_connection', lambda *args, **kw: parsed.append(args) or made(*args, **kw)
    )
    path = tmp_path / 'a.mcap'
    path.write_bytes(HEAD + chunk(SCHEMA + channel() + message()) * 50)
    with BagReader(path) as bag:
        assert len([*bag.messages()]) == 50
    assert len(parsed) == 1


def test_a_channel_before_its_schema_is_not_taken_for_a_repeated_one(tmp_path):
    path = tmp_path / 'a.mcap'
    path.write_bytes(HEAD + channel() + SCHEMA + channel() + message())
    with pytest.raises(BagError):
        BagReader(path)


def test_descriptions_of_topics_are_charged_to_the_budget(tmp_path):
    """Definitions of 16 MB, packed to some kilobytes, are kept as text."""
    definition = text(bytes(1 << 20))
    schemas = b''.join(
        record(3, struct.pack('<H', n) + text(b'a/msg/A') + text(b'ros2msg') + definition)
        for n in range(1, 40)
    )
    path = tmp_path / 'a.mcap'
    path.write_bytes(HEAD + chunk(schemas + channel() + message(), b'zstd'))
    with pytest.raises(BagError, match='descriptions'):
        BagReader(path)


def test_many_types_of_ros1_are_parsed_up_to_a_sum(tmp_path, monkeypatch):
    """Each type takes milliseconds, and was searched for among all of them."""
    number = 100
    parsed, names = [], []
    types, type_name = decoders.ros1_types, decoders.type_name
    monkeypatch.setattr(decoders, 'ros1_types', lambda c: parsed.append(c) or types(c))
    monkeypatch.setattr(decoders, 'type_name', lambda c: names.append(c) or type_name(c))
    path = tmp_path / 'a.bag'
    parts = [connection(n, b'a/A%d' % n) + message1(n) for n in range(number)]
    path.write_bytes(bag1(chunk1(b''.join(parts))))
    errors = []
    with BagReader(path) as bag:
        for found in bag.messages():
            try:
                assert bag.decode(found).b == 2
            except BagError as error:
                errors.append(str(error))
    assert all('too long together' in error for error in errors)
    most = (decoders.MAX_DEFINED + path.stat().st_size // decoders.BYTES_EACH) // (
        decoders.LEAST_DEFINITION
    )
    assert most - 2 <= len(parsed) <= most
    assert len(errors) == number - len(parsed)
    assert len(names) <= 3 * number


def test_messages_of_an_unreadable_type_leave_nothing_behind(tmp_path):
    """The error of the type kept the frames of each call, with the message."""
    path = tmp_path / 'a.bag'
    records = connection(0, b'a/A') + message1(0) * 100
    path.write_bytes(bag1(chunk1(records)).replace(b'uint8 b', b'!int8 b'))
    with BagReader(path) as bag:
        for found in bag.messages():
            with pytest.raises(BagError, match='Could not parse'):
                bag.decode(found)
        with pytest.raises(Exception, match='Could not parse') as last:
            bag._decoders.find(found.type)
        assert len(last.traceback) < 5
