# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Executors of tasks: this process, local workers, or the workers of a Dask scheduler.

A task is a function of this package and its arguments; it writes its result to files and returns
little. So Dask gives the task of a lost worker to another one, and several attempts leave the
same files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
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
"""Time in which a scheduler has to answer, s."""

LOOPBACK = '127.0.0.1'
"""Address of a cluster on this machine."""

LOSSES = 5
"""A task is given up after this many workers died at it."""

NO_PAGES: dict[str, list[str]] = {
    'distributed.scheduler.http.routes': [],
    'distributed.worker.http.routes': [],
}
"""
Settings of a cluster on this machine: its HTTP servers have no page. Dask starts them in any case,
without keys, and their pages name the tasks and their arguments to every user of the machine.
"""

POLL_S = 0.02
"""Period of checking for finished tasks and for a stop, s."""

PRELOADED = ['surfel_mapper.cluster._forkserver_preload', 'distributed']
"""Modules of the fork server; loading them would take each local worker 2 s."""

WORKER_ENVIRONMENT = {'MALLOC_ARENA_MAX': '1', 'OMP_NUM_THREADS': '1', 'MKL_NUM_THREADS': '1'}
"""
Environment of workers, with a single malloc arena. Tasks run beside the main thread of a worker;
with several arenas freed memory returns to the system at once, and paging it in again for every
cloud doubles the time.
"""


def never() -> bool:
    """Return False: not stopped."""
    return False


class Executor(Protocol):
    """Runs tasks."""

    @property
    def num_workers(self) -> int:
        """Number of tasks that run at a time."""

    def run(
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        stopped: Callable[[], bool] = never,
    ) -> Iterator[tuple[int, Result]]:
        """
        Yield the number and the result of each item, as they get done.

        After a stop, only the tasks that have begun get done.
        """


class SerialExecutor:
    """Runs one task after the other, in this process."""

    num_workers = 1

    def run(
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        stopped: Callable[[], bool] = never,
    ) -> Iterator[tuple[int, Result]]:
        """Yield the number and the result of each item, until it is stopped."""
        for number, item in enumerate(items):
            if stopped():
                return
            yield number, function(item)


class DaskExecutor:
    """
    Runs tasks on the workers of a Dask client.

    Parameters
    ----------
    client : distributed.Client
        Its workers run the tasks.

    """

    def __init__(self, client: Any) -> None:
        self._client = client

    @property
    def num_workers(self) -> int:
        """Number of workers at present."""
        return max(len(self._client.scheduler_info(n_workers=-1)['workers']), 1)

    def run(
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        stopped: Callable[[], bool] = never,
    ) -> Iterator[tuple[int, Result]]:
        """
        Yield the number and the result of each item, as they get done.

        After a stop, only the tasks that have begun get done: as many as there are workers, since
        tasks begin in their order.

        Raises
        ------
        ClusterError
            If several workers died at a task, or the scheduler is gone.

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


def start_forkserver() -> str:
    """
    Start loading the modules of local workers; return the method by which to start these.

    A process of its own, the fork server, loads them, and workers are forked from it. It ends
    with this process; until then lost workers are replaced at once.
    """
    if 'forkserver' not in multiprocessing.get_all_start_methods():
        return 'spawn'
    forkserver.set_forkserver_preload(PRELOADED)
    # libraries read it when they are loaded; a terminal sends Ctrl-C to that process too
    with environment(WORKER_ENVIRONMENT), on_interrupt(signal.SIG_IGN):
        forkserver.ensure_running()
    return 'forkserver'


def start_local(workers: int | None, started: ExitStack) -> Any:
    """
    Start a cluster on this machine, to be ended with the stack; return its client.

    Raises
    ------
    ClusterError
        If a worker ends while it starts.

    """
    import dask
    from distributed import Client, LocalCluster

    try:
        with interrupt_held(), dask.config.set(NO_PAGES):
            cluster = started.enter_context(
                LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    host=LOOPBACK,
                    security=temporary_security(),
                    dashboard_address=f'{LOOPBACK}:0',
                    scheduler_kwargs={'dashboard': False},
                )
            )
            return started.enter_context(Client(cluster))
    except (RuntimeError, OSError) as error:
        raise ClusterError(
            f'a worker ended while it started ({error}); was it killed, or is memory short?'
        ) from error


def temporary_security() -> Any:
    """
    Return keys for a cluster on this machine, which live in memory and end with it.

    Without them every user of the machine could connect and run code.
    """
    from distributed import Security

    try:
        return Security.temporary()
    except ImportError as error:
        raise DependencyError(
            f'cryptography cannot be loaded ({error}). It encrypts what workers exchange; install '
            "it with `pip install 'surfel_mapper[cluster]'` or `pip install cryptography`"
        ) from error


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables in a block, for the processes that are started there."""
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
    """Temporarily replace the SIGINT handler, for started processes too."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals interrupt the main thread only
        return
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def interrupt_held() -> Iterator[None]:
    """Delay Ctrl-C until the end of a block: Dask cannot end a cluster that is half started."""
    pressed: list[int] = []
    with on_interrupt(lambda number, _: pressed.append(number)):
        yield
    if pressed:
        raise KeyboardInterrupt


def connected(scheduler: str) -> Any:
    """
    Return a client of a scheduler; raise ClusterError if it does not answer as one.

    Dask waits for ever for a server that says nothing, and takes the answers of others for the
    lengths of arrays (MemoryError).
    """
    from distributed import Client

    answer: Future[Any] = Future()

    def connect() -> None:
        try:
            answer.set_result(Client(scheduler, timeout=CONNECT_S))
        except Exception as error:
            answer.set_exception(error)

    threading.Thread(target=connect, daemon=True).start()
    try:
        return answer.result(2 * CONNECT_S)
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise ClusterError(f'{scheduler}: no Dask scheduler answers: {reason}') from error


@contextmanager
def open_executor(workers: int | None = None, scheduler: str | None = None) -> Iterator[Executor]:
    """
    Open an executor for a with-block.

    Parameters
    ----------
    workers : int, optional
        Number of processes on this machine; without workers and scheduler, this process.
    scheduler : str, optional
        Address of a Dask scheduler, tcp://host:8786; its workers have to read and write the same
        paths as this process.

    Raises
    ------
    ClusterError
        If the scheduler does not answer, or has no workers, or a worker ends while it starts.
    DependencyError
        If Dask is needed and not installed.

    """
    if workers is None and scheduler is None:
        yield SerialExecutor()
        return
    method = start_forkserver() if scheduler is None else 'spawn'
    try:
        import dask
        import distributed  # noqa: F401 - may be missing alone
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
            with ExitStack() as started:
                client = start_local(workers, started)
                yield DaskExecutor(client)
            return
        with connected(scheduler) as client:
            if not client.scheduler_info(n_workers=-1)['workers']:
                raise ClusterError(f'{scheduler}: no workers; start some with `dask worker`')
            yield DaskExecutor(client)
