# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Salvage of ROS 1 bags whose index was never written or is cut off.

After a line of text come records: a header of name=value fields with its length, and data with
its length. Messages lie in chunks, which are records of packed records. A recorder that was
killed leaves the length of the last chunk zero, so that the records of the chunk follow as if
they were records of the file; both are read alike.

Source: wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

from collections.abc import Iterator
import struct

from surfel_mapper.bags._rosbags import ros1_connection
from surfel_mapper.bags.salvage import Chunk, FoundMessage, SalvagedChunks

MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7

MOST_HEADER_BYTES = 1 << 20
"""A longer header is damaged; message definitions are in the data."""

Fields = dict[str, bytes]


class SalvagedRos1(SalvagedChunks):
    """The messages of a ROS 1 bag, found without its index."""

    MAGIC = b'#ROSBAG V2.0\n'

    def _scan(self) -> Iterator[FoundMessage]:
        """Yield the messages up to the end of the file, or to the first damaged record."""
        at, has_index = len(self.MAGIC), False
        while at < self.size:
            try:
                fields, start, size = self._record(-1, at)
                kind = fields['op'][0]
                is_whole = start + size <= self.size
                if kind == CHUNK:
                    yield from self._in_chunk(fields, start, min(size, self.size - start))
                elif is_whole:
                    yield from self._note(fields, -1, start, size)
            except (struct.error, ValueError, KeyError, IndexError):
                is_whole = False
            if not is_whole:
                self.cut_at = at
                return
            has_index = has_index or kind == CHUNK_INFO
            at = start + size
        if not has_index:
            self.cut_at = self.size

    def _in_chunk(self, fields: Fields, start: int, size: int) -> Iterator[FoundMessage]:
        """Yield the messages in a chunk of which ``size`` bytes are in the file."""
        (unpacked_size,) = struct.unpack('<I', fields['size'])
        place = Chunk(start, size, fields['compression'].decode(), unpacked_size)
        chunk = self._add_chunk(place)
        records, at = self._unpacked(chunk), 0
        while at < len(records):
            try:
                inner, inner_start, inner_size = self._record(chunk, at)
            except struct.error:
                return  # cut off in the header of this record
            if inner_start + inner_size > len(records):
                return
            yield from self._note(inner, chunk, inner_start, inner_size)
            at = inner_start + inner_size

    def _record(self, chunk: int, at: int) -> tuple[Fields, int, int]:
        """Return the header of a record, and offset and length of its data."""
        (length,) = struct.unpack('<I', self._read((chunk, at, 4)))
        if length > MOST_HEADER_BYTES:
            raise ValueError(f'header of {length} bytes')
        head = self._read((chunk, at + 4, length + 4))
        (size,) = struct.unpack('<I', head[length:])
        return header_fields(head[:length]), at + 8 + length, size

    def _note(self, fields: Fields, chunk: int, start: int, size: int) -> Iterator[FoundMessage]:
        """Yield the message in a record, or keep its connection."""
        kind = fields['op'][0]
        if kind == CONNECTION:
            content = header_fields(self._read((chunk, start, size)))
            self._note_connection(fields, content)
        elif kind == MESSAGE:
            (connection,) = struct.unpack('<I', fields['conn'])
            if connection not in self._by_id:
                raise ValueError(f'message of the unknown connection {connection}')
            seconds, nanoseconds = struct.unpack('<II', fields['time'])
            yield FoundMessage(seconds * 10**9 + nanoseconds, connection, (chunk, start, size, 0))

    def _note_connection(self, fields: Fields, content: Fields) -> None:
        """Keep the connection in a record."""
        (key,) = struct.unpack('<I', fields['conn'])
        connection = ros1_connection(
            key,
            fields['topic'].decode(),
            self,
            type_=content['type'].decode(),
            md5sum=content['md5sum'].decode(),
            definition=content['message_definition'].decode(),
            latching=int(content.get('latching') or 0),
        )
        self._by_id.setdefault(key, connection)


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
