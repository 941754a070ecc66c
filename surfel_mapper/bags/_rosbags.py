# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The only module that imports rosbags, and the only one that uses its internals.

rosbags is imported when the first bag is opened, since it takes 0.2 s. Beside its public readers,
writer and type store we rely on internals, so setup.py bounds it to one minor version: the named
tuples `Connection` and `Qos`, and the chunks of its reader of mcap.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
import re
from typing import Any, Literal, TYPE_CHECKING

from surfel_mapper.bags.paths import is_ros1
from surfel_mapper.bags.topics import SAME_AS
from surfel_mapper.libraries import library

if TYPE_CHECKING:
    from rosbags.interfaces import Connection as Connection
    from rosbags.interfaces import Qos
    from rosbags.rosbag1 import Reader as Rosbag1
    from rosbags.rosbag2 import Reader as Rosbag2
    from rosbags.rosbag2 import Writer
    from rosbags.rosbag2.storage_mcap import McapReader as McapReader
    from rosbags.typesys.store import Typestore as Typestore

    IndexedBag = Rosbag1 | Rosbag2

TRANSIENT_LOCAL = re.compile(r'durability:\s*(1|transient_local)\b', re.IGNORECASE)
"""Durability of a latched topic in the YAML of a bag: a number or a name, by its version."""

IDL_HEAD = re.compile(r'^={80}\nIDL: .*\n', re.MULTILINE)
"""The lines before each of the types in a definition as IDL."""

BAG_VERSION: Literal[9] = 9
"""Version of metadata.yaml that rosbag2 of Jazzy writes."""


def import_rosbags() -> None:
    """Load rosbags, or raise DependencyError."""
    library('rosbags.rosbag2', 'knows the types of the messages in bags', 'rosbags')


def open_indexed(path: Path) -> IndexedBag | None:
    """
    Return rosbags' reader of a file, opened; None for mcap without a whole index.

    rosbags reads mcap without chunks in the order of the file, not of time.
    """
    if is_ros1(path):
        from rosbags.rosbag1 import Reader as Rosbag1

        bag = Rosbag1(path)
        bag.open()
        return bag
    from rosbags.rosbag2 import Reader as Rosbag2
    from rosbags.rosbag2.storage_mcap import McapReader

    reader = Rosbag2(path)
    reader.open()
    if isinstance(reader.storage, McapReader) and not is_indexed(reader.storage):
        reader.close()
        return None
    return reader


def is_indexed(mcap: McapReader) -> bool:
    """Return whether the summary has each chunk and channel; of others rosbags yields nothing."""
    counts = [chunk.channel_count for chunk in mcap.chunks]
    return bool(counts) and all(
        channels and channels.keys() <= mcap.channels.keys() for channels in counts
    )


def ros2_connection(
    key: int,
    topic: str,
    type_: str,
    owner: Any,
    *,
    encoding: str,
    qos: str,
    definition: tuple[str, str],
) -> Connection:
    """
    Return the connection of a topic found in an mcap file without an index.

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
    from rosbags import interfaces

    kinds = interfaces.MessageDefinitionFormat
    formats = {'ros2msg': kinds.MSG, 'ros2idl': kinds.IDL}
    kind, text = definition
    stated = interfaces.MessageDefinition(formats.get(kind, kinds.NONE), text)
    profiles = [latched_profile()] if TRANSIENT_LOCAL.search(qos) else []
    ext = interfaces.ConnectionExtRosbag2(encoding, profiles)
    return interfaces.Connection(key, topic, type_, stated, '', 0, ext, owner)


def latched_profile() -> Qos:
    """Return the quality of service of a publisher that keeps its last message for latecomers."""
    from rosbags import interfaces

    never = interfaces.QosTime(sec=9223372036, nsec=854775807)
    return interfaces.Qos(
        history=interfaces.QosHistory.KEEP_LAST,
        depth=1,
        reliability=interfaces.QosReliability.RELIABLE,
        durability=interfaces.QosDurability.TRANSIENT_LOCAL,
        deadline=never,
        lifespan=never,
        liveliness=interfaces.QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=never,
        avoid_ros_namespace_conventions=False,
    )


def serialization(connection: Connection) -> str:
    """Return the serialisation of messages: cdr, ros1, or one that is not read, as protobuf."""
    return str(getattr(connection.ext, 'serialization_format', 'ros1'))


def is_readable(connection: Connection) -> bool:
    """Return whether messages are serialised as CDR or as in ROS 1."""
    return serialization(connection) in ('cdr', 'ros1')


def is_latched(connection: Connection) -> bool:
    """Return whether the publisher offered its last messages to late subscribers."""
    from rosbags.interfaces import ConnectionExtRosbag1

    ext = connection.ext
    if isinstance(ext, ConnectionExtRosbag1):
        return bool(ext.latching)
    return any(qos.durability.name == 'TRANSIENT_LOCAL' for qos in ext.offered_qos_profiles)


def type_name(connection: Connection) -> str:
    """Return the message type of a connection, with the serialisation if that is not read."""
    name = SAME_AS.get(connection.msgtype, connection.msgtype)
    return name if is_readable(connection) else f'{name} as {serialization(connection)}'


@cache
def jazzy_types() -> Typestore:
    """Return rosbags' message types of ROS 2 Jazzy; made once, since that takes 0.2 s."""
    from rosbags.typesys import get_typestore, Stores

    return get_typestore(Stores.ROS2_JAZZY)


def ros1_types(connection: Connection) -> Typestore:
    """Return the message types of the definition in a ROS 1 connection."""
    from rosbags.typesys import get_typestore, Stores

    store = get_typestore(Stores.EMPTY)
    store.register(_parsed(connection))
    return store


def ros2_hash(connection: Connection) -> str:
    """
    Return the hash of the type of a ROS 2 connection, from the bag or else of its definition.

    No code is generated from the definition. Raises any exception if there is no hash.
    """
    from rosbags.typesys import get_typestore, Stores

    if connection.digest:
        return connection.digest
    store = get_typestore(Stores.EMPTY)
    store.fielddefs = {**jazzy_types().fielddefs, **_parsed(connection)}
    return store.hash_rihs01(connection.msgtype)


def member_names(connection: Connection, type_: str) -> list[str]:
    """Return the names of the members of a type by the definition of a connection; none if bad."""
    try:
        return [name for name, _ in _parsed(connection)[type_][1]]
    except Exception:  # of a text from the bag, of many types
        return []


def _parsed(connection: Connection) -> Any:
    """Return the fields of the types in a definition."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    text = connection.msgdef.data
    if connection.msgdef.format is not MessageDefinitionFormat.IDL:
        return get_types_from_msg(text, connection.msgtype)
    fields = {}
    for idl in filter(None, IDL_HEAD.split(text)):
        fields.update(get_types_from_idl(idl))
    return fields


def new_writer(directory: Path, storage: str) -> Writer:
    """Return rosbags' writer of a new bag, not yet open; storage is mcap or sqlite3."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    return Writer(directory, version=BAG_VERSION, storage_plugin=StoragePlugin[storage.upper()])
