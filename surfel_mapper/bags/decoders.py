# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Decoders of the message types of a bag: rosbags' definitions of Jazzy, or those in a ROS 1 bag.

A definition is parsed once, also if it is wrong, and all together are limited by the size of the
bag: rosbags takes 5 ms for each type and 6 us for a character of its fields, so a bag of 1 MB with
5,000 types took 26 s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from surfel_mapper.bags._rosbags import jazzy_types, ros1_types, type_name

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
        Returns the connections of a ROS 1 bag, with their definitions.
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

    def _new(self, type_: str) -> tuple[Typestore, str]:
        """Return a decoder; raise ValueError if the definitions are too long together."""
        if not self._is_ros1:
            return jazzy_types(), type_
        if self._by_type is None:
            self._by_type = {type_name(c): c for c in reversed([*self._connections()])}
        found = self._by_type[type_]
        self._left -= LEAST_DEFINITION + len(found.msgdef.data)
        if self._left < 0:
            raise ValueError('the definitions of the bag are too long together for its size')
        return ros1_types(found), found.msgtype
