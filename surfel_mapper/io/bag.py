# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Messages from a bag: rosbag2 (mcap, sqlite3, zstd) and ROS 1, read by rosbags, imported only here.

The files of a rosbag2 directory are opened one by one and merged in record time. So a recording
that was killed before its metadata.yaml was written still reads, and messages do not go missing
where the descriptions of a topic in metadata.yaml and in the file differ: rosbags 0.11 then
yields none, in silence. For the same reason all that is read is counted against what the indexes
state. Only compressed bags, of which metadata.yaml alone says so, are left to rosbags as a whole.

Damaged files make rosbags raise nearly anything (AssertionError, KeyError, struct.error, ...),
so whatever comes out of it becomes a BagError here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import ExitStack
import heapq
import logging
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, TYPE_CHECKING

from surfel_mapper.errors import BagError, DependencyError
from surfel_mapper.io.bag_files import files_of, stated_counts
from surfel_mapper.io.bag_topics import CLOUD, SAME_AS, Topic, Topics
from surfel_mapper.io.raw_cloud import parse_cloud

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys.store import Typestore

REPAIR = {'.mcap': 'mcap recover', '.db3': 'sqlite3 FILE .recover', '.bag': 'rosbag reindex'}
"""The tool that may help with a file that does not read."""

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'

log = logging.getLogger(__name__)


class BagMessage(NamedTuple):
    """A message as it lies in the bag; ``BagReader.decode`` makes an object of it."""

    topic: str
    type: str
    record_ns: int
    raw: bytes | memoryview


class BagReader:
    """
    The messages of a bag in the order of their record time.

    Parameters
    ----------
    path : str or Path
        A rosbag2 directory, one of its .mcap or .db3 files, or a ROS 1 .bag.

    Attributes
    ----------
    topics : Topics
        By name, with the number of messages that the index states.
    is_ros1 : bool
        Whether messages are serialised as in ROS 1; else they are CDR.

    Raises
    ------
    BagError
        If there is no such bag, it cannot be read, or it holds no messages.

    """

    def __init__(self, path: str | Path) -> None:
        """Open the bag and read its index."""
        self.path = Path(path)
        self.is_ros1 = self.path.suffix == '.bag'
        self._decoders: dict[str, tuple[Typestore, str]] = {}
        self._readers: list[Reader1 | Reader2] = []
        with ExitStack() as files:
            for file in files_of(self.path):
                self._readers.append(self._open(file))
                files.callback(self._readers[-1].close)
            self.topics = Topics(self.path, self._indexed_topics())
            if not any(topic.count for topic in self.topics):
                raise BagError(f'{self.path}: a bag without messages')
            self._files = files.pop_all()

    def __enter__(self) -> BagReader:
        """Return the reader, to be closed at the end of the block."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the files."""
        self._files.close()

    @property
    def start_ns(self) -> int:
        """Record time of the first message."""
        return min(reader.start_time for reader in self._readers if reader.message_count)

    @property
    def end_ns(self) -> int:
        """Record time of the last message."""
        return max(reader.end_time for reader in self._readers if reader.message_count) - 1

    def is_latched(self, name: str) -> bool:
        """Return whether the publisher of a topic kept messages for those who came later."""
        every = (connection for reader in self._readers for connection in reader.connections)
        return any(latches(connection) for connection in every if connection.topic == name)

    def messages(self, names: Collection[str] | None = None) -> Iterator[BagMessage]:
        """
        Yield messages in the order of their record time.

        Parameters
        ----------
        names : collection of str, optional
            The topics to read; all without.

        Raises
        ------
        BagError
            If the bag turns out to be damaged, or yields nothing of a topic that should hold
            messages. Where it yields fewer than stated, a warning says so.

        """
        read: Counter[str] = Counter()
        stream = self._stream(names)
        while True:
            try:
                connection, record_ns, raw = next(stream)
            except StopIteration:
                break
            except Exception as error:
                done = sum(read.values())
                raise self._damaged(self.path, f'damaged after {done} messages', error) from error
            if raw[:4] == ZSTD_MAGIC:
                raise BagError(
                    f'{self.path}: its messages are compressed, which only metadata.yaml states; '
                    'name the directory that holds it'
                )
            read[connection.topic] += 1
            type_ = SAME_AS.get(connection.msgtype, connection.msgtype)
            yield BagMessage(connection.topic, type_, record_ns, raw)
        self._check_complete(read, names)

    def decode(self, message: BagMessage) -> Any:
        """
        Return a message as an object with the attributes of its ROS type.

        Raises
        ------
        CloudFormatError
            If it should be a PointCloud2 and is none.
        BagError
            If it cannot be read as its type.

        """
        if message.type == CLOUD:
            return parse_cloud(message.raw, ros1=self.is_ros1, topic=message.topic)
        try:
            store, type_ = self._decoder(message.type)
            if self.is_ros1:
                return store.deserialize_ros1(message.raw, type_)
            return store.deserialize_cdr(message.raw, type_)
        except Exception as error:
            raise BagError(
                f'{self.path}: {message.topic}: {len(message.raw)} bytes that are no '
                f'{message.type}: {described(error)}'
            ) from error

    def _open(self, path: Path) -> Reader1 | Reader2:
        """Open one file, or a directory that rosbags reads as a whole."""
        try:
            from rosbags import rosbag1, rosbag2
        except ImportError as error:
            raise DependencyError(
                f'rosbags cannot be loaded ({error}). It reads the bags; install it with '
                '`pip install rosbags`'
            ) from error
        reader: Reader1 | Reader2
        try:
            reader = rosbag1.Reader(path) if self.is_ros1 else rosbag2.Reader(path)
            reader.open()
        except Exception as error:
            raise self._damaged(path, 'cannot be read', error) from error
        return reader

    def _indexed_topics(self) -> list[Topic]:
        """Return the topics in all files with the counts of index or metadata.yaml."""
        types: dict[str, set[str]] = {}
        counts: Counter[str] = Counter()
        for reader in self._readers:
            for name, info in reader.topics.items():
                types.setdefault(name, set()).update(map(type_name, info.connections))
                counts[name] += info.msgcount
        counts |= Counter(stated_counts(self.path))
        return [
            Topic(name, ', '.join(sorted(names)), counts[name])
            for name, names in sorted(types.items())
        ]

    def _stream(self, names: Collection[str] | None) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield what rosbags yields of all files, in record time; equal times by file."""
        streams = []
        for reader in self._readers:
            wanted = [c for c in reader.connections if is_cdr(c)]
            if names is not None:
                wanted = [c for c in wanted if c.topic in names]
            if wanted:  # of an empty list rosbags would make all
                streams.append(reader.messages(wanted))
        return heapq.merge(*streams, key=lambda item: item[1])

    def _check_complete(self, read: Counter[str], names: Collection[str] | None) -> None:
        """Compare what was read of every topic with what the index states."""
        asked = [topic for topic in self.topics if names is None or topic.name in names]
        short = [topic for topic in asked if read[topic.name] < topic.count]
        text = ', '.join(f'{topic.name} {read[topic.name]} of {topic.count}' for topic in short)
        message = f'{self.path}: fewer messages than its index states: {text}'
        if any(not read[topic.name] for topic in short):
            raise BagError(f'{message}; try a single file of the bag, or `ros2 bag reindex`')
        if short:
            log.warning(message)

    def _decoder(self, type_: str) -> tuple[Typestore, str]:
        """Return who decodes a type, and the name it knows it by."""
        if type_ not in self._decoders:
            self._decoders[type_] = self._new_decoder(type_)
        return self._decoders[type_]

    def _new_decoder(self, type_: str) -> tuple[Typestore, str]:
        """Return a decoder from rosbags' own definitions, or from the bag's for ROS 1."""
        from rosbags.typesys import get_types_from_msg, get_typestore, Stores

        if not self.is_ros1:
            return get_typestore(Stores.ROS2_JAZZY), type_
        every = (connection for reader in self._readers for connection in reader.connections)
        found = next(connection for connection in every if type_name(connection) == type_)
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(found.msgdef.data, found.msgtype))
        return store, found.msgtype

    def _damaged(self, path: Path, what: str, error: Exception) -> BagError:
        """Return the error for a file that rosbags gives up on."""
        tool = REPAIR.get(path.suffix, 'ros2 bag reindex')
        return BagError(
            f'{path}: {what}: {described(error)}; if it was cut off or never closed, '
            f'`{tool}` may save what is readable'
        )


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


def described(error: Exception) -> str:
    """Return what an error of rosbags says; its type too, where that is not meant for readers."""
    text = str(error).rstrip('.')
    return text if type(error).__name__ == 'ReaderError' else f'{type(error).__name__}: {text}'
