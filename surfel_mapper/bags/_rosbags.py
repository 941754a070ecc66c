# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The only module that imports rosbags, and the only one that uses its internals.

rosbags is imported when the first bag is opened, since it takes 0.2 s. Beside its public writer
and type store we rely on internals that setup.py therefore bounds to one minor
version: the named tuples `Connection` and `Qos`, which our readers fill as rosbags does.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
import re
from typing import Any, Literal, TYPE_CHECKING

from surfel_mapper.bags.topics import SAME_AS
from surfel_mapper.errors import DependencyError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection as Connection
    from rosbags.interfaces import Qos
    from rosbags.rosbag2 import Writer
    from rosbags.typesys.store import Typestore as Typestore

TRANSIENT_LOCAL = re.compile(r'durability:\s*(1|transient_local)\b', re.IGNORECASE)
"""Durability of a latched topic in the YAML of a bag: a number or a name, by its version."""

TYPE_HASH = re.compile(r'RIHS01_[0-9a-f]{64}')
"""Hash of a message type, REP 2016."""

BAG_VERSION: Literal[9] = 9
"""Version of metadata.yaml that rosbag2 of Jazzy writes."""


MAX_DEFINITION = 1 << 15
"""Limit of a definition that rosbags parses, characters; it takes 6 us for each."""


MAX_VALUES = 1000
"""Limit of the values that each message of a ROS 1 type has; rosbags unrolls them."""


def import_rosbags() -> Any:
    """Return rosbags."""
    try:
        import rosbags.rosbag2
    except ImportError as error:
        raise DependencyError(
            f'rosbags cannot be loaded ({error}). It knows the types of the messages in bags; '
            'install it with `pip install rosbags`'
        ) from error
    return rosbags


def ros2_connection(
    key: int,
    topic: str,
    type_: str,
    owner: Any,
    *,
    encoding: str,
    qos: str,
    definition: tuple[str, str] = ('', ''),
    digest: str = '',
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
    digest : str
        Text with the hash of the type, from ROS 2 Iron on.

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
    found = TYPE_HASH.search(digest)
    ext = ConnectionExtRosbag2(encoding, profiles)
    return Connection(key, topic, type_, stated, found[0] if found else '', 0, ext, owner)


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


def is_same(a: Connection, b: Connection) -> bool:
    """Return whether two connections have the same topic, type and serialisation."""
    return (a.topic, a.msgtype, is_cdr(a)) == (b.topic, b.msgtype, is_cdr(b))


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


def has_legal_names(connection: Connection) -> bool:
    """Return whether topic and type have names without control characters; else it is damage."""
    return connection.topic.isprintable() and connection.msgtype.isprintable()


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


@cache
def jazzy_types() -> Typestore:
    """Return rosbags' message types of ROS 2 Jazzy; made once, since that takes 0.2 s."""
    from rosbags.typesys import get_typestore, Stores

    return get_typestore(Stores.ROS2_JAZZY)


def ros1_types(connection: Connection) -> Typestore:
    """Return the message types of the definition in a ROS 1 connection; ValueError if too long."""
    from rosbags.typesys import get_typestore, Stores

    store = get_typestore(Stores.EMPTY)
    store.register(_parsed(connection))
    _num_values(store, connection.msgtype, {})
    return store


def ros2_hash(connection: Connection) -> str:
    """
    Return the hash of the type of a ROS 2 connection, from the bag or else of its definition.

    No code is generated from the definition. IDL is not parsed: rosbags took over 8 minutes for
    five pairs of brackets, one in the other. Raises any exception if there is no hash.
    """
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import get_typestore, Stores

    if connection.digest:
        return connection.digest
    if connection.msgdef.format is not MessageDefinitionFormat.MSG:
        raise ValueError('a definition as IDL without the hash of the type')
    store = get_typestore(Stores.EMPTY)
    store.fielddefs = {**jazzy_types().fielddefs, **_parsed(connection)}
    return store.hash_rihs01(connection.msgtype)


def _parsed(connection: Connection) -> Any:
    """Return the fields of the types in a definition; raise ValueError if it is too long."""
    from rosbags.typesys import get_types_from_msg

    size = len(connection.msgdef.data)
    if size > MAX_DEFINITION:
        raise ValueError(f'a definition of {size} characters, expected at most {MAX_DEFINITION}')
    return get_types_from_msg(connection.msgdef.data, connection.msgtype)


def _num_values(store: Typestore, name: str, known: dict[str, int]) -> int:
    """
    Return the least number of values in a message of a type; an array of numbers counts as one.

    Raises ValueError if there are over MAX_VALUES, or if a type contains itself or one without
    values: then the bytes of a message do not bound the steps of reading it.
    """
    from rosbags.interfaces import Nodetype

    known[name] = number = 0  # while it is open, so that it is refused inside of itself
    fields: Any = store.fielddefs[name][1]
    for field, (kind, content) in fields:
        length = int(field != 'structure_needs_at_least_one_member')  # rosbags', in no message
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            is_fixed = kind == Nodetype.ARRAY
            (kind, content), length = content[0], content[1] if is_fixed else 1
        each = 1
        if kind == Nodetype.NAME:
            each = known[content] if content in known else _num_values(store, content, known)
            if not each:
                raise ValueError(f'{name}: {field} is of a type without values, or of itself')
        else:
            length = min(length, 1)
        number += length * each
    if number > MAX_VALUES:
        raise ValueError(f'{name}: {number} values, expected at most {MAX_VALUES}')
    known[name] = number
    return number


def new_writer(directory: Path, storage: str) -> Writer:
    """Return rosbags' writer of a new bag, not yet open; storage is mcap or sqlite3."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    return Writer(directory, version=BAG_VERSION, storage_plugin=StoragePlugin[storage.upper()])
