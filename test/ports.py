# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Ports for servers under test that no other program of the machine takes meanwhile."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import socket


@contextmanager
def reserved_pair(address: str = '127.0.0.1') -> Iterator[int]:
    """
    Yield the first of two neighbouring ports, reserved until the block ends.

    A port that is bound, but not listened at, is given to no socket that asks for any port. A
    server that reuses addresses, as rerun and ``check_free`` do, can still bind it.
    """
    while True:
        with reusing() as first, reusing() as second:
            first.bind((address, 0))
            port = int(first.getsockname()[1])
            try:
                second.bind((address, port + 1))
            except (OSError, OverflowError):
                continue
            yield port
            return


def reusing() -> socket.socket:
    """Return a socket that shares its port with a server that reuses addresses."""
    created = socket.socket()
    created.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    return created
