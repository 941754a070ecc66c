# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The main thread of the node: signals that end it, and the tasks that other threads hand to it.

A signal raises KeyboardInterrupt in the main thread, wherever that is. Python prints and swallows
exceptions raised in a ``__del__`` or in a function called back from C. After such a signal the
transition under way is finished, and ``check`` ends the node.

Transitions of the life cycle run in the main thread, because only there a signal can interrupt
them: compiling kernels takes half a minute the first time.

This module imports no ROS, since a signal may arrive while ROS is being imported.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from queue import Empty, SimpleQueue
import signal
import threading
from types import FrameType
from typing import Any, NamedTuple

NUMBERS = (signal.SIGINT, signal.SIGTERM)

MAX_WAIT_S = 0.2
"""A signal that arrives just before a wait does not end it; this bounds the delay."""


class Signals:
    """In a with-block, SIGINT and SIGTERM raise KeyboardInterrupt, once."""

    def __init__(self) -> None:
        self._received = False
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> Signals:
        """Install the signal handlers."""
        self._handlers = {number: signal.signal(number, self._interrupt) for number in NUMBERS}
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the previous handlers; after an interrupt, signals stay ignored."""
        if not self._received:
            for number, handler in self._handlers.items():
                signal.signal(number, handler)

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal was received."""
        if self._received:
            raise KeyboardInterrupt

    def _interrupt(self, _number: int, _frame: FrameType | None) -> None:
        """
        Interrupt the main thread, and ignore all further signals.

        A terminal and a launch file both send one; the second must not interrupt the shutdown
        that the first began.
        """
        self._received = True
        for ignored in NUMBERS:
            signal.signal(ignored, signal.SIG_IGN)
        raise KeyboardInterrupt


class Task(NamedTuple):
    """A function for the main thread, and the future that takes its result."""

    action: Callable[[], bool]
    done: Future[bool]


class TaskQueue:
    """
    Functions for the main thread to call, and errors for it to raise.

    Attributes
    ----------
    has_failed : bool
        Whether the node ends because of an error, and not of a signal.

    """

    def __init__(self) -> None:
        self.has_failed = False
        self._items: SimpleQueue[Task | BaseException] = SimpleQueue()
        self._lock = threading.Lock()
        self._closed = False

    def submit(self, action: Callable[[], bool]) -> Future[bool]:
        """Queue a function for the main thread; once closed, the result is False."""
        task = Task(action, Future())
        with self._lock:
            if self._closed:
                task.done.set_result(False)
            else:
                self._items.put(task)
        return task.done

    def fail(self, error: BaseException) -> None:
        """Queue an error for the main thread to raise."""
        self.has_failed = True
        self._items.put(error)

    def run(self, check: Callable[[], None]) -> None:
        """
        Call the queued functions until an error is queued, and raise that.

        Parameters
        ----------
        check : callable
            Called before every wait, at least every ``MAX_WAIT_S``; may raise to end the loop.

        """
        while True:
            check()
            try:
                item = self._items.get(timeout=MAX_WAIT_S)
            except Empty:
                continue
            if isinstance(item, BaseException):
                raise item
            done = False
            try:
                done = item.action()
            except Exception:  # ends the node, whose map is saved then
                self.has_failed = True
                raise
            finally:
                item.done.set_result(done)

    def close(self) -> None:
        """Answer all queued and all later tasks with False."""
        with self._lock:
            self._closed = True
        while not self._items.empty():
            item = self._items.get()
            if isinstance(item, Task):
                item.done.set_result(False)
