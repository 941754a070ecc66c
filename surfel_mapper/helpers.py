# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Helpers: threads to which work is handed over in 20 us, several times a scan.

They stay awake for a while when they wait, and Ctrl-C at any place leaves them in order.
"""

from __future__ import annotations

import atexit
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from queue import Empty, SimpleQueue
import threading
from typing import Any, Generic, TypeVar

import numpy as np

from surfel_mapper.kernels.sharing import watch

Result = TypeVar('Result')

AWAKE_TURNS = 50_000
"""Times that a thread looks before it sleeps, for work or for the end of a job: about 0.3 ms.
Waking a core takes 25 us on a virtual machine, and up to 100 us from the deeper sleep of others;
a scan is handed over several times."""

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
        """Let those who look for a change find one, if there is memory for a number."""
        with suppress(MemoryError):
            self._count[0] += 1

    def seen(self) -> int:
        """Return the number now; read it before you check whether there is something to do."""
        return int(self._count[0])

    def changes(self, seen: int) -> bool:
        """Look for another number than the one seen; return whether there was one in time."""
        changed, _ = watch(self._count, seen, self._turns, SETTLING_TURNS)
        return bool(changed)


class Job(Generic[Result]):
    """
    A call for a helper, and what becomes of it.

    Unlike a future of the standard library it survives Ctrl-C at any place: each step may be
    repeated, and none leaves a lock that is held.

    Parameters
    ----------
    call : callable without arguments
        Forgotten once the job is done or cancelled, as it may hold arrays that are to grow.
    ended : Signal
        Sent when the job is done.

    """

    def __init__(self, call: Callable[[], Result], ended: Signal) -> None:
        self._call: Callable[[], Result] | None = call
        self._ended = ended
        self._owner = {'': ''}  # with room for one more: taking the call needs no memory
        self._running = threading.Lock()
        self._running.acquire()
        self._is_done = False
        self._error: BaseException | None = None
        self._value: Result

    def _is_taken_by(self, who: str) -> bool:
        """Take the call for someone unless another one has; return whether they have it now."""
        return self._owner.setdefault('owner', who) == who  # one step, however often repeated

    @property
    def is_done(self) -> bool:
        """Whether the call has ended."""
        return self._is_done

    def cancel(self) -> bool:
        """Cancel the call unless it has begun; return whether it is cancelled."""
        if not self._is_taken_by('caller'):
            return False
        self._call = None
        return True

    def do(self) -> None:
        """Make the call, unless it was cancelled."""
        if not self._is_taken_by('helper'):
            return
        call, self._call = self._call, None
        assert call is not None
        try:
            self._value = call()
        except BaseException as error:
            self._error = error
        del call  # before others know that it is done: they may want to grow an array
        self._is_done = True
        self._running.release()
        self._ended.send()
        del self  # an error keeps this frame, and the job the error

    def wait(self) -> None:
        """Wait for the end of the call, awake at first."""
        with suppress(MemoryError):  # sleeping needs none
            is_near = True
            while is_near:
                seen = self._ended.seen()
                is_near = not self._is_done and self._ended.changes(seen)
        if not self._is_done and self._running.acquire():
            self._running.release()

    def result(self) -> Result:
        """Wait for the end of the call; return its result or raise its error."""
        self.wait()
        try:
            self.check()
            return self._value
        finally:
            del self  # an error keeps this frame

    def check(self) -> None:
        """Raise the error of the call, if it had one."""
        try:
            if self._error is not None:
                raise self._error
        finally:
            del self  # an error keeps this frame


class Helpers:
    """
    Threads that do work for others; they start with the first job and end with the process.

    Threads without work stay awake for a while, and so do those that wait for a job. With a pool
    of the standard library, where both sleep at once, a job that did nothing took 85 us on two
    cores of a virtual machine; here it takes 20.

    Parameters
    ----------
    num : int
        Number of threads.
    stay_awake : bool
        Whether threads that wait do so; without a core for each others need it.

    """

    def __init__(self, num: int, *, stay_awake: bool = True) -> None:
        self._num = num
        turns = AWAKE_TURNS if stay_awake else 0
        self._posted, self._ended = Signal(turns), Signal(turns)
        self._jobs: SimpleQueue[Job[Any] | None] = SimpleQueue()
        self._starting = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._is_over = False
        atexit.register(self._end)

    def submit(self, work: Callable[..., Result], /, *arguments: Any) -> Job[Result]:
        """Let a thread call ``work`` with the arguments."""
        job = self.job(partial(work, *arguments))
        self.give(job)
        return job

    def job(self, call: Callable[[], Result]) -> Job[Result]:
        """Return a job that no thread has yet."""
        return Job(call, self._ended)

    def give(self, job: Job[Any]) -> None:
        """Let a thread do a job; at the end of the process the caller does it."""
        if len(self._threads) < self._num:
            self._start()
        if self._is_over:
            job.do()
            return
        self._jobs.put(job)
        self._posted.send()

    def _start(self) -> None:
        """Start the threads that are not there yet; it may be that another could not start."""
        with self._starting:
            while len(self._threads) < self._num:
                name = f'surfel_mapper_{len(self._threads)}'
                thread = threading.Thread(target=self._work, name=name, daemon=True)
                thread.start()
                self._threads.append(thread)

    def _work(self) -> None:
        """Do jobs, in the order in which they came, until there is none instead of one."""
        while job := self._next():
            job.do()
            del job  # it keeps the result

    def _next(self) -> Job[Any] | None:
        """Wait for a job, awake at first."""
        with suppress(MemoryError):  # sleeping needs none
            is_near = True
            while is_near:
                seen = self._posted.seen()
                with suppress(Empty):
                    return self._jobs.get_nowait()
                is_near = self._posted.changes(seen)
        return self._jobs.get()

    def _end(self) -> None:
        """End the threads after the jobs that are left: none may run while Python ends."""
        self._is_over = True
        for _ in self._threads:
            self._jobs.put(None)
        self._posted.send()
        for thread in self._threads:
            thread.join()
