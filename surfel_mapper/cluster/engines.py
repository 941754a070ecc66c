# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Who does the work: this process, local workers, or those of a Dask scheduler anywhere.

A task is a function of this package and its arguments; what it makes goes to files, what it
returns is small. So a task that a lost worker was at is simply done again by another, by Dask
itself, and several attempts leave the same files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack
import logging
import multiprocessing
from multiprocessing import forkserver
import os
import signal
import threading
import time
from typing import Any, Protocol, TypeVar

from surfel_mapper.errors import ClusterError, DependencyError

Item = TypeVar('Item')
Result = TypeVar('Result')

CONNECT_S = 20
"""A scheduler has to answer within this time."""

LOSSES = 5
"""A task at which so many workers died is given up."""

POLL_S = 0.02
"""So often it is looked whether a task is done, or no more is wanted."""

PRELOADED = ['surfel_mapper.cluster.preload', 'distributed']
"""What local workers are forked with; each of them would load it for 2 s otherwise."""

WORKER_ENVIRONMENT = {'MALLOC_ARENA_MAX': '1', 'OMP_NUM_THREADS': '1', 'MKL_NUM_THREADS': '1'}
"""
Tasks run beside the main thread of a worker, where freed memory goes back to the system at once
unless there is a single arena: every cloud would be paged in anew, which doubles the time.
"""


def never() -> bool:
    """Return that all is wanted."""
    return False


class Engine(Protocol):
    """Runs tasks."""

    @property
    def num_workers(self) -> int:
        """How many tasks run at a time."""

    def run(
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        stopped: Callable[[], bool] = never,
    ) -> Iterator[tuple[int, Result]]:
        """
        Yield the number of each item and what the function returns, as they get done.

        Once it is stopped, only what is under way gets done.
        """


class InProcess:
    """Runs one task after the other, here."""

    num_workers = 1

    def run(
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        stopped: Callable[[], bool] = never,
    ) -> Iterator[tuple[int, Result]]:
        """Yield the number of each item and what the function returns, until it is stopped."""
        for number, item in enumerate(items):
            if stopped():
                return
            yield number, function(item)


class OnDask:
    """
    Runs tasks on the workers of a Dask client.

    Parameters
    ----------
    client : distributed.Client
        Whose workers are to be used.

    """

    def __init__(self, client: Any) -> None:
        """Take a client."""
        self._client = client

    @property
    def num_workers(self) -> int:
        """How many workers there are now."""
        return max(len(self._client.scheduler_info(n_workers=-1)['workers']), 1)

    def run(
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        stopped: Callable[[], bool] = never,
    ) -> Iterator[tuple[int, Result]]:
        """
        Yield the number of each item and what the function returns, as they get done.

        Once it is stopped, only what is under way gets done: of what is not done yet, as many as
        there are workers, since tasks are begun in their order.

        Raises
        ------
        ClusterError
            If workers died at a task again and again, or the scheduler is gone.

        """
        from distributed import as_completed, CancelledError, KilledWorker

        futures = [self._client.submit(function, item, pure=False) for item in items]
        numbers = {future: number for number, future in enumerate(futures)}
        completed = as_completed(futures)
        dropped: set[Any] = set()
        try:
            while not completed.is_empty():
                if stopped() and not dropped:
                    left = [future for future in futures if future in numbers]
                    dropped = set(left[self.num_workers :])
                    self._client.cancel(list(dropped))
                if not completed.has_ready():
                    time.sleep(POLL_S)
                    continue
                for future in completed.next_batch(block=False):
                    if future not in dropped:
                        yield numbers.pop(future), future.result()
                        future.release()
        except KilledWorker as error:
            raise ClusterError(
                f'{LOSSES} workers died at the same task; is their memory large enough? {error}'
            ) from error
        except (CancelledError, OSError) as error:
            raise ClusterError(f'the scheduler is gone: {error}') from error
        finally:
            self._client.cancel(list(numbers))


def begin_workers() -> str:
    """
    Begin to load what local workers need; return by which method they are to be started.

    That goes on in a process of its own, from which workers are forked when it is done. It ends
    with this process, and until then lost workers are replaced at once.
    """
    if 'forkserver' not in multiprocessing.get_all_start_methods():
        return 'spawn'
    forkserver.set_forkserver_preload(PRELOADED)
    # libraries read it when they are loaded; a terminal sends Ctrl-C to that process too
    with environment(WORKER_ENVIRONMENT), on_interrupt(signal.SIG_IGN):
        forkserver.ensure_running()
    return 'forkserver'


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set variables of the environment for the processes that are started meanwhile."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def on_interrupt(handler: Callable[[int, Any], object] | signal.Handlers) -> Iterator[None]:
    """Have Ctrl-C do something else in a block, and in what is started there."""
    if threading.current_thread() is not threading.main_thread():
        yield  # others are not interrupted
        return
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def interrupt_held() -> Iterator[None]:
    """Hold Ctrl-C back until the end of a block: Dask cannot end a cluster that half began."""
    pressed: list[int] = []
    with on_interrupt(lambda number, _: pressed.append(number)):
        yield
    if pressed:
        raise KeyboardInterrupt


@contextmanager
def engine(workers: int | None = None, scheduler: str | None = None) -> Iterator[Engine]:
    """
    Give whatever runs tasks, and close it at the end.

    Parameters
    ----------
    workers : int, optional
        So many processes on this machine.
    scheduler : str, optional
        Address of a Dask scheduler, tcp://host:8786, whose workers can read and write the same
        paths as this process.

    Raises
    ------
    ClusterError
        If the scheduler does not answer, or has no workers.
    DependencyError
        If Dask is needed and not installed.

    """
    if workers is None and scheduler is None:
        yield InProcess()
        return
    method = begin_workers() if scheduler is None else 'spawn'
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise DependencyError(
            f'dask cannot be loaded ({error}). It runs the workers; install it with '
            "`pip install 'surfel_mapper[cluster]'`"
        ) from error
    logging.getLogger('distributed').setLevel(logging.WARNING)
    settings: dict[str, Any] = {
        'distributed.scheduler.allowed-failures': LOSSES,
        'distributed.comm.timeouts.connect': f'{CONNECT_S}s',
        'distributed.worker.profile.enabled': False,
        'distributed.worker.multiprocessing-method': method,
        'distributed.nanny.pre-spawn-environ': WORKER_ENVIRONMENT,
    }
    with dask.config.set(settings):
        if scheduler is None:
            with ExitStack() as begun:
                with interrupt_held():
                    cluster = begun.enter_context(
                        LocalCluster(
                            n_workers=workers,
                            threads_per_worker=1,
                            dashboard_address='127.0.0.1:0',
                        )
                    )
                    client = begun.enter_context(Client(cluster))
                yield OnDask(client)
            return
        try:
            client = Client(scheduler, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise ClusterError(f'{scheduler}: no Dask scheduler answers: {error}') from error
        with client:
            if not client.scheduler_info(n_workers=-1)['workers']:
                raise ClusterError(f'{scheduler}: no workers; start some with `dask worker`')
            yield OnDask(client)
