# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Progress of long work on stderr, and stopping it with Ctrl-C or SIGTERM.

A bar with rate and time left on a terminal; elsewhere, as in a log, a plain line every 10 s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import signal
import sys
import threading
import time
from types import FrameType

EVERY_S = 10.0
"""Time between plain lines, s."""

REPEAT_S = 1.0
"""A SIGTERM that follows another within this time is the same, s."""


@contextmanager
def progress(verb: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """
    Yield a function that shows the progress towards a total.

    Parameters
    ----------
    verb : str
        Start of the lines.
    unit : str
        Name of one piece of the work.

    """
    if not sys.stderr.isatty():
        yield Lines(verb, unit).show
        return
    from tqdm import tqdm
    from tqdm.contrib.logging import logging_redirect_tqdm

    with logging_redirect_tqdm(), tqdm(unit=unit, leave=False) as bar:

        def show(done: int, total: int) -> None:
            bar.total = max(total, done)
            bar.update(done - bar.n)

        yield show


class Lines:
    """Progress as plain lines; the clock starts when the first piece of work is done."""

    def __init__(self, verb: str, unit: str) -> None:
        self._verb, self._unit = verb, unit
        self._start: tuple[float, int] | None = None
        self._last = 0.0

    def show(self, done: int, total: int) -> None:
        """Print the progress, if the last line is old enough."""
        clock_s = time.monotonic()
        if self._start is None:
            self._start, self._last = (clock_s, done), clock_s
        start, first_done = self._start
        if clock_s - self._last < EVERY_S or done == first_done:
            return
        self._last = clock_s
        rate = (done - first_done) / (clock_s - start)
        left_s = max(total - done, 0) / rate
        print(
            f'surfel-mapper {self._verb}: {done} of {max(total, done)} {self._unit}s, '
            f'{rate:.1f} {self._unit}s/s, {left_s:.0f} s left',
            file=sys.stderr,
            flush=True,
        )


@contextmanager
def stopped_by_interrupt() -> Iterator[Callable[[], bool]]:
    """
    Yield a function that returns whether Ctrl-C or SIGTERM came; a second Ctrl-C interrupts.

    Mapping can thus end between two scans and its result be written. Outside of the main thread
    signals cannot be caught, and nothing changes.
    """
    noted: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        if not noted:
            noted.append(number)
        elif signal.SIGINT in (number, *noted):  # `timeout` sends SIGTERM twice
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    handlers = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(noted)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


@contextmanager
def interrupted_by_sigterm(*, ends_process: bool = False) -> Iterator[None]:
    """
    Raise KeyboardInterrupt at SIGTERM in a block, so that temporary files are removed.

    Parameters
    ----------
    ends_process : bool
        The process ends after the block: SIGTERM is not handled as before again.

    """
    due_s = 0.0

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        nonlocal due_s
        if time.monotonic() >= due_s:  # `timeout` sends SIGTERM twice
            due_s = time.monotonic() + REPEAT_S
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous_handler = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        if not (ends_process and due_s):
            signal.signal(signal.SIGTERM, previous_handler)
