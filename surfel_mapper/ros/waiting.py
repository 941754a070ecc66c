# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Waiting for another thread inside a callback, while the executor goes on with other callbacks.

A service that writes a large map takes a second. If it held up the executor, clouds would be
overwritten in the middleware's queue meanwhile, of which nobody is told.
"""

from __future__ import annotations

from collections.abc import Generator
from concurrent.futures import Future
import types
from typing import TypeVar

from rclpy.executors import Executor

Result = TypeVar('Result')


async def result_of(future: Future[Result], executor: Executor) -> Result:
    """Return the result of a future, or raise its error, when another thread has set it."""
    future.add_done_callback(lambda _: executor.wake())
    while not future.done():
        await _next_turn()
    return future.result()


@types.coroutine
def _next_turn() -> Generator[None, None, None]:
    """Give way to other callbacks; the executor comes back whenever it is awake."""
    yield
