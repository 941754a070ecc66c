# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the main thread is asked to do while the node runs.

The main thread makes the transitions of the life cycle, because only there a signal interrupts
them: compiling kernels takes half a minute the first time. Other threads put requests in here,
or an error that ends the node.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from queue import Empty, SimpleQueue
import threading
from typing import NamedTuple

PATIENCE_S = 0.2
"""A signal that comes just before a wait does not end it, so none lasts longer."""


class Request(NamedTuple):
    """A function to be called, and who waits for what it returns."""

    action: Callable[[], bool]
    done: Future[bool]


class Inbox:
    """Requests and errors for the main thread."""

    def __init__(self) -> None:
        """Make an empty box."""
        self._items: SimpleQueue[Request | BaseException] = SimpleQueue()
        self._lock = threading.Lock()
        self._closed = False

    def ask(self, action: Callable[[], bool]) -> Future[bool]:
        """Have the main thread call a function; false is the answer after the end."""
        request = Request(action, Future())
        with self._lock:
            if self._closed:
                request.done.set_result(False)
            else:
                self._items.put(request)
        return request.done

    def fail(self, error: BaseException) -> None:
        """Have the main thread raise an error."""
        self._items.put(error)

    def serve(self, check: Callable[[], None]) -> None:
        """
        Do what is asked for until there is an error, and raise it.

        Parameters
        ----------
        check : callable
            Called before every wait; raises if there is no point in waiting.

        """
        while True:
            check()
            try:
                item = self._items.get(timeout=PATIENCE_S)
            except Empty:
                continue
            if isinstance(item, BaseException):
                raise item
            done = False
            try:
                done = item.action()
            finally:
                item.done.set_result(done)

    def close(self) -> None:
        """Answer false to what is still asked for, and from now on at once."""
        with self._lock:
            self._closed = True
        while not self._items.empty():
            item = self._items.get()
            if isinstance(item, Request):
                item.done.set_result(False)
