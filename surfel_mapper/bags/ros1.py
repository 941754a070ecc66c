# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reading of ROS 1 bags, with and without a complete index.

After a line of text come records: a header of name=value fields with its length, and data with
its length. Messages lie in chunks, which are records of packed records. The first record states
the offset of the index, which has the connections and an entry for each chunk. It is used if it
agrees with the chunks; else the records are read from the beginning. A recorder that was killed
leaves the length of the last chunk zero, so that the records of the chunk follow as if they were
records of the file; both are read alike.

Source: wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

from array import array
import re
import struct

import numpy as np

from surfel_mapper.bags._rosbags import ros1_connection
from surfel_mapper.bags.bag_file import FoundMessage, Index, INDEX_COLUMNS
from surfel_mapper.bags.chunked import Chunk, ChunkedFile, DAMAGE, LOOSE, Packed
from surfel_mapper.bags.runs import (
    are_known,
    CHECK_EVERY,
    entries,
    equal_heads,
    number_at,
    RUN,
)

MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7

WORD = struct.Struct('<I')

MESSAGE_HEAD = struct.Struct('<9sI8s9sII')
"""Header of a message as rosbag writes it: its three fields, each after its length."""

USUAL = b'\x09\0\0\0conn=', b'\x04\0\0\0op=\x02', b'\x0d\0\0\0time='
"""The constant parts of such a header."""

HEAD_BYTES = 4 + MESSAGE_HEAD.size + 4
"""Bytes of such a record before its data."""

CONSTANT = slice(0, 13), slice(17, 34), slice(42, 46)
"""Bytes of them that are equal in a run: all but connection and time."""

MOST_HEADER_BYTES = 1 << 20
"""A longer header is damaged; message definitions are in the data."""

Fields = dict[str, bytes]


class Ros1File(ChunkedFile):
    """The messages of a ROS 1 bag."""

    MAGIC = b'#ROSBAG V2.0\n'

    def _survey(self) -> None:
        """Find the chunks through the index, or else record by record."""
        try:
            if self._read_index():
                return
        except DAMAGE:
            pass
        self._begin_again()
        self._read_records()

    def _read_index(self) -> bool:
        """Return whether there is an index that agrees with the chunks; keep its chunks."""
        fields, _, _ = self._record(len(self.MAGIC))
        (at,) = struct.unpack('<Q', fields['index_pos'])
        connections, chunks = (
            struct.unpack('<I', fields[name])[0] for name in ('conn_count', 'chunk_count')
        )
        if not len(self.MAGIC) < at <= self.size or fields.get('encryptor'):
            return False
        while at < self.size:
            self._budget.check_time()
            fields, start, size = self._record(at)
            kind = fields['op'][0]
            self._others += 1
            self._count_others(LOOSE)
            if kind == CONNECTION:
                self._note_connection(fields, self._at(start, size))
            elif kind == CHUNK_INFO:
                self._note_chunk_info(fields, self._at(start, size))
            at = start + size
        starts = {chunk.start for chunk in self._chunks}
        if len(starts) != chunks or len(self._chunks) != chunks:
            return False
        if len(self._by_id) != connections or at != self.size:
            return False
        self._check_connections()
        return not self.skipped_at

    def _note_chunk_info(self, fields: Fields, content: bytes) -> None:
        """Keep the chunk that a record of the index describes."""
        (start,) = struct.unpack('<Q', fields['chunk_pos'])
        counts = {key: count for key, count in struct.iter_unpack('<II', content) if count}
        if not len(self.MAGIC) < start < self.size:
            raise ValueError('index of a chunk beyond the data')
        _, data, size = self._record(start)
        is_whole = data + size <= self.size
        span = nanoseconds(fields['start_time']), nanoseconds(fields['end_time'])
        chunk = Chunk(start, data + size - start, is_whole, *span, counts)
        self._add_chunk(chunk)
        if counts:
            self._note_chunk(chunk)

    def _read_records(self) -> None:
        """Read the records up to the end of the file, or to the first damaged one."""
        at, has_index = len(self.MAGIC), False
        while at < self.size:
            self._budget.check_time()
            try:
                fields, start, size = self._record(at)
                kind = fields['op'][0]
                is_whole = start + size <= self.size
                if kind not in (CHUNK, MESSAGE):
                    self._others += 1
                    self._count_others(LOOSE)
                if kind == CHUNK:
                    end = min(start + size, self.size)
                    self._survey_chunk(Chunk(at, end - at, is_whole))
                elif kind == CONNECTION and is_whole:
                    self._note_connection(fields, self._at(start, size), is_new=not has_index)
                elif kind == MESSAGE and is_whole:
                    self._note_loose(self._found(fields, start, size, LOOSE))
            except DAMAGE:
                is_whole = False
            if not is_whole:
                self.cut_at = at
                return
            has_index = has_index or kind in (INDEX, CHUNK_INFO)
            at = start + size
        if not has_index:
            self.cut_at = self.size

    def _record(self, at: int) -> tuple[Fields, int, int]:
        """Return the header of a record of the file, and offset and length of its data."""
        (length,) = struct.unpack('<I', self._at(at, 4))
        if length > MOST_HEADER_BYTES:
            raise ValueError(f'header of {length} bytes')
        head = self._at(at + 4, length + 4)
        (size,) = struct.unpack('<I', head[length:])
        return header_fields(head[:length]), at + 8 + length, size

    def _head(self, chunk: Chunk) -> Packed:
        """Return the head of a chunk."""
        fields, start, size = self._record(chunk.start)
        if fields['op'][0] != CHUNK:
            raise ValueError('no chunk where the index has one')
        (unpacked_size,) = struct.unpack('<I', fields['size'])
        left = min(size, self.size - start)
        return Packed(start, left, fields['compression'].decode(), unpacked_size)

    def _walk(self, number: int, records: bytes | bytearray, index: array[int]) -> None:
        """Append the messages in the records of a chunk; keep or check connections."""
        at, word, head = 0, WORD.unpack_from, MESSAGE_HEAD.unpack_from
        end, run, last = len(records), 0, -1
        charge_at = CHECK_EVERY * INDEX_COLUMNS
        while at < end:
            (length,) = word(records, at)
            data = at + 8 + length
            if length > MOST_HEADER_BYTES:
                raise ValueError(f'header of {length} bytes')
            (size,) = word(records, data - 4)
            after = data + size
            if after > end:
                raise ValueError(f'the record at byte {at} of its chunk is longer than the chunk')
            run, last = (run + 1 if after - at == last else 0), after - at
            is_usual = length == MESSAGE_HEAD.size
            if is_usual:
                conn, key, op, time, seconds, rest = head(records, at + 4)
                is_usual = (conn, op, time) == USUAL and key in self._by_id
            if not is_usual:
                self._walk_unusual(number, records, (at, data, size), index)
            elif run > RUN:
                found = self._run(number, records, at, after - at)
                index.frombytes(found.tobytes())
                after = at + len(found) * (after - at)
            else:
                index.extend((seconds * 10**9 + rest, key, number, data, size, 0))
            if len(index) >= charge_at:
                self._charge(len(index) // INDEX_COLUMNS)
                charge_at = len(index) + CHECK_EVERY * INDEX_COLUMNS
            at = after

    def _run(self, number: int, records: bytes | bytearray, at: int, stride: int) -> Index:
        """Return the entries of usual messages of equal size, of the one at an offset and on."""
        heads = equal_heads(records, at, stride, HEAD_BYTES)
        alike = np.ones(len(heads), bool)
        for constant in CONSTANT:
            alike &= (heads[:, constant] == heads[:1, constant]).all(axis=1)
        keys, seconds, rest = (number_at(heads, offset, '<u4') for offset in (13, 34, 38))
        alike &= are_known(keys, self._by_id)
        place = (at + HEAD_BYTES, stride, stride - HEAD_BYTES)
        return entries(seconds * 10**9 + rest, keys, number, place, alike)

    def _walk_unusual(
        self,
        number: int,
        records: bytes | bytearray,
        place: tuple[int, int, int],
        index: array[int],
    ) -> None:
        """Append a message with an unusual header; keep or check a connection."""
        at, data, size = place
        fields = header_fields(bytes(records[at + 4 : data - 4]))
        kind = fields['op'][0]
        self._others += kind != MESSAGE
        if self._others == CHECK_EVERY:
            self._count_others(number)
        if kind == CONNECTION:
            self._note_connection(fields, bytes(records[data : data + size]))
        elif kind == MESSAGE:
            found = self._found(fields, data, size, number)
            index.extend((found.record_ns, found.connection, *found.place))

    def _found(self, fields: Fields, start: int, size: int, number: int) -> FoundMessage:
        """Return the entry of a message."""
        (connection,) = struct.unpack('<I', fields['conn'])
        if connection not in self._by_id:
            raise ValueError(f'message of the unknown connection {connection}')
        return FoundMessage(nanoseconds(fields['time']), connection, (number, start, size, 0))

    def _note_connection(self, fields: Fields, data: bytes, *, is_new: bool = True) -> None:
        """Keep the connection in a record; raise ValueError if an earlier one differs."""
        content = header_fields(data)
        (key,) = struct.unpack('<I', fields['conn'])
        connection = ros1_connection(
            key,
            re.sub('/+', '/', fields['topic'].decode()),
            None,
            type_=content['type'].decode(),
            md5sum=content['md5sum'].decode(),
            definition=content['message_definition'].decode(),
            latching=int(content.get('latching') or 0),
        )
        if is_new:
            self._describe(key, connection, len(data))


def nanoseconds(content: bytes) -> int:
    """Return a time of a header."""
    seconds, rest = struct.unpack('<II', content)
    return int(seconds * 10**9 + rest)


def header_fields(content: bytes) -> Fields:
    """Return the fields of a header."""
    fields: Fields = {}
    at = 0
    while at < len(content):
        (length,) = struct.unpack_from('<I', content, at)
        at += 4
        if at + length > len(content):
            raise ValueError('field longer than its header')
        name, _, value = content[at : at + length].partition(b'=')
        fields[name.decode()] = value
        at += length
    return fields
