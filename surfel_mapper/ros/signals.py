# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Signals that end the node, none of which is lost.

A signal raises KeyboardInterrupt in the main thread, wherever that is. Python prints and swallows
what is raised in a ``__del__`` or in a function that C code calls back, and a compiler does much
of both; there the interrupt waits a moment. Loads no ROS, since a signal may come while that is
being loaded.
"""

from __future__ import annotations

import signal
from types import FrameType
from typing import Any

NUMBERS = (signal.SIGINT, signal.SIGTERM)
RETRY_S = 0.01


class Signals:
    """In a with-block, SIGINT and SIGTERM raise KeyboardInterrupt, once."""

    def __init__(self) -> None:
        """Hear nothing yet."""
        self._came = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Signals:
        """Hear signals."""
        numbers = (*NUMBERS, signal.SIGALRM)
        self._before = {number: signal.signal(number, self._interrupt) for number in numbers}
        return self

    def __exit__(self, *_: object) -> None:
        """Leave signals to who had them before; once interrupted, they are ignored to the end."""
        signal.setitimer(signal.ITIMER_REAL, 0)
        if not self._came:
            for number, handler in self._before.items():
                signal.signal(number, handler)

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal came, even if its interrupt still waits."""
        if self._came:
            signal.setitimer(signal.ITIMER_REAL, 0)
            raise KeyboardInterrupt

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        """
        Interrupt the main thread, and ignore all signals that follow.

        A terminal and a launch file both send one; the second would cut short what the first
        began.
        """
        self._came = True
        for ignored in NUMBERS:
            signal.signal(ignored, signal.SIG_IGN)
        if swallows(frame):
            signal.setitimer(signal.ITIMER_REAL, RETRY_S)
        else:
            raise KeyboardInterrupt


def swallows(frame: FrameType | None) -> bool:
    """Whether what is raised in a frame ends in a finalizer, or in LLVM calling back."""
    while frame is not None:
        code = frame.f_code
        if code.co_name == '__del__' or '/llvmlite/' in code.co_filename:
            return True
        frame = frame.f_back
    return False
