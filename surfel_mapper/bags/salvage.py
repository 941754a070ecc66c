# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Salvage: read a file of a bag record by record from its beginning, without the index at its end.

rosbags needs that index, which is missing if the recorder was killed, the disk was full or a copy
was interrupted. Salvage finds every whole message, in 48 bytes of memory each, sorts them by
record time as an index does, and states at which byte the file ends too early. Chunks with a wrong
checksum are skipped and counted. It is our own code because the libraries refuse such files and
the repair tools need a second copy on the disk.

A few kilobytes of packed chunks can hold millions of empty messages. So the messages found are
charged to the budget of the file, and one chunk at a time is unpacked if chunks are large.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from array import array
from collections import OrderedDict
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import ClassVar, NamedTuple, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.bags.compression import unpacked
from surfel_mapper.budget import Budget
from surfel_mapper.errors import BagError

if TYPE_CHECKING:
    from surfel_mapper.bags._rosbags import Connection

KEPT_CHUNKS = 4
"""Number of chunks kept unpacked: neighbouring chunks overlap in time."""

KEPT_BYTES = 64 << 20
"""Limit of their size together; a larger chunk is kept alone."""

MESSAGE_BYTES = 100
"""Memory charged for a message: 48 bytes in the index, and as much to sort it."""

INDEX_FLOOR_BYTES = 16 << 20
"""Memory that the index of any file may take: 160,000 messages."""

NUM_PLACE = 4
"""Integers that locate a message; their meaning is that of the kind of file."""


class FoundMessage(NamedTuple):
    """An entry of the rebuilt index: record time, connection and place of a message."""

    record_ns: int
    connection: int
    place: tuple[int, int, int, int]


class Chunk(NamedTuple):
    """Place, compression and size of the packed records of a chunk."""

    start: int
    size: int
    compression: str
    unpacked_size: int


class SalvagedFile(ABC):
    """
    A file read without its index, with the interface of rosbags' readers (see Storage).

    Parameters
    ----------
    path : Path
        The file.

    Attributes
    ----------
    cut_at : int, optional
        Offset of the first record that is not whole; None if the file is complete.
    skipped_at : list of int
        Offsets of the damaged chunks that were skipped.
    connections : list of Connection
        With the number of messages found.
    start_time, end_time : int
        Record time of the first message, and one after that of the last.

    """

    MAGIC: ClassVar[bytes]
    """First bytes of such a file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = path.stat().st_size
        self.cut_at: int | None = None
        self.skipped_at: list[int] = []
        self._budget = Budget(path, self.size, BagError, floor=INDEX_FLOOR_BYTES)
        self._by_id: dict[int, Connection] = {}
        self._file = open(path, 'rb')  # noqa: SIM115 - closed by close
        try:
            self._index = self._sorted_index()
        except BaseException:
            self._file.close()
            raise
        counts = dict(zip(*np.unique(self._index[:, 1], return_counts=True), strict=True))
        self.connections = [
            c._replace(msgcount=int(counts.get(c.id, 0))) for c in self._by_id.values()
        ]
        self.message_count = len(self._index)
        self.start_time = int(self._index[0, 0]) if self.message_count else 2**63 - 1
        self.end_time = int(self._index[-1, 0]) + 1 if self.message_count else 0

    def _sorted_index(self) -> npt.NDArray[np.int64]:
        """Return time, connection and place of every message, (M, 6), by time."""
        numbers = array('q')
        for count, found in enumerate(self._scan()):
            self._budget.take(MESSAGE_BYTES, f'index of {count + 1} messages')
            if count % 1024 == 0:
                self._budget.check_time()
            numbers.extend((found.record_ns, found.connection, *found.place))
        index = np.frombuffer(numbers, np.int64).reshape(-1, 2 + NUM_PLACE)
        return index[np.argsort(index[:, 0], kind='stable')]

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, record time and bytes of messages, in order of record time."""
        wanted = {connection.id: connection for connection in connections}
        first = 0 if start is None else int(np.searchsorted(self._index[:, 0], start))
        for row in range(first, self.message_count):
            record_ns, connection, *place = self._index[row].tolist()
            if stop is not None and record_ns >= stop:
                return
            if connection in wanted:
                yield wanted[connection], record_ns, self._read(tuple(place))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @abstractmethod
    def _scan(self) -> Iterator[FoundMessage]:
        """Yield the messages in the order of the file; fill ``_by_id`` and ``cut_at``."""

    @abstractmethod
    def _read(self, place: tuple[int, ...]) -> bytes:
        """Return the bytes of a message."""

    def _at(self, start: int, size: int) -> bytes:
        """Return bytes of the file; fewer at its end."""
        self._file.seek(start)
        return self._file.read(size)


class SalvagedChunks(SalvagedFile):
    """
    A file whose records may lie in packed chunks.

    The place of a message is the number of its chunk, or -1 for the file, offset and size.
    """

    def __init__(self, path: Path) -> None:
        self._chunks: list[Chunk] = []
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        super().__init__(path)

    def _add_chunk(self, chunk: Chunk) -> int:
        """Keep the place of a chunk; return its number."""
        self._budget.take(MESSAGE_BYTES, f'{len(self._chunks) + 1} chunks')
        self._chunks.append(chunk)
        return len(self._chunks) - 1

    def _read(self, place: tuple[int, ...]) -> bytes:
        """Return the bytes of a message, from the file or from its chunk."""
        number, start, size, *_ = place
        if number < 0:
            return self._at(start, size)
        return self._unpacked(number)[start : start + size]

    def _unpacked(self, number: int) -> bytes:
        """Return the records of a chunk, up to the cut if the file ends in it."""
        if number in self._kept:
            self._kept.move_to_end(number)
            return self._kept[number]
        chunk = self._chunks[number]
        while self._kept and not self._has_room(chunk.unpacked_size):
            self._kept.popitem(last=False)
        packed = self._at(chunk.start, chunk.size)
        records = self._kept[number] = unpacked(packed, chunk.compression, chunk.unpacked_size)
        return records

    def _has_room(self, size: int) -> bool:
        """Return whether a further chunk of this size may be kept beside the others."""
        held = sum(map(len, self._kept.values()))
        return len(self._kept) < KEPT_CHUNKS and held + size <= KEPT_BYTES
