# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
How far a long piece of work is, on stderr, and stopping it with Ctrl-C.

On a terminal a bar with rate and time left; elsewhere, as in a log, a plain line now and then.
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
"""Between plain lines."""


@contextmanager
def progress(verb: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
    """
    Give a function that is told how much is done.

    Parameters
    ----------
    verb : str
        What lines begin with.
    total : int
        About how much there is.
    unit : str
        What is counted.

    """
    if not sys.stderr.isatty():
        yield Lines(verb, total, unit).show
        return
    from tqdm import tqdm
    from tqdm.contrib.logging import logging_redirect_tqdm

    with logging_redirect_tqdm(), tqdm(total=total, unit=unit, leave=False) as bar:

        def show(done: int) -> None:
            bar.total = max(total, done)
            bar.update(done - bar.n)

        yield show


class Lines:
    """Progress as plain lines, none within the first seconds."""

    def __init__(self, verb: str, total: int, unit: str) -> None:
        """Begin to count the time."""
        self._verb, self._total, self._unit = verb, total, unit
        self._start = self._last = time.monotonic()

    def show(self, done: int) -> None:
        """Say how far it is, if the last line is long ago."""
        now = time.monotonic()
        if now - self._last < EVERY_S or not done:
            return
        self._last = now
        rate = done / (now - self._start)
        left_s = max(self._total - done, 0) / rate
        print(
            f'surfel-mapper {self._verb}: {done} of {max(self._total, done)} {self._unit}s, '
            f'{rate:.1f} {self._unit}s/s, {left_s:.0f} s left',
            file=sys.stderr,
            flush=True,
        )


@contextmanager
def stopped_by_interrupt() -> Iterator[Callable[[], bool]]:
    """
    Give a function that tells whether Ctrl-C was pressed; pressed again, it interrupts.

    What is being mapped can so be ended between two scans and written. Outside of the main
    thread signals cannot be caught, and nothing changes.
    """
    pressed: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        if pressed:
            raise KeyboardInterrupt
        pressed.append(number)

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def finished_first() -> Iterator[None]:
    """Finish what takes a second before Ctrl-C interrupts; pressed again, it does at once."""
    with stopped_by_interrupt() as stopped:
        yield
    if stopped():
        raise KeyboardInterrupt
