# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Threads: work on the rows of arrays by several threads at once.

The kernels release Python's lock, so plain threads do. Each part of the rows is computed as it
would be alone, so the result has the same bits for any number of threads.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
import itertools


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
