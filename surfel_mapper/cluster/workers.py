# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Workers of Dask: processes of this machine, or those of a scheduler elsewhere.

A task is a function of this package and its arguments. Dask repeats the task of a lost worker on
another one. Without workers, tasks run in this process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, ExitStack
import logging
import multiprocessing
from multiprocessing import forkserver
import os
from typing import Any, TypeVar

from surfel_mapper.errors import ClusterError, DependencyError

Item = TypeVar('Item')
Result = TypeVar('Result')

CONNECT_S = 20
"""Time in which a scheduler has to answer, s."""

LOOPBACK = '127.0.0.1'

PRELOADED = ['surfel_mapper.cluster.shards', 'distributed']
"""Modules of the fork server; loading them would take each local worker 2 s."""

SETTINGS: dict[str, Any] = {
    'distributed.comm.timeouts.connect': f'{CONNECT_S}s',
    'distributed.worker.profile.enabled': False,
}

LOCAL_SETTINGS: dict[str, Any] = {
    # the pages of the HTTP servers show tasks and their arguments to every user of the machine
    'distributed.scheduler.http.routes': [],
    'distributed.worker.http.routes': [],
}
"""Settings of a cluster on this machine."""


def never() -> bool:
    """Return False: not stopped."""
    return False


class Workers:
    """
    Run tasks on the workers of a Dask client, or in this process without one.

    Parameters
    ----------
    client : distributed.Client, optional
        The client.

    """

    def __init__(self, client: Any = None) -> None:
        self.client = client

    @property
    def num_workers(self) -> int:
        """Number of workers at present; 1 without a client."""
        if self.client is None:
            return 1
        return max(len(self.client.scheduler_info(n_workers=-1)['workers']), 1)

    def run(
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        stopped: Callable[[], bool] = never,
    ) -> Iterator[tuple[int, Result]]:
        """
        Yield the number and the result of each item, as they get done.

        After a stop, which is noticed at the end of a task, the others are given up.

        Raises
        ------
        ClusterError
            If several workers died at a task, or the scheduler is gone.

        """
        if self.client is None:
            for number, item in enumerate(items):
                if stopped():
                    return
                yield number, function(item)
            return
        from distributed import as_completed, CancelledError, KilledWorker

        futures = self.client.map(function, items, pure=False)
        numbers = {future: number for number, future in enumerate(futures)}
        try:
            for future in as_completed(futures):
                yield numbers[future], future.result()
                if stopped():
                    return
        except KilledWorker as error:
            raise ClusterError(
                f'several workers died at the same task; is their memory large enough? {error}'
            ) from error
        except (CancelledError, OSError) as error:
            raise ClusterError(f'the scheduler is gone: {error}') from error
        finally:
            self.client.cancel(futures)


@contextmanager
def open_workers(workers: int | None = None, scheduler: str | None = None) -> Iterator[Workers]:
    """
    Open workers for a with-block.

    Parameters
    ----------
    workers : int, optional
        Number of processes on this machine; without workers and scheduler, this process.
    scheduler : str, optional
        Address of a Dask scheduler, tcp://host:8786; its workers have to read the same paths as
        this process.

    Raises
    ------
    ClusterError
        If the scheduler does not answer, or has no workers, or a worker ends while it starts.
    DependencyError
        If Dask is needed and not installed.

    """
    if workers is None and scheduler is None:
        yield Workers()
        return
    try:
        import cryptography  # noqa: F401 - keys of local workers
        import dask
        import distributed
    except ImportError as error:
        raise DependencyError(
            f'{error.name} cannot be loaded ({error}). It runs the workers; install it with '
            "`pip install 'surfel_mapper[cluster]'`"
        ) from error
    logging.getLogger('distributed').setLevel(logging.WARNING)
    settings = {**SETTINGS, **(local_settings() if scheduler is None else {})}
    with dask.config.set(settings), ExitStack() as opened:
        try:
            target = scheduler or opened.enter_context(local_cluster(workers))
            client = opened.enter_context(distributed.Client(target, timeout=CONNECT_S))
        except Exception as error:  # answers of other servers raise errors of any type
            problem = f'{scheduler}: no Dask scheduler answers'
            problem = problem if scheduler else 'a worker ended while it started'
            raise ClusterError(f'{problem}: {str(error) or type(error).__name__}') from error
        if not client.scheduler_info(n_workers=-1)['workers']:
            raise ClusterError(f'{scheduler}: no workers; start some with `dask worker`')
        yield Workers(client)


def local_settings() -> dict[str, Any]:
    """Return settings with which workers are forked from a process that has loaded all modules."""
    if 'forkserver' not in multiprocessing.get_all_start_methods():
        return LOCAL_SETTINGS
    # with several arenas freed memory is paged in again for every cloud, at twice the time
    os.environ.setdefault('MALLOC_ARENA_MAX', '1')
    multiprocessing.set_forkserver_preload(PRELOADED)
    forkserver.ensure_running()  # before Dask, which would preload other modules
    return {**LOCAL_SETTINGS, 'distributed.worker.multiprocessing-method': 'forkserver'}


def local_cluster(workers: int | None) -> Any:
    """Return a cluster of this machine; its keys live in memory and end with it."""
    from distributed import LocalCluster, Security

    return LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        host=LOOPBACK,
        security=Security.temporary(),  # without, every user could connect and run code
        dashboard_address=f'{LOOPBACK}:0',
        scheduler_kwargs={'dashboard': False},
    )
