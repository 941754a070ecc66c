# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Salvage: read a file of a bag record by record from its beginning, without the index at its end.

rosbags needs that index, which is missing if the recorder was killed, the disk was full or a copy
was interrupted. Salvage finds every whole message, in about 200 bytes of memory each, sorts them
by record time as an index does, and states at which byte the file ends too early. It is our own
code because the libraries refuse such files and the repair tools need a second copy on the disk.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, OrderedDict
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TYPE_CHECKING

from surfel_mapper.bags.compression import unpacked

if TYPE_CHECKING:
    from surfel_mapper.bags._rosbags import Connection

KEPT_CHUNKS = 4
"""Number of chunks kept unpacked: neighbouring chunks overlap in time."""


class FoundMessage(NamedTuple):
    """An entry of the rebuilt index: record time, connection and place of a message."""

    record_ns: int
    connection: int
    place: Any


class Chunk(NamedTuple):
    """Place, compression and size of the packed records of a chunk."""

    start: int
    size: int
    compression: str
    unpacked_size: int


class Place(NamedTuple):
    """Place of the bytes of a message: in a chunk, or if that is None in the file."""

    chunk: Chunk | None
    start: int
    size: int


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
        self._by_id: dict[int, Connection] = {}
        self._file = open(path, 'rb')  # noqa: SIM115 - closed by close
        try:
            self._index = sorted(self._scan(), key=lambda found: found.record_ns)
        except BaseException:
            self._file.close()
            raise
        counts = Counter(found.connection for found in self._index)
        self.connections = [c._replace(msgcount=counts[c.id]) for c in self._by_id.values()]
        self.message_count = len(self._index)
        self.start_time = self._index[0].record_ns if self._index else 2**63 - 1
        self.end_time = self._index[-1].record_ns + 1 if self._index else 0

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, record time and bytes of messages, in order of record time."""
        wanted = {connection.id: connection for connection in connections}
        for found in self._index:
            before = start is not None and found.record_ns < start
            if before or found.connection not in wanted:
                continue
            if stop is not None and found.record_ns >= stop:
                return
            yield wanted[found.connection], found.record_ns, self._read(found.place)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @abstractmethod
    def _scan(self) -> Iterator[FoundMessage]:
        """Yield the messages in the order of the file; fill ``_by_id`` and ``cut_at``."""

    @abstractmethod
    def _read(self, place: Any) -> bytes:
        """Return the bytes of a message."""

    def _at(self, start: int, size: int) -> bytes:
        """Return bytes of the file; fewer at its end."""
        self._file.seek(start)
        return self._file.read(size)


class SalvagedChunks(SalvagedFile):
    """A file whose records may lie in packed chunks."""

    def __init__(self, path: Path) -> None:
        self._chunks: OrderedDict[Chunk, bytes] = OrderedDict()
        super().__init__(path)

    def _read(self, place: Place) -> bytes:
        """Return the bytes of a message, from the file or from its chunk."""
        if place.chunk is None:
            return self._at(place.start, place.size)
        return self._unpacked(place.chunk)[place.start : place.start + place.size]

    def _unpacked(self, chunk: Chunk) -> bytes:
        """Return the records of a chunk, up to the cut if the file ends in it."""
        if chunk in self._chunks:
            self._chunks.move_to_end(chunk)
        else:
            packed = self._at(chunk.start, chunk.size)
            self._chunks[chunk] = unpacked(packed, chunk.compression, chunk.unpacked_size)
            if len(self._chunks) > KEPT_CHUNKS:
                self._chunks.popitem(last=False)
        return self._chunks[chunk]
