# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Signals that end the node, none of which is lost.

A signal raises KeyboardInterrupt in the main thread, wherever that is. Python swallows what is
raised in a ``__del__``, and a compiler frees many objects, so whoever comes out of something long
asks with ``check`` too. Loads no ROS, since a signal may come while that is being loaded.
"""

from __future__ import annotations

import signal
from typing import Any

NUMBERS = (signal.SIGINT, signal.SIGTERM)


class Signals:
    """In a with-block, SIGINT and SIGTERM raise KeyboardInterrupt, once."""

    def __init__(self) -> None:
        """Hear nothing yet."""
        self._came = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Signals:
        """Hear signals."""
        self._before = {number: signal.signal(number, self._interrupt) for number in NUMBERS}
        return self

    def __exit__(self, *_: object) -> None:
        """Leave signals to who had them before; once interrupted, they are ignored to the end."""
        if not self._came:
            for number, handler in self._before.items():
                signal.signal(number, handler)

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal came."""
        if self._came:
            raise KeyboardInterrupt

    def _interrupt(self, *_: Any) -> None:
        """
        Interrupt the main thread, and ignore all signals that follow.

        A terminal and a launch file both send one; the second would cut short what the first
        began.
        """
        self._came = True
        for number in NUMBERS:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt
