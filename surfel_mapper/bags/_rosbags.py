# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The only module that imports rosbags, and the only one that uses its internals.

rosbags is imported when the first bag is opened, since it takes 0.2 s. Beside its public readers,
writer and type store we rely on internals that setup.py therefore bounds to one minor version:
the tables of chunks of its readers (`rosbag1.Reader.chunks`, the `chunks` of an mcap storage) and
the named tuples `Connection` and `Qos`, which the salvage of damaged files fills as rosbags does.
"""

from __future__ import annotations

import bz2
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
import re
from typing import Any, Literal, Protocol, TYPE_CHECKING

from surfel_mapper.bags.compression import bunzip2, check_zstd
from surfel_mapper.bags.topics import SAME_AS
from surfel_mapper.errors import DependencyError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection as Connection
    from rosbags.interfaces import Qos
    from rosbags.rosbag2 import Writer
    from rosbags.typesys.store import Typestore as Typestore

TRANSIENT_LOCAL = re.compile(r'durability:\s*(1|transient_local)\b', re.IGNORECASE)
"""Durability of a latched topic in the YAML of a bag: a number or a name, by its version."""

CHUNK_RECORD_BYTES = 9 + 40
"""Bytes of an mcap chunk before its packed records, without the name of the compression."""

BAG_VERSION: Literal[9] = 9
"""Version of metadata.yaml that rosbag2 of Jazzy writes."""


class Storage(Protocol):
    """Interface that rosbags' readers and the salvaged files share."""

    @property
    def connections(self) -> list[Connection]:
        """The connections with the numbers of their messages."""

    @property
    def start_time(self) -> int:
        """Record time of the first message."""

    @property
    def end_time(self) -> int:
        """One more than the record time of the last message."""

    @property
    def message_count(self) -> int:
        """Number of messages."""

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, record time and bytes."""

    def close(self) -> None:
        """Close the file."""


def open_indexed(path: Path, *, ros1: bool) -> Storage:
    """
    Return rosbags' reader of a file, opened.

    Raises
    ------
    DependencyError
        If rosbags is not installed.
    Exception
        Of nearly any type, if the file is damaged: rosbags lets KeyError, struct.error,
        AssertionError and others through.

    """
    try:
        from rosbags import rosbag1, rosbag2
    except ImportError as error:
        raise DependencyError(
            f'rosbags cannot be loaded ({error}). It reads the bags; install it with '
            '`pip install rosbags`'
        ) from error
    reader: Any = rosbag1.Reader(path) if ros1 else rosbag2.Reader(path)
    reader.open()
    try:
        bound_chunks(reader, path, ros1=ros1)
    except BaseException:
        reader.close()
        raise
    opened: Storage = reader
    return opened


def bound_chunks(reader: Any, path: Path, *, ros1: bool) -> None:
    """
    Refuse packed chunks that unpack to more than is plausible; rosbags itself has no limit.

    lz4 packs 255 times at most and needs no check.
    """
    if ros1:
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


def is_fully_indexed(storage: Any) -> bool:
    """
    Return whether the index of an mcap or ROS 1 file accounts for every message it states.

    rosbags skips messages without an index entry or connection record: one changed byte in a
    connection record of a ROS 1 bag lost its topic.
    """
    if hasattr(storage, 'chunk_infos'):
        counts: Counter[int] = Counter()
        for info in storage.chunk_infos:
            counts.update(info.connection_counts)
        return counts == Counter({c.id: c.msgcount for c in storage.connections if c.msgcount})
    chunks = getattr(getattr(storage, 'storage', None), 'chunks', None)
    if chunks is None:
        return True
    indexed: Counter[int] = Counter()
    for chunk in chunks:
        indexed.update(chunk.channel_count)
    return all(indexed[c.id] >= c.msgcount for c in storage.connections)


def ros2_connection(
    key: int,
    topic: str,
    type_: str,
    owner: Any,
    *,
    encoding: str,
    qos: str,
    definition: tuple[str, str] = ('', ''),
) -> Connection:
    """
    Return the connection of a topic found in a rosbag2 file without an index.

    Parameters
    ----------
    key : int
        Its number in the file.
    topic, type_ : str
        Name and type.
    owner : object
        The file.
    encoding : str
        Serialisation format: cdr.
    qos : str
        The offered profiles as YAML.
    definition : (str, str)
        Format (ros2msg, ros2idl) and text of the message definition.

    """
    from rosbags.interfaces import (
        Connection,
        ConnectionExtRosbag2,
        MessageDefinition,
        MessageDefinitionFormat,
    )

    formats = {'ros2msg': MessageDefinitionFormat.MSG, 'ros2idl': MessageDefinitionFormat.IDL}
    kind, text = definition
    stated = MessageDefinition(formats.get(kind, MessageDefinitionFormat.NONE), text)
    profiles = [latched_profile()] if TRANSIENT_LOCAL.search(qos) else []
    ext = ConnectionExtRosbag2(encoding, profiles)
    return Connection(key, topic, type_, stated, '', 0, ext, owner)


def ros1_connection(
    key: int, topic: str, owner: Any, *, type_: str, md5sum: str, definition: str, latching: int
) -> Connection:
    """Return the connection of a topic found in a ROS 1 bag without an index."""
    from rosbags.interfaces import (
        Connection,
        ConnectionExtRosbag1,
        MessageDefinition,
        MessageDefinitionFormat,
    )

    package, _, name = type_.rpartition('/')
    stated = MessageDefinition(MessageDefinitionFormat.MSG, definition)
    ext = ConnectionExtRosbag1(None, latching)
    return Connection(key, topic, f'{package}/msg/{name}', stated, md5sum, 0, ext, owner)


def latched_profile() -> Qos:
    """Return the quality of service of a publisher that keeps its last message for latecomers."""
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    never = QosTime(sec=9223372036, nsec=854775807)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL,
        deadline=never,
        lifespan=never,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=never,
        avoid_ros_namespace_conventions=False,
    )


def is_cdr(connection: Connection) -> bool:
    """Return whether messages are serialised as CDR, or as ROS 1 in a ROS 1 bag."""
    return getattr(connection.ext, 'serialization_format', 'cdr') == 'cdr'


def is_latched(connection: Connection) -> bool:
    """Return whether the publisher offered its last messages to late subscribers."""
    from rosbags.interfaces import ConnectionExtRosbag1

    ext = connection.ext
    if isinstance(ext, ConnectionExtRosbag1):
        return bool(ext.latching)
    return any(qos.durability.name == 'TRANSIENT_LOCAL' for qos in ext.offered_qos_profiles)


def type_name(connection: Connection) -> str:
    """Return the message type of a connection, with the serialisation if that is not CDR."""
    name = SAME_AS.get(connection.msgtype, connection.msgtype)
    if is_cdr(connection):
        return name
    return f'{name} as {connection.ext.serialization_format}'  # type: ignore[union-attr]


def jazzy_types() -> Typestore:
    """Return rosbags' message types of ROS 2 Jazzy."""
    from rosbags.typesys import get_typestore, Stores

    return get_typestore(Stores.ROS2_JAZZY)


def ros1_types(connection: Connection) -> Typestore:
    """Return the message types that the definition in a ROS 1 connection describes."""
    from rosbags.typesys import get_types_from_msg, get_typestore, Stores

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
    return store


def new_writer(directory: Path, storage: str) -> Writer:
    """Return rosbags' writer of a new bag, not yet open; storage is mcap or sqlite3."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    return Writer(directory, version=BAG_VERSION, storage_plugin=StoragePlugin[storage.upper()])
