# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reading of mcap files, with and without a complete index.

A file is a magic, records, and the magic again; a record is an opcode, the length of its content
(uint64) and the content. Messages lie among the records or in chunks, which are records of
packed records. The summary before the last magic repeats schemas and channels and has an entry for
each chunk. It is used if it accounts for all messages that its statistics state; else the records
are read from the beginning. Of a truncated chunk the messages before the cut are read too.

Source: the specification of the format, mcap.dev/spec.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Iterator
import struct
from zlib import crc32

from surfel_mapper.bags._rosbags import ros2_connection
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

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX = 2, 3, 4, 5, 6, 8
STATISTICS, DATA_END = 11, 15

RECORD = struct.Struct('<BQ')
MESSAGE_HEAD = struct.Struct('<HIQQ')
WHOLE_HEAD = struct.Struct('<BQHIQQ')
"""Head of a record, and of the message in it."""

CHUNK_HEAD = struct.Struct('<QQQI')
CHUNK_INDEX_HEAD = struct.Struct('<QQQQ')
FOOTER_CONTENT = struct.Struct('<QQI')

MAX_NS = 2**63
"""End of record times."""

INDEX_RECORD_BYTES = 15
"""Bytes of a message index record without its entries, of 16 bytes each."""


class McapFile(ChunkedFile):
    """The messages of an mcap file."""

    MAGIC = b'\x89MCAP0\r\n'

    def _survey(self) -> None:
        """Find the chunks through the summary, or else record by record."""
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._last: dict[tuple[int, int], bytes] = {}
        try:
            if self._read_summary():
                return
        except DAMAGE:
            pass
        self._schemas.clear()
        self._last.clear()
        self._begin_again()
        self._read_records()

    def _read_summary(self) -> bool:
        """Return whether the summary accounts for all messages; keep its chunks."""
        footer_at = self.size - len(self.MAGIC) - RECORD.size - FOOTER_CONTENT.size
        footer = self._at(max(footer_at, 0), self.size)
        kind, size = RECORD.unpack_from(footer)
        start, _, checksum = FOOTER_CONTENT.unpack_from(footer, RECORD.size)
        is_footer = (kind, size) == (FOOTER, FOOTER_CONTENT.size)
        if not is_footer or not self._ends() or not len(self.MAGIC) < start < footer_at:
            return False
        summary = self._at(start, footer_at - start)
        if checksum and crc32(footer[: RECORD.size + 16], crc32(summary)) != checksum:
            return False
        stated = None
        for kind, at, length in records_in(summary):
            content = summary[at : at + length]
            if kind == CHUNK_INDEX:
                self._note_chunk_index(content, start)
            elif kind == STATISTICS:
                stated = channel_counts(content)
            else:
                self._note(kind, content)
        self._check_chunks()
        if stated is None or stated != +self._counts:
            return False
        self._check_connections()
        return not self.skipped_at

    def _note_chunk_index(self, content: bytes, summary_at: int) -> None:
        """Keep the chunk that an index record describes."""
        start_ns, end_ns, start, size = CHUNK_INDEX_HEAD.unpack_from(content)
        (length,) = struct.unpack_from('<I', content, CHUNK_INDEX_HEAD.size)
        at = CHUNK_INDEX_HEAD.size + 4
        offsets = sorted(
            (offset, key) for key, offset in struct.iter_unpack('<HQ', content[at : at + length])
        )
        (index_size,) = struct.unpack_from('<Q', content, at + length)
        ends = [offset for offset, _ in offsets[1:]] + [start + size + index_size]
        counts = {
            key: (end - offset - INDEX_RECORD_BYTES) // 16
            for (offset, key), end in zip(offsets, ends, strict=True)
        }
        if not 0 < start <= start + size <= summary_at or any(n < 0 for n in counts.values()):
            raise ValueError('index of a chunk beyond the data')
        if start_ns > end_ns or end_ns >= 2**63:
            raise ValueError('index of a chunk of no span')
        chunk = Chunk(start, size, True, start_ns, end_ns, {k: n for k, n in counts.items() if n})
        self._add_chunk(chunk)
        if chunk.counts:
            self._note_chunk(chunk)

    def _check_chunks(self) -> None:
        """Raise ValueError if two chunks of the index share bytes of the file."""
        end = 0
        for chunk in sorted(self._chunks, key=lambda chunk: chunk.start):
            if chunk.start < end:
                raise ValueError('two chunks of the index overlap')
            end = chunk.start + chunk.size

    def _read_records(self) -> None:
        """Read the records up to the end of the data, or to the first damaged one."""
        at = len(self.MAGIC)
        while True:
            self._budget.check_time()
            head = self._at(at, RECORD.size)
            kind, size = RECORD.unpack(head.ljust(RECORD.size, b'\0'))
            end = at + RECORD.size + size
            is_whole = kind > 0 and end <= self.size
            if kind not in (MESSAGE, CHUNK):
                self._others += 1
                self._count_others(LOOSE)
            if is_whole and kind in (DATA_END, FOOTER):
                self.cut_at = None if self._ends() else self.size
                return
            if kind == CHUNK:
                self._survey_chunk(Chunk(at, min(end, self.size) - at, is_whole))
            elif is_whole:
                try:
                    self._note_record(kind, at + RECORD.size, size)
                except DAMAGE:
                    is_whole = False
            if not is_whole:
                self.cut_at = at
                return
            at = end

    def _ends(self) -> bool:
        """Return whether the file ends with the magic."""
        return self._at(self.size - len(self.MAGIC), len(self.MAGIC)) == self.MAGIC

    def _note_record(self, kind: int, start: int, size: int) -> None:
        """Keep the message, schema or channel in a record outside of chunks."""
        if kind == MESSAGE:
            channel, _, record_ns, _ = MESSAGE_HEAD.unpack(self._at(start, MESSAGE_HEAD.size))
            if channel not in self._by_id or size < MESSAGE_HEAD.size or record_ns >= MAX_NS:
                raise ValueError(f'message of channel {channel} at {record_ns} ns')
            place = (LOOSE, start + MESSAGE_HEAD.size, size - MESSAGE_HEAD.size, 0)
            self._note_loose(FoundMessage(record_ns, channel, place))
        elif kind in (SCHEMA, CHANNEL):
            self._note(kind, self._at(start, size))

    def _head(self, chunk: Chunk) -> Packed:
        """Return the head of a chunk."""
        head = self._at(chunk.start, min(chunk.size, 128))
        kind, size = RECORD.unpack_from(head)
        if kind != CHUNK or (chunk.is_whole and size != chunk.size - RECORD.size):
            raise ValueError('no chunk where the index has one')
        at = RECORD.size
        _, _, unpacked_size, checksum = CHUNK_HEAD.unpack_from(head, at)
        compression, at = text(head, at + CHUNK_HEAD.size)
        (packed_size,) = struct.unpack_from('<Q', head, at)
        start = at + 8
        if chunk.is_whole and start + packed_size != chunk.size:
            raise ValueError('chunk of another size than its record')
        left = min(packed_size, chunk.size - start)
        return Packed(chunk.start + start, left, compression, unpacked_size, checksum)

    def _walk(self, number: int, records: bytes | bytearray, index: array[int]) -> None:
        """Append the messages in the records of a chunk; keep or check schemas and channels."""
        known, head, end = self._by_id, WHOLE_HEAD.unpack_from, len(records)
        last_head, before, size = end - WHOLE_HEAD.size, RECORD.size, MESSAGE_HEAD.size
        at, run, last = 0, 0, -1
        charge_at = CHECK_EVERY * INDEX_COLUMNS
        while at < end:
            if at <= last_head:
                kind, length, channel, _, record_ns, _ = head(records, at)
            else:  # no message fits
                kind, length = RECORD.unpack_from(records, at)
                channel = -1
            start = at + before
            after = start + length
            if after > end:
                raise ValueError(f'the record at byte {at} of its chunk is longer than the chunk')
            if kind != MESSAGE:
                if kind in (SCHEMA, CHANNEL):
                    self._note(kind, bytes(records[start:after]))
                at, run = after, 0
                self._others += 1
                if self._others == CHECK_EVERY:
                    self._count_others(number)
                continue
            run, last = (run + 1 if length == last else 0), length
            if run > RUN and len(found := self._run(number, records, at, length)):
                index.frombytes(found.tobytes())
                after = at + len(found) * (before + length)
            elif channel not in known or length < size or record_ns >= MAX_NS:
                raise ValueError(f'message of channel {channel} at {record_ns} ns')
            else:
                index.extend((record_ns, channel, number, start + size, length - size, 0))
            if len(index) >= charge_at:
                self._charge(len(index) // INDEX_COLUMNS)
                charge_at = len(index) + CHECK_EVERY * INDEX_COLUMNS
            at = after

    def _run(self, number: int, records: bytes | bytearray, at: int, length: int) -> Index:
        """Return the entries of the messages of equal size from an offset on, up to another."""
        stride, head = RECORD.size + length, WHOLE_HEAD.size
        heads = equal_heads(records, at, stride, head)
        channel, record_ns = number_at(heads, 9, '<u2'), number_at(heads, 15, '<u8')
        alike = (heads[:, : RECORD.size] == heads[:1, : RECORD.size]).all(axis=1)
        alike &= are_known(channel, self._by_id) & (record_ns >= 0)
        return entries(record_ns, channel, number, (at + head, stride, stride - head), alike)

    def _note(self, kind: int, content: bytes) -> None:
        """Keep a schema or channel; raise ValueError if it differs from an earlier one."""
        if kind not in (SCHEMA, CHANNEL):
            return
        (key,) = struct.unpack_from('<H', content)
        if self._last.get((kind, key)) == content:  # repeated, as in each chunk
            return
        if kind == SCHEMA:
            name, at = text(content, 2)
            encoding, at = text(content, at)
            schema = (name, encoding, text(content, at)[0])
            if self._schemas.setdefault(key, schema) != schema:
                raise ValueError(f'schema {key} is described in two ways')
        elif not self._note_channel(content):
            return
        if (kind, key) not in self._last:
            self._budget.take(2 * len(content), f'{len(self._last) + 1} descriptions')
            self._described_bytes += 2 * len(content)
        self._last[kind, key] = content

    def _note_channel(self, content: bytes) -> bool:
        """Keep the channel in a record; return whether its schema is known."""
        key, schema = struct.unpack_from('<HH', content)
        topic, at = text(content, 4)
        encoding, at = text(content, at)
        name, kind, definition = self._schemas.get(schema, ('', '', ''))
        metadata = content[at:].decode(errors='replace')
        connection = ros2_connection(
            key,
            topic,
            name,
            None,
            encoding=encoding,
            qos=metadata,
            definition=(kind, definition),
            digest=metadata,
        )
        self._describe(key, connection, len(content))
        return schema in self._schemas


def records_in(content: bytes | bytearray) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, offset and length of the content of each record; raise if one is cut."""
    at = 0
    while at < len(content):
        kind, length = RECORD.unpack_from(content, at)
        end = at + RECORD.size + length
        if end > len(content):
            raise ValueError(f'the record at byte {at} of its chunk is longer than the chunk')
        yield kind, at + RECORD.size, length
        at = end


def channel_counts(statistics: bytes) -> Counter[int]:
    """Return the number of messages of each channel by a statistics record, without zeros."""
    (length,) = struct.unpack_from('<I', statistics, 42)
    return +Counter(dict(struct.iter_unpack('<HQ', statistics[46 : 46 + length])))


def text(content: bytes, at: int) -> tuple[str, int]:
    """Return the string at an offset, and the offset behind it."""
    (size,) = struct.unpack_from('<I', content, at)
    end = at + 4 + size
    if end > len(content):
        raise ValueError('string longer than its record')
    return content[at + 4 : end].decode(), end
