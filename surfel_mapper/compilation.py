# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Progress of compiling, and a clock that stands still meanwhile.

A kernel is compiled when it is called for the first time on a machine, which takes .1 to 3 s. The
package ``kernels`` reports each compilation here. This module imports no numba, so that counters
and the command line can read it at no cost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
import gc
import logging
import threading
from time import perf_counter
from typing import NamedTuple

ONCE = 'compiling kernels, once on this machine'

AGAIN_S = 10.0
"""Time after which a stage that still compiles is announced again, s."""

_log = logging.getLogger(__name__)


class CompileStage(NamedTuple):
    """A call that may compile kernels, and its name for messages."""

    name: str
    call: Callable[[], object]


class Progress:
    """
    State of the compilations of this process.

    Attributes
    ----------
    num_kernels : int
        Number of kernels compiled so far, those loaded from the cache not included.
    ended_s : float
        Time during which any thread compiled, until the last time that none did, s.
    stage : str
        The stage that the caller is in, such as ``2 of 5 (removing scans)``; empty without.

    """

    def __init__(self) -> None:
        self.num_kernels = 0
        self.stage = ''
        self._announced: str | None = None
        self._due_s = 0.0
        self.ended_s = 0.0
        self._start = 0.0
        self._depth = 0
        self._collects_garbage = True
        self._lock = threading.Lock()

    def begin(self) -> None:
        """
        Note that a kernel, or a function that one calls, begins to compile; announce it.

        No garbage is collected until it is compiled: that takes an eighth of the time and finds
        little, because the compiler keeps most of its objects to the end.
        """
        with self._lock:
            self._depth += 1
            if self._depth > 1:
                return
            self._collects_garbage = gc.isenabled()
            gc.disable()
            self._start = perf_counter()
            self.num_kernels += 1
            is_first, is_new = self._announced is None, self._announced != self.stage
            self._announced = self.stage
            is_due = self._start >= self._due_s and not is_new
        if is_due or (is_new and (self.stage or is_first)):
            self._due_s = self._start + AGAIN_S
            is_shown = _log.isEnabledFor(logging.INFO) or not is_first
            so_far = f', {self.num_kernels} kernels so far' if is_due else ''
            _log.log(logging.INFO if is_shown else logging.WARNING, f'{self.text}{so_far}')

    def end(self) -> None:
        """Note the end of what ``begin`` reported."""
        with self._lock:
            self._depth -= 1
            if self._depth == 0:
                if self._collects_garbage:
                    gc.enable()
                self.ended_s += perf_counter() - self._start

    @property
    def is_active(self) -> bool:
        """Whether a kernel is being compiled."""
        return self._depth > 0

    @property
    def text(self) -> str:
        """The line that tells users of it, with the stage."""
        return f'{ONCE}: {self.stage}' if self.stage else ONCE

    @property
    def seconds(self) -> float:
        """Time during which any thread compiled, s."""
        with self._lock:
            return self.ended_s + (perf_counter() - self._start if self._depth else 0.0)


PROGRESS = Progress()
"""State of this process."""


def clock() -> float:
    """Return the time in s of a clock that stands still while a thread compiles."""
    return perf_counter() - PROGRESS.seconds


@contextmanager
def stage(number: int, total: int, name: str) -> Iterator[None]:
    """
    Announce kernels that are compiled in a with-block as stage ``number`` of ``total``.

    In the block of another stage nothing changes.
    """
    if PROGRESS.stage:
        yield
        return
    PROGRESS.stage = f'{number} of {total} ({name})'
    try:
        yield
    finally:
        PROGRESS.stage = ''


def run_stages(stages: Sequence[CompileStage]) -> None:
    """Call the stages in order; say at the end how long compiling took, if any kernel was."""
    num_kernels, seconds = PROGRESS.num_kernels, PROGRESS.seconds
    for number, (name, call) in enumerate(stages, start=1):
        with stage(number, len(stages), name):
            call()
    num = PROGRESS.num_kernels - num_kernels
    if num and not PROGRESS.stage:
        _log.info('%d kernels compiled in %.1f s', num, PROGRESS.seconds - seconds)
