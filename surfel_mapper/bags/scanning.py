# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A file of a bag read record by record from its beginning, without the index at its end.

rosbags needs that index, which is missing where the recorder was killed, the disk was full or a
copy broke off. A scan finds every message that is whole, in memory of some 200 bytes for each,
sorts them by record time as an index does, and says at which byte the file ends too early.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, OrderedDict
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TYPE_CHECKING

from surfel_mapper.bags.compression import unpacked

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

KEPT_CHUNKS = 4
"""Chunks overlap in time a little, so the last few stay unpacked."""


class Entry(NamedTuple):
    """A message: when it was recorded, of which connection, and where its bytes are."""

    record_ns: int
    connection: int
    place: Any


class Chunk(NamedTuple):
    """Where packed records lie in a file, and how they are packed."""

    start: int
    size: int
    compression: str
    unpacked_size: int


class Place(NamedTuple):
    """Where the bytes of a message are: in a chunk, or in the file itself."""

    chunk: Chunk | None
    start: int
    size: int


class ScannedFile(ABC):
    """
    What rosbags' readers have, of a file without an index.

    Parameters
    ----------
    path : Path
        The file.

    Attributes
    ----------
    cut_at : int, optional
        Offset of the first record that is not whole; None where the file ends as it should.
    connections : list of Connection
        With the number of messages found.
    start_time, end_time : int
        Record time of the first message, and one after that of the last.

    """

    MAGIC: ClassVar[bytes]
    """How such a file begins."""

    def __init__(self, path: Path) -> None:
        """Read the file once and take note of its messages."""
        self.path = path
        self.size = path.stat().st_size
        self.cut_at: int | None = None
        self._found: dict[int, Connection] = {}
        self._file = open(path, 'rb')  # noqa: SIM115 - closed by close
        try:
            self._entries = sorted(self._scan(), key=lambda entry: entry.record_ns)
        except BaseException:
            self._file.close()
            raise
        counts = Counter(entry.connection for entry in self._entries)
        self.connections = [c._replace(msgcount=counts[c.id]) for c in self._found.values()]
        self.message_count = len(self._entries)
        self.start_time = self._entries[0].record_ns if self._entries else 2**63 - 1
        self.end_time = self._entries[-1].record_ns + 1 if self._entries else 0

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, record time and bytes of messages, in order of record time."""
        wanted = {connection.id: connection for connection in connections}
        for entry in self._entries:
            before = start is not None and entry.record_ns < start
            if before or entry.connection not in wanted:
                continue
            if stop is not None and entry.record_ns >= stop:
                return
            yield wanted[entry.connection], entry.record_ns, self._read(entry.place)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @abstractmethod
    def _scan(self) -> Iterator[Entry]:
        """Yield the messages in the order of the file; note connections, and where it is cut."""

    @abstractmethod
    def _read(self, place: Any) -> bytes:
        """Return the bytes of a message."""

    def _at(self, start: int, size: int) -> bytes:
        """Return bytes of the file; fewer at its end."""
        self._file.seek(start)
        return self._file.read(size)


class ChunkedFile(ScannedFile):
    """A file whose records may lie in packed chunks."""

    def __init__(self, path: Path) -> None:
        """Read the file once and take note of its messages."""
        self._chunks: OrderedDict[Chunk, bytes] = OrderedDict()
        super().__init__(path)

    def _read(self, place: Place) -> bytes:
        """Return the bytes of a message, from the file or from its chunk."""
        if place.chunk is None:
            return self._at(place.start, place.size)
        return self._unpacked(place.chunk)[place.start : place.start + place.size]

    def _unpacked(self, chunk: Chunk) -> bytes:
        """Return the records of a chunk, as many as there are."""
        if chunk in self._chunks:
            self._chunks.move_to_end(chunk)
        else:
            packed = self._at(chunk.start, chunk.size)
            self._chunks[chunk] = unpacked(packed, chunk.compression, chunk.unpacked_size)
            if len(self._chunks) > KEPT_CHUNKS:
                self._chunks.popitem(last=False)
        return self._chunks[chunk]
