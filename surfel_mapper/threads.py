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

import atexit
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager, suppress
from functools import cache, partial
import itertools
import os
from queue import Empty, SimpleQueue
import sys
import threading
from typing import Any, TypeVar

import numpy as np

from surfel_mapper.kernels.sharing import watch

Part = TypeVar('Part')

Result = TypeVar('Result')

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


AWAKE_TURNS = 50_000
"""Times that a thread without work looks for some before it sleeps, and one that waits for a job
for its end: about 0.3 ms. Waking a core takes 25 us on a virtual machine, and up to 100 us from
the deeper sleep of others; a scan is handed over several times."""

SETTLING_TURNS = 1000
"""Times that a thread goes on looking, about 6 us: the one that it waited for still has Python's
lock, and a thread that finds the lock taken goes to sleep."""


class Signal:
    """
    A number that threads count up while others, for a while, look for a change.

    A hint: threads that may not miss a change have to wait for something else then.

    Parameters
    ----------
    turns : int
        Number of times to look.

    """

    def __init__(self, turns: int) -> None:
        self._count = np.zeros(1, np.int64)
        self._turns = turns

    def send(self) -> None:
        """Let those who look for a change find one."""
        self._count[0] += 1

    def seen(self) -> int:
        """Return the number now, to be read before testing what it tells of."""
        return int(self._count[0])

    def changes(self, seen: int) -> bool:
        """Look for another number than the one seen; return whether there was one in time."""
        changed, _ = watch(self._count, seen, self._turns, SETTLING_TURNS)
        return bool(changed)


class Job(Future[Result]):
    """
    A call for a helper, and what becomes of it.

    Parameters
    ----------
    call : callable without arguments
        Forgotten once the job is done or cancelled, as it may hold arrays that are to grow.
    ended : Signal
        Sent when the job is done.

    """

    def __init__(self, call: Callable[[], Result], ended: Signal) -> None:
        super().__init__()
        self._call: Callable[[], Result] | None = call
        self._ended = ended

    def cancel(self) -> bool:
        """Cancel the call unless it has begun; return whether it is cancelled."""
        cancelled = super().cancel()
        if cancelled:
            self._call = None
        return cancelled

    def do(self) -> None:
        """Make the call, unless it was cancelled."""
        if not self.set_running_or_notify_cancel():
            return
        call, self._call = self._call, None
        assert call is not None
        ended = self._ended
        try:
            result = call()
        except BaseException as error:
            del call
            self.set_exception(error)
            del self  # the error keeps this frame, and the job the error
        else:
            del call  # before the result is there: who waits for it may want to grow an array
            self.set_result(result)
        ended.send()

    def result(self, timeout: float | None = None) -> Result:
        """Return the result as any future does, but stay awake at first."""
        self.await_soon()
        try:
            return super().result(timeout)
        finally:
            del self  # an error that is raised keeps this frame, and the job the error

    def await_soon(self) -> None:
        """Wait for the end, but no longer than it is worth to stay awake."""
        is_near = True
        while is_near:
            seen = self._ended.seen()
            is_near = not self.done() and self._ended.changes(seen)


class Helpers:
    """
    Threads that do work for others; they start with the first job and end with the process.

    Threads without work stay awake for a while, and so do those that wait for a job. With a pool
    of the standard library, where both sleep at once, a job that did nothing took 85 us on two
    cores of a virtual machine; here it takes 25.

    Parameters
    ----------
    num : int
        Number of threads.

    """

    def __init__(self, num: int) -> None:
        turns = AWAKE_TURNS if num < usable_cores() else 0  # else others need the core
        self._posted, self._ended = Signal(turns), Signal(turns)
        self._jobs: SimpleQueue[Job[Any] | None] = SimpleQueue()
        self._starting = threading.Lock()
        self._threads = [
            threading.Thread(target=self._work, name=f'surfel_mapper_{i}', daemon=True)
            for i in range(num)
        ]

    def submit(self, work: Callable[..., Result], /, *arguments: Any) -> Job[Result]:
        """Let a thread call ``work`` with the arguments."""
        if self._threads[-1].ident is None:
            self._start()
        job = Job(partial(work, *arguments), self._ended)
        self._jobs.put(job)
        self._posted.send()
        return job

    def _start(self) -> None:
        """Start the threads that have not been, also after one could not be."""
        with self._starting:
            for thread in self._threads:
                if thread.ident is None:
                    thread.start()
            atexit.register(self._end)

    def _work(self) -> None:
        """Do jobs, in the order in which they came, until there is none instead of one."""
        while job := self._next():
            job.do()
            del job  # it keeps the result

    def _next(self) -> Job[Any] | None:
        """Wait for a job."""
        while True:
            seen = self._posted.seen()
            with suppress(Empty):
                return self._jobs.get_nowait()
            if not self._posted.changes(seen):
                return self._jobs.get()

    def _end(self) -> None:
        """End the threads after the jobs that are left: none may run while Python ends."""
        for _ in self._threads:
            self._jobs.put(None)
        self._posted.send()
        for thread in self._threads:
            thread.join()


@cache
def pool(threads: int) -> Helpers | None:
    """Return the pool of threads beside the caller's own, shared by all; None for one thread."""
    return Helpers(threads - 1) if threads > 1 else None


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
    try:
        helping.extend(helpers.submit(work) for _ in range(threads - 1))
        work()
    finally:
        begun = [helper for helper in helping if not helper.cancel()]
        wait_for(begun)
    for helper in begun:
        helper.result()


def wait_for(begun: list[Job[object]]) -> None:
    """Wait until other threads have ended, even after Ctrl-C: callers then undo the work."""
    interrupt = None
    while True:
        try:
            for job in begun:
                job.await_soon()
            if not all(job.done() for job in begun):
                wait(begun)
            break
        except KeyboardInterrupt as error:
            interrupt = error
    if interrupt is not None:
        raise interrupt
