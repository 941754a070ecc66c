# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Bags of packed chunks, mcap and ROS 1: messages by record time, chunk by chunk.

The chunks are found through the index at the end of the file, if it is complete and agrees with
itself, else by reading the records from the beginning. Of each chunk only its span and counts are
kept. A chunk is unpacked and searched for messages when its span begins, so there is never a list
of all messages, and one chunk at a time is unpacked if chunks are large.

A few kilobytes of packed chunks can hold millions of empty messages, state gigabytes, or overlap
in time so that each message needs another chunk unpacked. So memory, messages and processor time
are charged to the budget of the file, and the sum of its unpacked chunks is limited. Runs of
records of equal size are read in blocks, and the places of a small number of messages are kept
from the survey, so that 100,000 messages take a tenth of a second.

One module: all parts share the budget, and drop what they keep when another needs memory.
"""

from __future__ import annotations

from abc import abstractmethod
from array import array
from collections import Counter, deque, OrderedDict
from collections.abc import Collection, Iterator, Mapping
import heapq
from pathlib import Path
import struct
from types import MappingProxyType
from typing import NamedTuple, TYPE_CHECKING
from zlib import crc32

import numpy as np

from surfel_mapper.bags._rosbags import is_same
from surfel_mapper.bags.bag_file import (
    BagFile,
    FoundMessage,
    Index,
    INDEX_COLUMNS,
    MESSAGE_BYTES,
)
from surfel_mapper.bags.compression import (
    max_unpacked_bytes,
    max_unpacked_sum,
    unpacked,
)
from surfel_mapper.budget import stated_limit, VARIABLE
from surfel_mapper.errors import BagError

if TYPE_CHECKING:
    from surfel_mapper.bags._rosbags import Connection

KEPT_CHUNKS = 4
"""Number of chunks kept unpacked: neighbouring chunks overlap in time."""

KEPT_BYTES = 32 << 20
"""
Limit of their size together. A larger chunk is kept alone if it is compressed; else its messages
are read one by one.
"""

MAX_COPIED_BYTES = 1 << 24
"""Size above which a message is a view into its chunk, not a copy."""

MOST_OF_CHUNK = 0.5
"""Share of its chunk above which it is a view too, which keeps at most twice its size."""

MAX_MESSAGES, LEAST_BYTES = 100_000, 16
"""Limit of the messages of a small file, and bytes of a file for each further one; the entries in
the index of a chunk have 16, and finding a message takes 1.5 us."""

MAX_OTHERS, LEAST_OTHER_BYTES = 10_000, 32
"""Limit of the records of a small file that are no messages, such as the descriptions of topics
that each chunk repeats, and bytes of a file for each further one; each takes 1 to 10 us."""

MAX_CHUNKS, LEAST_CHUNK_BYTES = 4000, 512
"""Limit of the chunks of a small file, and bytes of a file for each further one. A chunk takes 40
us; recorders write them of 768 KiB."""

LOOSE = -1
"""Number of the chunk of messages that are outside of chunks."""

DAMAGE = (struct.error, ValueError, LookupError)


class Packed(NamedTuple):
    """Packed records of a chunk: place, compression, unpacked size and checksum (0: none)."""

    start: int
    size: int
    compression: str
    unpacked_size: int
    checksum: int = 0


class Chunk(NamedTuple):
    """
    A chunk of a file.

    Attributes
    ----------
    start, size : int
        Offset of its record, and bytes of it that are in the file.
    is_whole : bool
        Whether the file does not end in it.
    start_ns, end_ns : int
        Record times of its first and its last message.
    counts : dict of int to int
        Number of its messages by connection; 0 if not known.

    """

    start: int
    size: int
    is_whole: bool = True
    start_ns: int = 2**63 - 1
    end_ns: int = -1
    counts: Mapping[int, int] = MappingProxyType({})


class ChunkedFile(BagFile):
    """
    A file whose messages lie in chunks, or outside of them.

    Attributes
    ----------
    skip_reason : str
        Why the first of the damaged chunks cannot be read.

    """

    def __init__(self, path: Path) -> None:
        self.skip_reason = ''
        self._chunks: list[Chunk] = []
        self._loose = array('q')
        self._kept: OrderedDict[int, bytes | bytearray] = OrderedDict()
        self._indexes: dict[int, Index] = {}
        self._num_places = self._num_charged = self._others = self._num_others = 0
        self._stated_limit = stated_limit()
        self._searched: set[int] = set()
        self._ever_unpacked: set[int] = set()
        self._sum_unpacked = 0
        super().__init__(path)

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple[Connection, int, bytes | memoryview]]:
        """Yield connection, record time and bytes of messages, in order of record time."""
        wanted = {connection.id: connection for connection in connections}
        span = (-(2**63) if start is None else start, 2**63 - 1 if stop is None else stop)
        pending = deque(self._numbers(wanted, *span))
        indexes: dict[int, Index] = {}
        heads: list[tuple[int, int, int]] = []  # record time, number of the chunk, row
        try:
            while pending or heads:
                while pending and (not heads or pending[0][0] <= heads[0][0]):
                    number = pending.popleft()[1]
                    indexes[number] = index = self._index_of(number, wanted, *span)
                    if len(index):
                        heapq.heappush(heads, (int(index[0, 0]), number, 0))
                if not heads:
                    continue
                record_ns, number, row = heads[0]
                _, connection, _, at, size, _ = indexes[number][row].tolist()
                raw = self._message(number, at, size)
                if row + 1 < len(indexes[number]):
                    next_ns = int(indexes[number][row + 1, 0])
                    heapq.heapreplace(heads, (next_ns, number, row + 1))
                else:
                    heapq.heappop(heads)
                    self._budget.give_back(MESSAGE_BYTES * len(indexes.pop(number)))
                yield wanted[connection], record_ns, raw
        finally:  # of the chunks that are open if the caller leaves early
            self._budget.give_back(MESSAGE_BYTES * sum(map(len, indexes.values())))

    @abstractmethod
    def _head(self, chunk: Chunk) -> Packed:
        """Return the head of a chunk; raise one of DAMAGE if it is inconsistent."""

    @abstractmethod
    def _walk(self, number: int, records: bytes | bytearray, index: array[int]) -> None:
        """
        Append the messages in unpacked records to an index; keep or check connections.

        ``_charge`` is called for each CHECK_EVERY messages, and ``_count_others`` for as many
        other records, which are counted in ``_others``. Raises one of DAMAGE at a cut.
        """

    def _begin_again(self) -> None:
        """Forget what a rejected index stated: without it, chunks have other numbers."""
        self._forget_places()
        self._budget.give_back(sum(map(len, self._kept.values())))
        for found in (self._by_id, self._counts, self._chunks, self._kept, self.skipped_at):
            found.clear()
        self._searched.clear()
        self._ever_unpacked.clear()
        self._sum_unpacked = self._num_others = 0
        self._budget.give_back(self._described_bytes)
        self._described_bytes = 0
        self.start_time, self.end_time, self.skip_reason = 2**63 - 1, 0, ''

    def _survey_chunk(self, chunk: Chunk) -> None:
        """Search a chunk that no index describes; keep its span and counts."""
        number = len(self._chunks)
        self._budget.take(MESSAGE_BYTES, f'{number + 1} chunks')
        self._add_chunk(chunk)
        index = self._search(number)
        if len(index):
            found = Counter(index[:, 1].tolist())
            first_ns, last_ns = int(index[:, 0].min()), int(index[:, 0].max())
            self._chunks[number] = chunk._replace(start_ns=first_ns, end_ns=last_ns, counts=found)
            self._note_chunk(self._chunks[number])
            self._check_number(self._counts.total())
        if self._num_places + len(index) <= MAX_MESSAGES:
            self._indexes[number] = index
            self._num_places += len(index)
        else:
            self._budget.give_back(MESSAGE_BYTES * len(index))

    def _add_chunk(self, chunk: Chunk) -> None:
        """Add a chunk to those of the file; refuse too many."""
        self._chunks.append(chunk)
        self._check_number(len(self._chunks), 'chunks', MAX_CHUNKS, LEAST_CHUNK_BYTES)

    def _describe(self, key: int, connection: Connection, size: int) -> None:
        """Keep a connection; raise ValueError if an earlier description of it differs."""
        known = self._by_id.get(key)
        if known is None:
            self._keep_connection(key, connection, size)
        elif not is_same(known, connection):
            raise ValueError(f'connection {key} is described in two ways')

    def _note_chunk(self, chunk: Chunk) -> None:
        """Add the messages of a chunk to those of the file."""
        self._counts.update(chunk.counts)
        self._note_span(chunk.start_ns, chunk.end_ns)

    def _note_loose(self, found: FoundMessage) -> None:
        """Keep the place of a message that is outside of chunks."""
        self._budget.take(MESSAGE_BYTES, f'index of {len(self._loose) // INDEX_COLUMNS} messages')
        self._loose.extend((found.record_ns, found.connection, *found.place))
        self._counts[found.connection] += 1
        self._note_span(found.record_ns, found.record_ns)

    def _check_connections(self) -> None:
        """
        Raise ValueError if the chunks describe connections otherwise than the index does.

        The first chunk with a message of a connection describes it, so few chunks are unpacked.
        """
        self._check_number(self._counts.total())
        left = {key for key, count in self._counts.items() if count}
        if not left <= self._by_id.keys():
            raise ValueError('the index has messages of unknown connections')
        for number, chunk in enumerate(self._chunks):
            if left & chunk.counts.keys():
                self._budget.give_back(MESSAGE_BYTES * len(self._search(number)))
                left -= chunk.counts.keys()

    def _numbers(self, wanted: Collection[int], start: int, stop: int) -> list[tuple[int, int]]:
        """Return start and number of the chunks with wanted messages in a span, by start."""
        found = [
            (chunk.start_ns, number)
            for number, chunk in enumerate(self._chunks)
            if chunk.end_ns >= start
            and chunk.start_ns < stop
            and any(connection in wanted for connection in chunk.counts)
        ]
        return sorted([(-(2**63), LOOSE), *found] if self._loose else found)

    def _index_of(self, number: int, wanted: Collection[int], start: int, stop: int) -> Index:
        """Return the wanted messages of a chunk in a span, by record time."""
        with self._budget.clock():
            if number == LOOSE:
                index = as_index(self._loose)
                self._budget.take(MESSAGE_BYTES * len(index), f'{len(index)} messages')
            elif number in self._indexes:
                index = self._indexes[number]
                self._make_room(MESSAGE_BYTES * len(index))
                self._budget.take(MESSAGE_BYTES * len(index), f'{len(index)} messages')
            else:
                index = self._search(number)
            if number == LOOSE or not self._is_within(self._chunks[number], wanted, start, stop):
                times, found = index[:, 0], len(index)
                among = np.isin(index[:, 1], list(wanted))
                index = index[(times >= start) & (times < stop) & among]
                self._budget.give_back(MESSAGE_BYTES * (found - len(index)))
            return index[np.argsort(index[:, 0], kind='stable')]

    @staticmethod
    def _is_within(chunk: Chunk, wanted: Collection[int], start: int, stop: int) -> bool:
        """Return whether all messages of a chunk are wanted and in a span."""
        is_inside = start <= chunk.start_ns and chunk.end_ns < stop
        return is_inside and all(connection in wanted for connection in chunk.counts)

    def _count_others(self, number: int) -> None:
        """Count the records beside messages since the last call, of each chunk once."""
        count, self._others = self._others, 0
        if number not in self._searched:
            self._num_others += count
            self._check_number(
                self._num_others, 'records beside messages', MAX_OTHERS, LEAST_OTHER_BYTES
            )

    def _search(self, number: int) -> Index:
        """Return the messages of a chunk in its order, up to the damage if it has some."""
        numbers, chunk = array('q'), self._chunks[number]
        try:
            records = self._unpacked(number)
            self._walk(number, records, numbers)
        except DAMAGE as error:
            if chunk.is_whole:
                reason = f'no field {error}' if isinstance(error, KeyError) else str(error)
                self._note_damage(chunk.start, reason, len(numbers) // INDEX_COLUMNS)
        self._count_others(number)
        self._searched.add(number)
        index = as_index(numbers)
        self._charge(len(index))
        self._num_charged = 0
        return index

    def _charge(self, count: int) -> None:
        """Ask the budget for the messages of an index since the last call, and for the time."""
        self._budget.check_time()
        size = MESSAGE_BYTES * (count - self._num_charged)
        self._make_room(size)
        self._budget.take(size, f'index of {count} messages')
        self._num_charged = count
        self._check_number(count)

    def _check_number(
        self, count: int, of: str = 'messages', most: int = MAX_MESSAGES, each: int = LEAST_BYTES
    ) -> None:
        """Raise BagError if there are more of something than a file of this size may have."""
        most = max(most, self._stated_limit // MESSAGE_BYTES, self.size // each)
        if count > most:
            raise BagError(
                f'{self.path}: over {most} {of} in {self.size} bytes; is it damaged? '
                f'Otherwise set {VARIABLE}'
            )

    def _note_damage(self, start: int, reason: str, num_found: int) -> None:
        """Note a damaged chunk, and the number of messages before the damage."""
        if start not in self.skipped_at:
            self.skipped_at.append(start)
            kept = f' (the {num_found} messages before it are read)' if num_found else ''
            self.skip_reason = self.skip_reason or reason + kept

    def _message(self, number: int, at: int, size: int) -> bytes | memoryview:
        """Return the bytes of a message: a copy, or a view into its chunk if it is most of it."""
        if number == LOOSE:
            return self._at(at, size)
        records = self._kept.get(number)
        if records is None:
            with self._budget.clock():
                self._budget.check_time()
                head = self._head(self._chunks[number])
                if is_plain(head):
                    return self._at(head.start + at, size)
                records = self._unpacked(number)
        else:
            self._kept.move_to_end(number)
        view = memoryview(records)[at : at + size]
        is_most = size > MOST_OF_CHUNK * len(records)
        return view if is_most or size > MAX_COPIED_BYTES else bytes(view)

    def _unpacked(self, number: int) -> bytes | bytearray:
        """Return the records of a chunk, up to the cut if the file ends in it."""
        if number in self._kept:
            self._kept.move_to_end(number)
            return self._kept[number]
        chunk = self._chunks[number]
        head = self._head(chunk)
        is_kept = not is_plain(head) or head.unpacked_size <= KEPT_BYTES
        while is_kept and self._kept and not self._has_room(head.unpacked_size):
            _, dropped = self._kept.popitem(last=False)
            self._budget.give_back(len(dropped))
        self._make_room(head.unpacked_size)
        self._check_room(head)
        packed = self._at(head.start, head.size)
        records = unpacked(packed, head.compression, head.unpacked_size)
        self._check_sum(number, len(records), head.compression)
        if chunk.is_whole:
            if len(records) != head.unpacked_size:
                raise ValueError(f'{len(records)} of {head.unpacked_size} bytes unpacked')
            if head.checksum and crc32(records) != head.checksum:
                raise ValueError('wrong checksum')
        if is_kept:
            self._budget.take(len(records), 'unpacked chunk')
            self._kept[number] = records
        return records

    def _check_room(self, head: Packed) -> None:
        """Raise ValueError if a chunk is larger than one may be, or than its packed size."""
        left = min(self._budget.max_bytes - self._budget.used_bytes, max_unpacked_bytes(self.size))
        if head.unpacked_size > left:
            raise ValueError(
                f'a chunk needs {head.unpacked_size} bytes unpacked, more than the limit of '
                f'{left} for this file; is it damaged? Otherwise set {VARIABLE}'
            )

    def _check_sum(self, number: int, size: int, compression: str) -> None:
        """Raise BagError if the chunks unpacked so far are too large together."""
        if number in self._ever_unpacked:
            return
        self._ever_unpacked.add(number)
        self._sum_unpacked += size
        most = max_unpacked_sum(self.size, compression)
        if self._sum_unpacked > most:
            raise BagError(
                f'{self.path}: chunks of over {most} bytes unpacked in {self.size} bytes; is it '
                f'damaged? Otherwise set {VARIABLE}'
            )

    def _make_room(self, size: int) -> None:
        """Drop the places that are kept from the survey if memory is needed for something else."""
        if self._num_places and self._budget.used_bytes + size > self._budget.max_bytes:
            self._forget_places()

    def _forget_places(self) -> None:
        """Drop the places of messages that are kept from the survey."""
        self._budget.give_back(MESSAGE_BYTES * self._num_places)
        self._indexes.clear()
        self._num_places = 0

    def _has_room(self, size: int) -> bool:
        """Return whether a further chunk of this size may be kept beside the others."""
        held = sum(map(len, self._kept.values()))
        return len(self._kept) < KEPT_CHUNKS and held + size <= KEPT_BYTES


def is_plain(head: Packed) -> bool:
    """Return whether the records of a chunk are not compressed."""
    return head.compression in ('', 'none')


def as_index(numbers: array[int]) -> Index:
    """Return entries of an index, one after the other, as (M, 6)."""
    return np.array(numbers, np.int64).reshape(-1, INDEX_COLUMNS)
