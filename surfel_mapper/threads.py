# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Threads: work on the rows of arrays by several threads at once.

The kernels release Python's lock, so plain threads do. Every row is computed as it would be
alone, so the result has the same bits for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
import itertools

PARTS = 4
"""The rows are divided into so many parts a thread, which whoever is free takes the next of."""


@cache
def pool(threads: int) -> ThreadPoolExecutor | None:
    """Return the threads beside the caller's own, shared by all maps; None for one thread."""
    if threads < 2:
        return None
    return ThreadPoolExecutor(threads - 1, thread_name_prefix='surfel_mapper')


def split(num_rows: int, parts: int) -> list[slice]:
    """Return so many slices that are all rows in order, of nearly the same length."""
    bounds = [num_rows * part // parts for part in range(parts + 1)]
    return [slice(first, last) for first, last in itertools.pairwise(bounds)]


def share(work: Callable[[slice], object], num_rows: int, threads: int) -> None:
    """
    Do the work on all rows, with the help of threads that have nothing else to do.

    The caller's thread takes parts until none is left, so it never waits for one that is busy
    with something longer, only for parts that another has begun.
    """
    helpers = pool(threads)
    if helpers is None:
        work(slice(0, num_rows))
        return
    parts = iter(split(num_rows, PARTS * threads))  # handed out one by one: Python's lock

    def take_parts() -> None:
        for part in parts:
            work(part)

    helping = [helpers.submit(take_parts) for _ in range(threads - 1)]
    take_parts()
    for helper in helping:
        if not helper.cancel():
            helper.result()
