# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Threads: process the rows of arrays with several threads.

The kernels release Python's lock, so plain threads suffice. Rows are computed independently, or
are sums of integers, so the result has the same bits for any number of threads. Filters, map and
models share the pool.

Threads that receive messages have to run within a third of a millisecond: Fast DDS sends a cloud
of 4 MiB in 65 fragments in one millisecond through a buffer of eight. A fragment that is
overwritten is sent again 10 ms later, and once a publisher has repeated 2 GiB (45 s of 20 Hz) an
error in its byte count (Fast DDS 2.14) delays repetitions by up to half a second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from functools import cache
import itertools
import os
from pathlib import Path
import sys
import threading

PARTS = 4
"""Number of parts per thread into which rows are divided; an idle thread takes the next part."""


BACKGROUND_NICE = 10
"""Niceness added to threads in the background: of a busy core they get a tenth."""


CGROUP_QUOTA = Path('/sys/fs/cgroup/cpu.max')
"""Processor time of a container, us a period and the period, such as ``150000 100000``; or ``max``
instead of the first."""


def usable_cores() -> int:
    """
    Return the number of cores that this process may use, and that the quota of a container fills.

    A quota of 1.5 cores fills one: beyond it all threads stand still as soon as the time of a
    period is used up. Two on one core's quota took 1.5 times as long as one, on 1.5 cores as long.
    """
    cores = len(os.sched_getaffinity(0))
    try:
        quota_us, period_us = CGROUP_QUOTA.read_text(encoding='ascii').split()
    except (OSError, ValueError):  # no limit that cgroup 2 states
        return cores
    return max(min(cores, int(quota_us) // int(period_us)), 1) if quota_us.isdigit() else cores


def yield_to_others() -> None:
    """Lower the priority of the calling thread; does nothing but on Linux."""
    if sys.platform == 'linux':  # elsewhere threads have no priority of their own
        thread = threading.get_native_id()
        nice = os.getpriority(os.PRIO_PROCESS, thread) + BACKGROUND_NICE
        os.setpriority(os.PRIO_PROCESS, thread, nice)


REAL_TIME_PRIORITY = 1
"""The lowest real-time priority of Linux: above ordinary threads, below control loops."""


def end_real_time() -> None:
    """Give the calling thread ordinary priority if it was started by ``real_time_threads``."""
    if sys.platform == 'linux':
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


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


if hasattr(os, 'register_at_fork'):
    os.register_at_fork(after_in_child=pool.cache_clear)  # threads do not follow into a child


def split(num_rows: int, number: int) -> list[slice]:
    """Return consecutive slices of nearly equal length that cover num_rows rows."""
    bounds = [num_rows * k // number for k in range(number + 1)]
    return [slice(first, last) for first, last in itertools.pairwise(bounds)]


def share(work: Callable[[slice], object], num_rows: int, threads: int) -> None:
    """
    Do the work on all rows, in slices of nearly equal length, with the threads of the pool.

    The calling thread takes slices too, and never waits for a thread that is busy with other work.
    """
    helpers = pool(threads)
    if helpers is None:
        work(slice(0, num_rows))
        return
    slices = iter(split(num_rows, PARTS * threads))  # shared: Python's lock protects it

    def take_slices() -> None:
        for rows in slices:
            work(rows)

    helping = [helpers.submit(take_slices) for _ in range(threads - 1)]
    try:
        take_slices()
    finally:
        begun = [future for future in helping if not future.cancel()]
        wait(begun)
    for future in begun:
        future.result()
