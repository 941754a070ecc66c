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

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
import itertools
import os
from pathlib import Path
import sys
import threading
from typing import TypeVar

from surfel_mapper.helpers import Helpers, Job

Part = TypeVar('Part')

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
def pool(threads: int) -> Helpers | None:
    """Return the pool of threads beside the caller's own, shared by all; None for one thread."""
    if threads < 2:
        return None
    return Helpers(threads - 1, stay_awake=threads <= usable_cores())


if hasattr(os, 'register_at_fork'):
    os.register_at_fork(after_in_child=pool.cache_clear)  # threads do not follow into a child


def split(num_rows: int, parts: int) -> list[slice]:
    """Return consecutive slices of nearly equal length that cover num_rows rows."""
    bounds = [num_rows * part // parts for part in range(parts + 1)]
    return [slice(first, last) for first, last in itertools.pairwise(bounds)]


def share(work: Callable[[slice], object], num_rows: int, threads: int) -> None:
    """Do the work on all rows, in parts of nearly equal length; see ``share_parts``."""
    parts = PARTS * threads if threads > 1 else 1
    share_parts(work, split(num_rows, parts), threads)


def share_parts(work: Callable[[Part], object], parts: Iterable[Part], threads: int) -> None:
    """Do the work on all parts, with the help of idle threads of the pool; see ``together``."""
    left = iter(parts)  # shared; Python's lock protects it

    def take_parts() -> None:
        for part in left:
            work(part)

    together(take_parts, threads)


def together(work: Callable[[], object], threads: int) -> None:
    """
    Call a function, also by idle threads of the pool; each call takes parts until none is left.

    The calling thread never waits for a thread that is busy with other work, only for parts that
    another thread has begun, also if a part fails. Of several errors its own is raised, or that of
    the first helper.
    """
    helpers = pool(threads)
    if helpers is None:
        work()
        return
    helping: list[Job[object]] = []
    failure: BaseException | None = None
    try:
        for _ in range(threads - 1):
            job = helpers.job(work)
            helping.append(job)  # before it can begin: an interrupt may come between the two
            helpers.give(job)
        work()
    finally:  # not in a function: Ctrl-C may come before its first line
        while True:
            try:
                for job in helping:
                    if not job.cancel():
                        job.wait()
                break
            except (KeyboardInterrupt, MemoryError) as error:
                failure = error
        if failure is not None:
            raise failure
    try:
        for job in helping:
            job.check()
    finally:
        del job, helping  # an error keeps this frame, and the job the error
