# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Messages from a bag: rosbag2 (mcap, sqlite3, zstd) and ROS 1.

The files of a rosbag2 directory are opened one by one and merged by record time. So a recording
that was killed before its metadata.yaml was written can be read, and no message is lost if the
descriptions of a topic in metadata.yaml and in the file differ: rosbags 0.11 then silently yields
none. For the same reason the messages read are counted and compared with the index. A truncated
mcap file yields its whole messages, and a warning states the offset of the cut; a truncated
database or ROS 1 bag is refused with the command that mends it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from functools import cache
import heapq
import logging
from pathlib import Path
import tempfile
from typing import Any, NamedTuple, TYPE_CHECKING

from surfel_mapper.bags._rosbags import (
    is_latched,
    is_readable,
    jazzy_types,
    member_names,
    ros1_types,
    ros2_hash,
    serialization,
    type_name,
)
from surfel_mapper.bags.compression import import_zstd, unpack_file, ZSTD_MAGIC
from surfel_mapper.bags.paths import files_of, is_packed, stated_counts, unpacked_name
from surfel_mapper.bags.storage import damaged, described, open_storage
from surfel_mapper.bags.streamed_mcap import StreamedMcap
from surfel_mapper.bags.topics import CLOUD, SAME_AS, Topic, Topics
from surfel_mapper.errors import BagError, SurfelMapperError
from surfel_mapper.messages.livox import MEMBERS, parse_livox
from surfel_mapper.messages.pointcloud2 import parse_cloud

if TYPE_CHECKING:
    from surfel_mapper.bags._rosbags import Connection, Typestore
    from surfel_mapper.bags.storage import Storage

LIVOX_PARSERS = dict.fromkeys(
    ('livox_ros_driver/msg/CustomMsg', 'livox_ros_driver2/msg/CustomMsg'), parse_livox
)
"""Decoder of the types of Livox's drivers."""

log = logging.getLogger(__name__)


class BagMessage(NamedTuple):
    """A serialised message of a bag; ``BagReader.decode`` makes an object of it."""

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
        By name, with the number of messages by the index.
    is_ros1 : bool
        Whether messages are serialised as in ROS 1; else they are CDR.
    cuts : list of str
        A sentence for each file that is incomplete, with the offset; each is logged once.

    Raises
    ------
    BagError
        If there is no such bag, it cannot be read, or it holds no messages.

    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.cuts: list[str] = []
        self._whole: dict[frozenset[str], list[BagMessage]] = {}
        self._storages: list[tuple[Path, Storage]] = []
        with ExitStack() as files:
            self._open(files_of(self.path), files)
            readable = [c for c in self._connections() if is_readable(c)]
            self.is_ros1 = {*map(serialization, readable)} == {'ros1'}
            self.topics = Topics(self.path, self._indexed_topics(), self._cloud_types())
            if not any(topic.count for topic in self.topics):
                raise BagError('; '.join([f'{self.path}: a bag without messages', *self.cuts]))
            self._decoder = cache(self._new_decoder)
            self._files = files.pop_all()
        for cut in self.cuts:
            log.warning(cut)

    def __enter__(self) -> BagReader:
        """Return the reader, to be closed at the end of the block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the files."""
        self._files.close()

    @property
    def start_ns(self) -> int:
        """Record time of the first message."""
        return min(s.start_time for _, s in self._storages if s.message_count)

    @property
    def end_ns(self) -> int:
        """Record time of the last message."""
        return max(s.end_time for _, s in self._storages if s.message_count) - 1

    def is_latched(self, name: str) -> bool:
        """Return whether a topic is latched: late subscribers get its last messages."""
        return any(c.topic == name and is_latched(c) for c in self._connections())

    def messages(
        self,
        names: Collection[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[BagMessage]:
        """
        Yield messages in the order of their record time.

        Parameters
        ----------
        names : collection of str, optional
            The topics to read; all if not given.
        start_ns, stop_ns : int, optional
            Range of record times: start_ns <= t < stop_ns.

        Raises
        ------
        BagError
            If the bag turns out to be damaged, or yields no message of a topic that has some by
            the index. If it yields fewer than the index states, a warning is logged.

        """
        read: Counter[str] = Counter()
        streams = [
            self._stream(path, storage, names, start_ns, stop_ns)
            for path, storage in self._storages
        ]
        for message in heapq.merge(*streams, key=lambda message: message.record_ns):
            read[message.topic] += 1
            yield message
        if start_ns is None and stop_ns is None and not self.cuts:
            self._check_complete(read, names)

    def all_messages(self, names: Collection[str]) -> list[BagMessage]:
        """Return all messages of topics that have few, such as static transforms; read once."""
        key = frozenset(names)
        if key and key not in self._whole:
            self._whole[key] = [*self.messages(names)]
        return self._whole.get(key, [])

    def decode(self, message: BagMessage) -> Any:
        """
        Return a message as an object with the attributes of its ROS type.

        Raises
        ------
        CloudFormatError
            If a PointCloud2 cannot be read.
        BagError
            If a message of another type cannot be read.

        """
        parse = {CLOUD: parse_cloud, **LIVOX_PARSERS}.get(message.type)
        if parse is not None:
            return parse(message.raw, ros1=self.is_ros1, topic=message.topic)
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

    def definition(self, type_: str) -> tuple[str, str] | None:
        """
        Return text and hash of the definition of a message type in a ROS 2 bag.

        None for types of ROS 2 Jazzy, which the bag need not define.

        Raises
        ------
        BagError
            If the messages are not CDR, or the bag has no definition that can be copied.

        """
        if type_ in jazzy_types().fielddefs:
            return None
        try:
            connection = self._connection(type_)
            if not is_readable(connection):
                raise ValueError('its messages are not CDR')
            if not connection.msgdef.data:
                raise ValueError('the bag has no definition of it')
            return connection.msgdef.data, ros2_hash(connection)
        except Exception as error:  # of a text from the bag
            reason = f'no definition of {error}' if isinstance(error, KeyError) else error
            raise BagError(f'{self.path}: {type_} cannot be copied: {reason}') from error

    def _new_decoder(self, type_: str) -> tuple[Typestore, str]:
        """Return type store and name of a type: Jazzy's, or those of a definition of ROS 1."""
        if not self.is_ros1:
            return jazzy_types(), type_
        connection = self._connection(type_)
        return ros1_types(connection), connection.msgtype

    def _connection(self, type_: str) -> Connection:
        """Return the first connection of a type; raise KeyError if there is none."""
        for connection in self._connections():
            if type_name(connection) == type_:
                return connection
        raise KeyError(type_)

    def _open(self, paths: list[Path], files: ExitStack) -> None:
        """Open the files of the bag; the last of several may be unreadable, as after a crash."""
        for number, path in enumerate(paths, 1):
            try:
                is_plain = path.name == unpacked_name(path) and not is_packed(path)
                file = path if is_plain else self._unpacked(path, files)
                storage = open_storage(file, path)
            except BagError as error:
                if number == 1 or number < len(paths):
                    raise
                self.cuts.append(f'file skipped, it cannot be read: {error}')
                continue
            files.callback(storage.close)
            self._storages.append((path, storage))
            if isinstance(storage, StreamedMcap):
                self.cuts += storage.losses(path)
            journal = path.with_name(f'{path.name}-wal')
            if journal.is_file() and journal.stat().st_size:
                self.cuts.append(
                    f'{journal}: journal with messages that are not read; merge them with '
                    f'`sqlite3 {path} "PRAGMA wal_checkpoint(TRUNCATE)"`'
                )

    def _unpacked(self, path: Path, files: ExitStack) -> Path:
        """Return a file unpacked into a temporary directory, or linked if it only has the name."""
        directory = files.enter_context(tempfile.TemporaryDirectory(prefix='surfel_mapper-'))
        target = Path(directory, unpacked_name(path))
        if not is_packed(path):
            target.symlink_to(path.resolve())
        elif not unpack_file(path, target):
            size = path.stat().st_size
            self.cuts.append(f'{path}: the compressed file is cut off at byte {size}')
        return target

    def _connections(self) -> Iterator[Connection]:
        """Yield the connections of all files."""
        for _, storage in self._storages:
            yield from storage.connections

    def _indexed_topics(self) -> list[Topic]:
        """Return the topics in all files with the counts of the indexes or metadata.yaml."""
        types: dict[str, set[str]] = {}
        counts: Counter[str] = Counter()
        for connection in self._connections():
            types.setdefault(connection.topic, set()).add(type_name(connection))
            counts[connection.topic] += connection.msgcount
        if not self.cuts:
            counts |= Counter(stated_counts(self.path))
        return [
            Topic(name, ', '.join(sorted(names)), counts[name])
            for name, names in sorted(types.items())
        ]

    def _cloud_types(self) -> tuple[str, ...]:
        """Return the types that can be read as clouds: Livox's only if defined as it is read."""
        livox = {
            type_
            for connection in self._connections()
            if (type_ := type_name(connection)) in LIVOX_PARSERS
            and member_names(connection, type_) == [*MEMBERS]
        }
        return (CLOUD, *sorted(livox))

    def _stream(
        self,
        path: Path,
        storage: Storage,
        names: Collection[str] | None,
        start_ns: int | None,
        stop_ns: int | None,
    ) -> Iterator[BagMessage]:
        """Yield the messages of one file; packed ones unpacked."""
        wanted = [c for c in storage.connections if is_readable(c)]
        if names is not None:
            wanted = [c for c in wanted if c.topic in names]
        if not wanted:
            return
        unpack, done = import_zstd().decompress, 0
        try:
            for connection, record_ns, raw in storage.messages(wanted, start_ns, stop_ns):
                if raw[:4] == ZSTD_MAGIC and not self.is_ros1:
                    raw = unpack(raw)
                type_ = SAME_AS.get(connection.msgtype, connection.msgtype)
                yield BagMessage(connection.topic, type_, record_ns, raw)
                done += 1
        except SurfelMapperError:
            raise
        except Exception as error:  # rosbags raises many types for damaged files
            raise damaged(path, f'damaged after {done} messages', error) from error

    def _check_complete(self, read: Counter[str], names: Collection[str] | None) -> None:
        """Compare the number of messages read of each readable topic with the index."""
        unread = {c.topic for c in self._connections() if not is_readable(c)}
        asked = [
            topic
            for topic in self.topics
            if topic.name not in unread and (names is None or topic.name in names)
        ]
        short = [topic for topic in asked if read[topic.name] < topic.count]
        text = ', '.join(f'{topic.name} {read[topic.name]} of {topic.count}' for topic in short)
        message = f'{self.path}: fewer messages than its index states: {text}'
        if any(not read[topic.name] for topic in short):
            raise BagError(f'{message}; try a single file of the bag, or `ros2 bag reindex`')
        if short:
            self.cuts.append(message)
            log.warning(message)
