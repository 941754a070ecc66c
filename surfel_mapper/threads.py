# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Threads: process the rows of arrays with several threads.

The kernels release Python's lock, so plain threads suffice. Every row is computed independently,
so the result has the same bits for any number of threads. Stands alone: filters, map and models
share the pool.

Threads that receive messages have to run within a third of a millisecond: Fast DDS sends a cloud
of 4 MiB in 65 fragments in one millisecond through a buffer of eight. A fragment that is
overwritten is sent again 10 ms later, and once a publisher has repeated 2 GiB (45 s of 20 Hz) an
error in its byte count (Fast DDS 2.14) delays repetitions by up to half a second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from functools import cache
import itertools
import os
import sys
import threading
from typing import TypeVar

Part = TypeVar('Part')

PARTS = 4
"""Number of parts per thread into which rows are divided; an idle thread takes the next part."""


BACKGROUND_NICE = 10
"""Niceness added to threads in the background: of a busy core they get a tenth."""


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def yield_to_others() -> None:
    """Lower the priority of the calling thread; does nothing but on Linux."""
    if sys.platform == 'linux':  # elsewhere threads have no priority of their own
        thread = threading.get_native_id()
        nice = os.getpriority(os.PRIO_PROCESS, thread) + BACKGROUND_NICE
        os.setpriority(os.PRIO_PROCESS, thread, nice)


REAL_TIME_PRIORITY = 1
"""The lowest real-time priority of Linux: above ordinary threads, below control loops."""


@contextmanager
def real_time_threads() -> Iterator[None]:
    """
    Give threads started in a with-block, of C libraries too, real-time priority if permitted.

    They inherit it from the calling thread, which has it in the block only. Linux permits it to
    root, with the capability SYS_NICE, and with a limit of at least 1 (``ulimit -r``). Otherwise,
    and in a process that was started with another policy, this does nothing.
    """
    ordinary = sys.platform == 'linux' and os.sched_getscheduler(0) == os.SCHED_OTHER
    if ordinary:
        with suppress(OSError):  # not permitted
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(REAL_TIME_PRIORITY))
    try:
        yield
    finally:
        if ordinary:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@cache
def pool(threads: int) -> ThreadPoolExecutor | None:
    """Return the pool of threads beside the caller's own, shared by all; None for one thread."""
    if threads < 2:
        return None
    return ThreadPoolExecutor(threads - 1, thread_name_prefix='surfel_mapper')


def split(num_rows: int, parts: int) -> list[slice]:
    """Return consecutive slices of nearly equal length that cover num_rows rows."""
    bounds = [num_rows * part // parts for part in range(parts + 1)]
    return [slice(first, last) for first, last in itertools.pairwise(bounds)]


def share(work: Callable[[slice], object], num_rows: int, threads: int) -> None:
    """Do the work on all rows, in parts of nearly equal length; see ``share_parts``."""
    parts = PARTS * threads if threads > 1 else 1
    share_parts(work, split(num_rows, parts), threads)


def share_parts(work: Callable[[Part], object], parts: Iterable[Part], threads: int) -> None:
    """
    Do the work on all parts, with the help of idle threads of the pool.

    The calling thread takes parts until none is left, so it never waits for a thread that is busy
    with other work, only for parts that another thread has begun, also if a part fails. Of several
    errors its own is raised, or that of the first helper.
    """
    helpers = pool(threads)
    helping: list[Future[None]] = []
    left = iter(parts)  # shared; Python's lock protects it

    def take_parts() -> None:
        for part in left:
            work(part)

    try:
        if helpers is not None:
            helping.extend(helpers.submit(take_parts) for _ in range(threads - 1))
        take_parts()
    finally:
        begun = [helper for helper in helping if not helper.cancel()]
        wait_for(begun)
    for helper in begun:
        helper.result()


def wait_for(begun: list[Future[None]]) -> None:
    """Wait until other threads have ended, even after Ctrl-C: callers then undo the work."""
    interrupt = None
    while True:
        try:
            wait(begun)
            break
        except KeyboardInterrupt as error:
            interrupt = error
    if interrupt is not None:
        raise interrupt
