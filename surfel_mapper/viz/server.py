# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The package rerun, and starting and ending its servers."""

from __future__ import annotations

from contextlib import suppress
import os
import signal
import socket
import subprocess
import sys
import time
from typing import Any

from surfel_mapper.errors import DependencyError, SurfelMapperError

LOOPBACK = '127.0.0.1'
"""Address on which servers listen; rerun's own default is every interface."""

Server = subprocess.Popen[bytes]
"""A server of rerun, with a process group of its own."""

WHOLE, LIVE = '75%', '512MiB'
"""
Memory of a server: of files and replays, which are kept whole, and of a running node, which has no
end; there it holds the last minutes, for a page that is opened later.
"""

START_S = 20.0
"""Longest wait for a server to listen, s."""


def started_server(port: int, data_port: int, memory: str) -> Server:
    """
    Return a server of a page and of its data, as soon as both ports are open.

    Beyond the memory, WHOLE or LIVE, it drops the oldest data that are not static.
    """
    command = [
        *(sys.executable, '-m', 'rerun', '--serve-web', '--bind', LOOPBACK),
        *('--hide-welcome-screen', '--port', str(data_port), '--web-viewer-port', str(port)),
        *('--server-memory-limit', memory),
    ]
    for number in (data_port, port):
        check_free(number)
    server = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        for number in (data_port, port):
            wait_for(number, server)
    except BaseException:
        end_group(server)
        raise
    return server


def import_rerun() -> Any:
    """Return the module rerun, or raise DependencyError with the command to install it."""
    try:
        import rerun
    except ImportError as error:
        raise DependencyError(
            f'rerun cannot be loaded ({error}). It shows maps and replays; install it with '
            "`pip install 'surfel_mapper[viewer]'` or `pip install rerun-sdk`"
        ) from error
    return rerun


def end_group(server: Server) -> None:
    """End a server and its children: the program rerun starts another one and waits for it."""
    with suppress(ProcessLookupError):
        os.killpg(server.pid, signal.SIGTERM)
    server.wait()


def free_port() -> int:
    """Return a port that no program listens at."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def check_free(port: int) -> None:
    """
    Raise SurfelMapperError if a program listens at a port.

    ``wait_for`` would take it for the server.
    """
    with socket.socket() as probe:
        # as servers do: connections that have just ended do not keep the port
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise not_listening(port, f'cannot listen ({error.strerror})') from error


def wait_for(port: int, server: Server) -> None:
    """Wait until a server listens at a port; raise SurfelMapperError if it does not."""
    end = time.monotonic() + START_S
    while time.monotonic() < end and server.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex((LOOPBACK, port)) == 0:
                return
        time.sleep(0.05)
    state = 'ended' if server.poll() is not None else f'did not listen within {START_S:g} s'
    raise not_listening(port, state)


def not_listening(port: int, state: str) -> SurfelMapperError:
    """Return the error of a server that does not listen at a port."""
    return SurfelMapperError(
        f'the server of rerun at {LOOPBACK}:{port} {state}; is the port free?'
    )
