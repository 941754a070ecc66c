# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Threads: process the rows of arrays with several threads.

The kernels release Python's lock, so plain threads suffice. Every row is computed independently,
so the result has the same bits for any number of threads. Stands alone: filters, map and models
share the pool.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
import itertools
import os
import sys
import threading

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
    """
    Do the work on all rows, with the help of idle threads of the pool.

    The calling thread takes parts until none is left, so it never waits for a thread that is busy
    with other work, only for parts that another thread has begun.
    """
    helpers = pool(threads)
    if helpers is None:
        work(slice(0, num_rows))
        return
    parts = iter(split(num_rows, PARTS * threads))  # shared; Python's lock protects it

    def take_parts() -> None:
        for part in parts:
            work(part)

    helping = [helpers.submit(take_parts) for _ in range(threads - 1)]
    take_parts()
    for helper in helping:
        if not helper.cancel():
            helper.result()
