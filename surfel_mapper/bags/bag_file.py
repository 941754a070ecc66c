# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reading one file of a bag without rosbags, within a budget.

rosbags reads indexes and unpacks chunks without limits of memory or time, and refuses files
without an index, which is missing if the recorder was killed, the disk was full or a copy was
interrupted. So bags are read here: mcap and ROS 1 in chunked.py and the module of each format,
sqlite3 through SQLite in sqlite.py, or page by page in sqlite_pages.py if it is truncated. Damage
is reported: ``cut_at`` is the byte at which a file ends too early, ``skipped_at`` the damaged
chunks.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import ClassVar, NamedTuple, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import Budget, open_regular, stated_limit, VARIABLE
from surfel_mapper.errors import BagError

if TYPE_CHECKING:
    from surfel_mapper.bags._rosbags import Connection

MESSAGE_BYTES = 100
"""Memory charged for a message in an index: 48 bytes, and as much to sort it."""

MAX_CONNECTIONS, CONNECTION_BYTES = 4096, 2000
"""Limit of the topics of a file (in ROS 1 a topic has one for each publisher), and memory of one.
Recordings have some hundreds; each takes 20 us."""

INDEX_COLUMNS = 6
"""Integers of an entry of an index: record time, connection, and four that locate the message."""

Index = npt.NDArray[np.int64]


class FoundMessage(NamedTuple):
    """An entry of an index: record time, connection and place of a message."""

    record_ns: int
    connection: int
    place: tuple[int, int, int, int]


class BagFile(ABC):
    """
    A file of a bag, with the interface of rosbags' readers.

    Parameters
    ----------
    path : Path
        The file.

    Attributes
    ----------
    cut_at : int, optional
        Offset of the first record that is not whole; None if the file is complete.
    skipped_at : list of int
        Offsets of the damaged chunks, which are skipped from the damage on.
    losses : list of str
        What else is missing.
    connections : list of Connection
        With the number of messages found.
    start_time, end_time : int
        Record time of the first message, and one after that of the last.

    Raises
    ------
    BagError
        If reading takes more memory or time than the file is worth.
    ValueError, LookupError, struct.error
        If it is damaged, so that nothing can be read.

    """

    MAGIC: ClassVar[bytes]
    """First bytes of such a file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = path.stat().st_size
        self.cut_at: int | None = None
        self.skipped_at: list[int] = []
        self.losses: list[str] = []
        self._budget = Budget(path, self.size, BagError)
        self._max_connections = max(MAX_CONNECTIONS, stated_limit() // CONNECTION_BYTES)
        self._described_bytes = 0
        self._by_id: dict[int, Connection] = {}
        self._counts: Counter[int] = Counter()
        self.start_time, self.end_time = 2**63 - 1, 0
        self._file = open_regular(path)
        try:
            with self._budget.clock():
                self._survey()
        except BaseException:
            self._file.close()
            raise
        self.connections = [c._replace(msgcount=self._counts[c.id]) for c in self._by_id.values()]
        self.message_count = sum(connection.msgcount for connection in self.connections)

    @abstractmethod
    def _survey(self) -> None:
        """Find connections, counts of messages and their span; fill the attributes."""

    @abstractmethod
    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple[Connection, int, bytes | memoryview]]:
        """Yield connection, record time and bytes of messages, in order of record time."""

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _keep_connection(self, key: int, connection: Connection, size: int) -> None:
        """Keep a connection whose description has a size, bytes; refuse too many."""
        if key not in self._by_id:
            taken = size + CONNECTION_BYTES
            self._budget.take(taken, f'descriptions of {len(self._by_id) + 1} topics')
            self._described_bytes += taken
        self._by_id[key] = connection
        if len(self._by_id) > self._max_connections:
            raise BagError(
                f'{self.path}: over {self._max_connections} topics; is it damaged? Otherwise set '
                f'{VARIABLE}'
            )

    def _note_span(self, first_ns: int, last_ns: int) -> None:
        """Extend the span by the record times of messages."""
        self.start_time = min(self.start_time, first_ns)
        self.end_time = max(self.end_time, last_ns + 1)

    def _at(self, start: int, size: int) -> bytes:
        """Return bytes of the file; fewer at its end."""
        self._file.seek(start)
        return self._file.read(size)
