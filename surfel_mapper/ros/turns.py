# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The loop of the threads of the node: an error in one turn does not end the thread.

Callbacks are guarded one by one, where their names are known. The loop guards the steps between
them: waiting, taking a request, and reports of errors for which there is no memory.
"""

from __future__ import annotations

from collections.abc import Callable

MAX_FAILURES = 10
"""Turns that fail in a row; then the thread cannot go on."""


def take_turns(turn: Callable[[], bool], report: Callable[[Exception], object]) -> None:
    """
    Call ``turn`` until it returns False; report an error of it before the next turn.

    The last error of MAX_FAILURES in a row is raised.
    """
    failures = 0
    failed: Exception | None = None
    while True:
        try:
            if failed is not None:
                report(failed)
                failed = None
            if not turn():
                return
            failures = 0
        except Exception as error:  # MemoryError too
            failures += 1
            if failures >= MAX_FAILURES:
                raise
            failed = error
