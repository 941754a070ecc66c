# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Decoders of the message types of a bag: rosbags' definitions of Jazzy, or those in a ROS 1 bag.

In a ROS 2 bag, definitions of other types are copied with their messages, not used for decoding.
A definition is parsed once, also if it is wrong, and all together are limited by the size of the
bag: rosbags takes 5 ms for each type and 6 us for a character of its fields, so a bag of 1 MB with
5,000 types took 26 s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from surfel_mapper.bags._rosbags import (
    is_cdr,
    jazzy_types,
    ros1_types,
    ros2_hash,
    type_name,
)

if TYPE_CHECKING:
    from surfel_mapper.bags._rosbags import Connection, Typestore

MAX_DEFINED, LEAST_DEFINITION, BYTES_EACH = 1 << 15, 1600, 100
"""Limit of the definitions that are parsed of a small bag, characters, what each counts at least,
and bytes of a bag for each further character."""


class Decoders:
    """
    Type store and name of each message type, made when it is first asked for.

    Parameters
    ----------
    connections : callable
        Returns the connections of the bag, with their definitions.
    size : int
        Bytes of the bag.
    is_ros1 : bool
        Whether it is a ROS 1 bag.

    """

    def __init__(
        self, connections: Callable[[], Iterable[Connection]], size: int, *, is_ros1: bool
    ) -> None:
        self._connections, self._is_ros1 = connections, is_ros1
        self._left = MAX_DEFINED + size // BYTES_EACH
        self._by_type: dict[str, Connection] | None = None
        self._found: dict[str, tuple[Typestore, str] | Exception] = {}

    def find(self, type_: str) -> tuple[Typestore, str]:
        """Return the type store of a type, and its name there, or raise the error of its text."""
        if type_ not in self._found:
            try:
                self._found[type_] = self._new(type_)
            except Exception as error:  # of a definition, which is parsed once
                self._found[type_] = error
        found = self._found[type_]
        if isinstance(found, Exception):
            raise found.with_traceback(None)  # or it grows by, and keeps, the frames of each call
        return found

    def definition(self, type_: str) -> tuple[str, str] | None:
        """
        Return text and hash of the definition of a type in a ROS 2 bag; None for types of Jazzy.

        Raises any exception if there is no definition, or one that cannot be parsed.
        """
        if type_ in jazzy_types().fielddefs:
            return None
        found = self._connection(type_)
        if not is_cdr(found):
            raise ValueError('its messages are not CDR')
        if not found.msgdef.data:
            raise ValueError('the bag has no definition of it')
        if not found.digest:
            self._charge(found)
        return found.msgdef.data, ros2_hash(found)

    def _new(self, type_: str) -> tuple[Typestore, str]:
        """Return a decoder; raise ValueError if the definitions are too long together."""
        if not self._is_ros1:
            return jazzy_types(), type_
        found = self._connection(type_)
        self._charge(found)
        return ros1_types(found), found.msgtype

    def _connection(self, type_: str) -> Connection:
        """Return a connection of a type; the connections are sorted once."""
        if self._by_type is None:
            self._by_type = {type_name(c): c for c in reversed([*self._connections()])}
        return self._by_type[type_]

    def _charge(self, connection: Connection) -> None:
        """Count a definition to be parsed; raise ValueError if all are too long together."""
        self._left -= LEAST_DEFINITION + len(connection.msgdef.data)
        if self._left < 0:
            raise ValueError('the definitions of the bag are too long together for its size')
