# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Decoders of the message types of a bag: rosbags' definitions of Jazzy, or those in a ROS 1 bag.

In a ROS 2 bag, definitions of other types are copied with their messages, not used for decoding.
A definition is parsed once, also if it is wrong: rosbags takes 5 ms for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from surfel_mapper.bags._rosbags import (
    is_readable,
    jazzy_types,
    ros1_types,
    ros2_hash,
    type_name,
)

if TYPE_CHECKING:
    from surfel_mapper.bags._rosbags import Connection, Typestore


class Decoders:
    """
    Type store and name of each message type, made when it is first asked for.

    Parameters
    ----------
    connections : callable
        Returns the connections of the bag, with their definitions.
    is_ros1 : bool
        Whether it is a ROS 1 bag.

    """

    def __init__(self, connections: Callable[[], Iterable[Connection]], *, is_ros1: bool) -> None:
        self._connections, self._is_ros1 = connections, is_ros1
        self._decoders: dict[str, tuple[Typestore, str] | Exception] = {}

    def find(self, type_: str) -> tuple[Typestore, str]:
        """Return the type store of a type, and its name there, or raise the error of its text."""
        if type_ not in self._decoders:
            try:
                self._decoders[type_] = self._new(type_)
            except Exception as error:  # of a definition, which is parsed once
                self._decoders[type_] = error
        decoder = self._decoders[type_]
        if isinstance(decoder, Exception):
            raise decoder.with_traceback(None)  # or it grows by the frames of each call
        return decoder

    def definition(self, type_: str) -> tuple[str, str] | None:
        """
        Return text and hash of the definition of a type in a ROS 2 bag; None for types of Jazzy.

        Raises any exception if there is no definition, or one that cannot be parsed.
        """
        if type_ in jazzy_types().fielddefs:
            return None
        connection = self._connection(type_)
        if not is_readable(connection):
            raise ValueError('its messages are not CDR')
        if not connection.msgdef.data:
            raise ValueError('the bag has no definition of it')
        return connection.msgdef.data, ros2_hash(connection)

    def _new(self, type_: str) -> tuple[Typestore, str]:
        """Return a decoder."""
        if not self._is_ros1:
            return jazzy_types(), type_
        connection = self._connection(type_)
        return ros1_types(connection), connection.msgtype

    def _connection(self, type_: str) -> Connection:
        """Return the first connection of a type; raise KeyError if there is none."""
        for connection in self._connections():
            if type_name(connection) == type_:
                return connection
        raise KeyError(type_)
