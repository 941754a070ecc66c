# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Salvage of truncated sqlite3 bags page by page.

SQLite refuses a file that is shorter than its header states, and its trees lead through pages
that may be lost while the leaves below them are intact. So the leaf pages of tables are read in
the order of the file: rows of four columns (null, integer, integer, blob) are messages, rows of
texts are topics. A message larger than a page continues in a chain of overflow pages, and is whole
only if all of them are in the file.

Source: sqlite.org/fileformat2.html.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
import struct
from typing import NamedTuple, TYPE_CHECKING

import numpy as np

from surfel_mapper.bags._rosbags import ros2_connection
from surfel_mapper.bags.bag_file import (
    BagFile,
    FoundMessage,
    Index,
    INDEX_COLUMNS,
    MESSAGE_BYTES,
)
from surfel_mapper.budget import open_regular

if TYPE_CHECKING:
    from surfel_mapper.bags._rosbags import Connection

HEADER_BYTES = 100
"""Size of the file header, at the start of the first page."""

TABLE_LEAF = 13
"""First byte of a leaf page of a table."""

NULL, BLOB = 0, 12

INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}
"""Bytes of an integer column by its serial type; 8 and 9 are the values 0 and 1."""


class Row(NamedTuple):
    """A row: the serial types of its columns, and the place of its bytes."""

    types: list[int]
    data_at: int
    payload: int
    size: int
    local: int


class SalvagedSqlite(BagFile):
    """The messages of a sqlite3 bag, found without its trees."""

    MAGIC = b'SQLite format 3\0'

    def _survey(self) -> None:
        """Index the messages in all pages whose topic was found, on whichever page it was."""
        numbers = array('q')
        for count, found in enumerate(self._scan(), 1):
            self._budget.take(MESSAGE_BYTES, f'index of {count} messages')
            numbers.extend((found.record_ns, found.connection, *found.place))
        index: Index = np.array(numbers, np.int64).reshape(-1, INDEX_COLUMNS)
        index = index[np.isin(index[:, 1], list(self._by_id))]
        self._index = index[np.argsort(index[:, 0], kind='stable')]
        self._counts = Counter(self._index[:, 1].tolist())
        if len(self._index):
            self._note_span(int(self._index[0, 0]), int(self._index[-1, 0]))

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, record time and bytes of messages, in order of record time."""
        wanted = {connection.id: connection for connection in connections}
        first = 0 if start is None else int(np.searchsorted(self._index[:, 0], start))
        for row in range(first, len(self._index)):
            record_ns, connection, *place = self._index[row].tolist()
            if stop is not None and record_ns >= stop:
                return
            if connection in wanted:
                yield wanted[connection], record_ns, self._read(tuple(place))

    def _scan(self) -> Iterator[FoundMessage]:
        """Yield the messages in all pages of the file."""
        header = self._at(0, HEADER_BYTES)
        self._page_size, num_pages = pages(header)
        self._usable = self._page_size - header[20]
        self._num_pages = self.size // self._page_size
        if num_pages > self._num_pages or self.size % self._page_size:
            self.cut_at = self._num_pages * self._page_size
        for page in range(self._num_pages):
            self._budget.check_time()
            yield from self._in_page(page)

    def _in_page(self, page: int) -> Iterator[FoundMessage]:
        """Yield the messages in a page, if it is a leaf; keep its topics."""
        content = self._at(page * self._page_size, self._page_size)
        start = HEADER_BYTES if page == 0 else 0
        if content[start] != TABLE_LEAF:
            return
        (cells,) = struct.unpack_from('>H', content, start + 3)
        if start + 8 + 2 * cells > self._page_size:
            return
        for at in struct.unpack_from(f'>{cells}H', content, start + 8):
            try:
                yield from self._row(content, page, at)
            except (struct.error, ValueError, IndexError):
                self.cut_at = min(self.cut_at or self.size, page * self._page_size + at)

    def _row(self, content: bytes, page: int, at: int) -> Iterator[FoundMessage]:
        """Yield the message in a cell, or keep the topic in it."""
        row, rowid = self._parsed(content, at)
        if is_message(row.types):
            topic_size = INTEGERS[row.types[1]]
            topic = integer(row.types[1], content, row.data_at)
            record_ns = integer(row.types[2], content, row.data_at + topic_size)
            skipped = row.data_at + topic_size + INTEGERS[row.types[2]] - row.payload
            place = (page * self._page_size + row.payload, row.local, row.size, skipped)
            self._check_chain(place)
            yield FoundMessage(record_ns, topic, place)
        elif is_topic(row.types) and row.local == row.size:
            self._note_topic(rowid, row, content)

    def _parsed(self, content: bytes, at: int) -> tuple[Row, int]:
        """Return the row in a cell and its number."""
        size, at = varint(content, at)
        rowid, at = varint(content, at)
        local = self._local_bytes(size)
        header_size, types_at = varint(content, at)
        if at + local > len(content) or header_size > local:
            raise ValueError('row longer than its page')
        if size > self.size:
            raise ValueError('row longer than the file')
        types = []
        while types_at < at + header_size:
            kind, types_at = varint(content, types_at)
            types.append(kind)
        return Row(types, at + header_size, at, size, local), rowid

    def _local_bytes(self, size: int) -> int:
        """Return the bytes of a row that lie in its page; the rest is in overflow pages."""
        if size <= self._usable - 35:
            return size
        least = (self._usable - 12) * 32 // 255 - 23
        local = least + (size - least) % (self._usable - 4)
        return local if local <= self._usable - 35 else least

    def _note_topic(self, rowid: int, row: Row, content: bytes) -> None:
        """Keep the topic in a row; rows of other tables have no topic name and are skipped."""
        at, texts = row.data_at, []
        for kind in row.types[1:]:
            length = (kind - 13) // 2
            texts.append(content[at : at + length].decode())
            at += length
        topic, type_, encoding, *further = texts
        if topic.startswith('/') and '/' in type_:
            qos = ' '.join(further[:1])
            connection = ros2_connection(rowid, topic, type_, None, encoding=encoding, qos=qos)
            self._keep_connection(rowid, connection, len(content))

    def _check_chain(self, place: tuple[int, ...]) -> None:
        """Raise ValueError if an overflow page of a message is not in the file."""
        for _ in self._chain(place):
            pass

    def _chain(self, place: tuple[int, ...]) -> Iterator[int]:
        """Yield the offsets of the overflow pages of a row."""
        start, local, size, _ = place
        link = start + local
        for _ in range(-(-(size - local) // (self._usable - 4))):
            (page,) = struct.unpack('>I', self._at(link, 4))
            if not 0 < page <= self._num_pages:
                raise ValueError(f'page {page} of {self._num_pages}')
            link = (page - 1) * self._page_size
            yield link

    def _read(self, place: tuple[int, ...]) -> bytes:
        """Return the blob of a message."""
        start, local, size, skipped = place
        parts = [self._at(start, local)]
        parts += [self._at(page + 4, self._usable - 4) for page in self._chain(place)]
        return b''.join(parts)[skipped:size]


def pages(header: bytes) -> tuple[int, int]:
    """Return the size and the number of pages that the file header states."""
    stated, num_pages = struct.unpack_from('>H10xI', header, 16)
    size = 65536 if stated == 1 else stated
    if size < 512 or size & (size - 1):
        raise ValueError(f'pages of {size} bytes')
    return size, num_pages


def is_short(path: Path) -> bool:
    """Return whether a database is shorter than its header states; SQLite opens some of these."""
    with open_regular(path) as file:
        size, num_pages = pages(file.read(HEADER_BYTES))
    return path.stat().st_size < size * num_pages


def is_message(types: list[int]) -> bool:
    """Return whether the columns are number, topic, time and content of a message."""
    if len(types) != 4 or types[0] != NULL:
        return False
    is_blob = types[3] >= BLOB and types[3] % 2 == 0
    return types[1] in INTEGERS and types[2] in INTEGERS and is_blob


def is_topic(types: list[int]) -> bool:
    """Return whether the columns are number, name, type, encoding, and perhaps more texts."""
    return len(types) >= 4 and types[0] == NULL and all(t > BLOB and t % 2 for t in types[1:])


def integer(kind: int, content: bytes, at: int) -> int:
    """Return an integer column of a type."""
    if kind in (8, 9):
        return kind - 8
    return int.from_bytes(content[at : at + INTEGERS[kind]], 'big', signed=True)


def varint(content: bytes, at: int) -> tuple[int, int]:
    """Return a number of variable length, and the offset behind it."""
    value = 0
    for place in range(8):
        byte = content[at + place]
        value = value << 7 | byte & 127
        if byte < 128:
            return value, at + place + 1
    return value << 8 | content[at + 8], at + 9
