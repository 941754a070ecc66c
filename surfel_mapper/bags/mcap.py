# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Salvage of mcap files without a complete index.

A file is a magic, records, and the magic again; a record is an opcode, the length of its content
(uint64) and the content. Messages lie among the records or in chunks, which are records of
packed records. Of a truncated chunk the messages before the cut are read too.

Source: the specification of the format, mcap.dev/spec.
"""

from __future__ import annotations

from collections.abc import Iterator
import struct
from zlib import crc32

from surfel_mapper.bags._rosbags import ros2_connection
from surfel_mapper.bags.salvage import Chunk, FoundMessage, SalvagedChunks

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 2, 3, 4, 5, 6, 15

RECORD = struct.Struct('<BQ')
MESSAGE_HEAD = struct.Struct('<HIQQ')
CHUNK_HEAD = struct.Struct('<QQQI')


class SalvagedMcap(SalvagedChunks):
    """The messages of an mcap file, found without its index."""

    MAGIC = b'\x89MCAP0\r\n'

    def _scan(self) -> Iterator[FoundMessage]:
        """Yield the messages up to the end of the data, or to the first damaged record."""
        self._schemas: dict[int, tuple[str, str, str]] = {}
        at = len(self.MAGIC)
        while True:
            head = self._at(at, RECORD.size)
            kind, size = RECORD.unpack(head.ljust(RECORD.size, b'\0'))
            start, end = at + RECORD.size, at + RECORD.size + size
            is_whole = kind > 0 and end <= self.size
            if is_whole and kind in (DATA_END, FOOTER):
                self.cut_at = None if self._ends() else self.size
                return
            try:
                if kind == CHUNK:
                    yield from self._in_chunk(start, min(end, self.size) - start, is_whole)
                elif is_whole:
                    yield from self._note(kind, -1, start, size)
            except (struct.error, ValueError, KeyError):
                is_whole = False
            if not is_whole:
                self.cut_at = at
                return
            at = end

    def _ends(self) -> bool:
        """Return whether the file ends with the magic."""
        return self._at(self.size - len(self.MAGIC), len(self.MAGIC)) == self.MAGIC

    def _in_chunk(self, start: int, size: int, is_whole: bool) -> Iterator[FoundMessage]:
        """Yield the messages in a chunk of which ``size`` bytes are in the file."""
        head = self._at(start, min(size, 64))
        _, _, unpacked_size, checksum = CHUNK_HEAD.unpack_from(head)
        compression, after = text(head, CHUNK_HEAD.size)
        (packed_size,) = struct.unpack_from('<Q', head, after)
        if is_whole and after + 8 + packed_size > size:
            raise ValueError('chunk longer than its record')
        left = min(packed_size, size - after - 8)
        chunk = self._add_chunk(Chunk(start + after + 8, left, compression, unpacked_size))
        records = self._unpacked(chunk)
        if is_whole and (
            len(records) != unpacked_size or (checksum and crc32(records) != checksum)
        ):
            self.skipped_at.append(start)
            return
        at = 0
        while at + RECORD.size <= len(records):
            kind, length = RECORD.unpack_from(records, at)
            at += RECORD.size
            if at + length > len(records):
                return  # cut off in this record
            yield from self._note(kind, chunk, at, length)
            at += length

    def _note(self, kind: int, chunk: int, start: int, size: int) -> Iterator[FoundMessage]:
        """Yield the message in a record, or keep its schema or channel."""
        if kind not in (SCHEMA, CHANNEL, MESSAGE):
            return
        wanted = min(size, MESSAGE_HEAD.size) if kind == MESSAGE else size
        content = self._read((chunk, start, wanted))
        if kind == SCHEMA:
            (key,) = struct.unpack_from('<H', content)
            name, at = text(content, 2)
            encoding, at = text(content, at)
            self._schemas[key] = (name, encoding, text(content, at)[0])
        elif kind == CHANNEL:
            self._note_channel(content)
        else:
            channel, _, record_ns, _ = MESSAGE_HEAD.unpack(content)
            if record_ns >= 2**63:
                raise ValueError(f'record time of {record_ns} ns')
            if channel not in self._by_id:
                raise ValueError(f'message of the unknown channel {channel}')
            place = (chunk, start + MESSAGE_HEAD.size, size - MESSAGE_HEAD.size, 0)
            yield FoundMessage(record_ns, channel, place)

    def _note_channel(self, content: bytes) -> None:
        """Keep the channel in a record."""
        key, schema = struct.unpack_from('<HH', content)
        topic, at = text(content, 4)
        encoding, at = text(content, at)
        name, kind, definition = self._schemas.get(schema, ('', '', ''))
        qos = content[at:].decode(errors='replace')
        connection = ros2_connection(
            key, topic, name, self, encoding=encoding, qos=qos, definition=(kind, definition)
        )
        self._by_id.setdefault(key, connection)


def text(content: bytes, at: int) -> tuple[str, int]:
    """Return the string at an offset, and the offset behind it."""
    (size,) = struct.unpack_from('<I', content, at)
    end = at + 4 + size
    if end > len(content):
        raise ValueError('string longer than its record')
    return content[at + 4 : end].decode(), end
