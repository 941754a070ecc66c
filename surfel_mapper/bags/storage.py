# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Opens a file of a bag: with rosbags where it has its index, else by a scan for whole messages.

Damaged files make rosbags raise nearly anything (AssertionError, KeyError, struct.error, ...),
so whatever comes out of it becomes a BagError here. rosbags also passes in silence over chunks
of mcap of which no index says what they hold; those files are scanned too.
"""

from __future__ import annotations

import bz2
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
import struct
from typing import Any, Protocol, TYPE_CHECKING

from surfel_mapper.bags.compression import bunzip2, check_zstd
from surfel_mapper.bags.mcap import McapScan
from surfel_mapper.bags.paths import is_ros1, unpacked_name
from surfel_mapper.bags.ros1 import Ros1Scan
from surfel_mapper.bags.scanning import ScannedFile
from surfel_mapper.bags.sqlite import is_short, SqliteScan
from surfel_mapper.bags.topics import SAME_AS
from surfel_mapper.errors import BagError, DependencyError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

SCANS: dict[str, type[ScannedFile]] = {
    '.mcap': McapScan,
    '.db3': SqliteScan,
    '.bag': Ros1Scan,
}
"""What reads a file without its index."""

CHUNK_RECORD_BYTES = 9 + 40
"""What stands before the packed records of a chunk in mcap, but for the name of the packing."""

REPAIR = {'.mcap': 'mcap recover', '.db3': 'sqlite3 FILE .recover', '.bag': 'rosbag reindex'}
"""The tool that may help with a file that does not read."""


class Storage(Protocol):
    """What rosbags' readers and the scans have in common."""

    @property
    def connections(self) -> list[Connection]:
        """The connections with the numbers of their messages."""

    @property
    def start_time(self) -> int:
        """Record time of the first message."""

    @property
    def end_time(self) -> int:
        """One more than the record time of the last."""

    @property
    def message_count(self) -> int:
        """How many messages."""

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, record time and bytes."""

    def close(self) -> None:
        """Close the file."""


def open_storage(path: Path, named: Path | None = None) -> Storage:
    """
    Open one file of a bag.

    Parameters
    ----------
    path : Path
        The file.
    named : Path, optional
        What errors call it, where it is a copy.

    Raises
    ------
    BagError
        If it cannot be read, and a scan finds no message in it either.

    """
    named = named or path
    try:
        storage = open_indexed(path)
    except DependencyError:
        raise
    except Exception as error:
        scanned = scan(path, named)
        if scanned is None:
            raise damaged(named, 'cannot be read', error) from error
        return scanned
    scanned = None if is_fully_indexed(storage, path) else scan(path, named)
    if scanned is None:
        return storage
    storage.close()
    return scanned


def open_indexed(path: Path) -> Storage:
    """Return rosbags' reader of a file, opened; rosbags raises what it likes."""
    try:
        from rosbags import rosbag1, rosbag2
    except ImportError as error:
        raise DependencyError(
            f'rosbags cannot be loaded ({error}). It reads the bags; install it with '
            '`pip install rosbags`'
        ) from error
    reader: Any = rosbag1.Reader(path) if is_ros1(path) else rosbag2.Reader(path)
    reader.open()
    try:
        bound_chunks(reader, path)
    except BaseException:
        reader.close()
        raise
    opened: Storage = reader
    return opened


def bound_chunks(reader: Any, path: Path) -> None:
    """
    Refuse packed chunks that get larger than plausible: rosbags unpacks whatever there is.

    lz4 packs 255 times at most and needs no check.
    """
    if is_ros1(path):
        for place, chunk in reader.chunks.items():
            if chunk.decompressor is bz2.decompress:
                reader.chunks[place] = chunk._replace(decompressor=bunzip2)
        return
    chunks = [c for c in getattr(reader.storage, 'chunks', ()) if c.compression == 'zstd']
    with open(path, 'rb') as file:

        def read(start: int, size: int) -> bytes:
            file.seek(start)
            return file.read(size)

        for chunk in chunks:
            head = CHUNK_RECORD_BYTES + len(chunk.compression)
            check_zstd(read, chunk.chunk_start_offset + head, chunk.compressed_size)


def is_fully_indexed(storage: Any, path: Path) -> bool:
    """Return whether all that an index leads to is in the file, and the index leads to all."""
    if suffix(path) == '.db3':
        return not is_short(path)
    chunks = getattr(getattr(storage, 'storage', None), 'chunks', None)
    if chunks is None:
        return True
    indexed: Counter[int] = Counter()
    for chunk in chunks:
        indexed.update(chunk.channel_count)
    return all(indexed[c.id] >= c.msgcount for c in storage.connections)


def scan(path: Path, named: Path) -> ScannedFile | None:
    """Return a file scanned for messages; None where it is of another kind, or holds none."""
    kind = SCANS[suffix(path)]
    with open(path, 'rb') as file:
        if file.read(len(kind.MAGIC)) != kind.MAGIC:
            return None
    try:
        scanned = kind(path)
    except (ValueError, LookupError, struct.error) as error:
        raise damaged(named, 'cannot be read', error) from error
    if not scanned.message_count:
        scanned.close()
        return None
    return scanned


def damaged(path: Path, what: str, error: Exception) -> BagError:
    """Return the error for a file that does not read."""
    return BagError(
        f'{path}: {what}: {described(error)}; if it was cut off or never closed, '
        f'`{REPAIR[suffix(path)]}` may save what is readable'
    )


def suffix(path: Path) -> str:
    """Return which of the three kinds of file it is."""
    return '.bag' if is_ros1(path) else Path(unpacked_name(path)).suffix


def described(error: Exception) -> str:
    """Return what an error of rosbags says; its type too, where that is not meant for readers."""
    text = str(error).rstrip('.')
    return text if type(error).__name__ == 'ReaderError' else f'{type(error).__name__}: {text}'


def is_cdr(connection: Connection) -> bool:
    """Return whether the messages are serialised in the way of their ROS version."""
    return getattr(connection.ext, 'serialization_format', 'cdr') == 'cdr'


def latches(connection: Connection) -> bool:
    """Return whether a publisher offered its last messages to late subscribers."""
    from rosbags.interfaces import ConnectionExtRosbag1

    ext = connection.ext
    if isinstance(ext, ConnectionExtRosbag1):
        return bool(ext.latching)
    return any(qos.durability.name == 'TRANSIENT_LOCAL' for qos in ext.offered_qos_profiles)


def type_name(connection: Connection) -> str:
    """Return the type of a connection; it says so where the bytes are of a foreign format."""
    name = SAME_AS.get(connection.msgtype, connection.msgtype)
    if is_cdr(connection):
        return name
    return f'{name} as {connection.ext.serialization_format}'  # type: ignore[union-attr]
