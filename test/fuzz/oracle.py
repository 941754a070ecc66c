# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The limits of what an input may cost, and the measurement of it.

Memory is that of the process, since much of it is allocated by libraries in C; time is processor
time. What costs too much is measured again, since a collection of garbage or a page fault counts
once.
"""

from __future__ import annotations

from collections.abc import Callable
import time
from typing import NamedTuple

from test.fuzz import files
from test.fuzz.memory import reset_peak, resident

MOST_BYTES = 64 << 20
"""Memory that any input may take: the heap grows in steps, and chunks may unpack to 64 MiB."""

MOST_RATIO = 20
"""Memory per input byte."""

MOST_S, MOST_S_PER_BYTE = 0.2, 100e-9
"""Processor time that any input may take, and per input byte."""

SLOW = {
    'drive': (20.0, 'maps up to 14 scans with their poses'),
    'chain': (20.0, 'applies the filters that it reads'),
}
"""Readers that may take longer: factors of the time, and why."""

ATTEMPTS = 3
"""How often an input is measured before it counts as too expensive."""


class Cost(NamedTuple):
    """Memory, bytes, and processor time, s, of an input; the latter by the time allowed."""

    used: int
    seconds: float
    share: float
    ratio: float
    """Memory above MOST_BYTES per byte of input."""


class TooExpensive(AssertionError):
    """An input costs more than it may."""


def checked_cost(name: str, one_input: Callable[[bytes], None], data: bytes) -> Cost:
    """Return the cost of an input; raise TooExpensive if it costs too much at every attempt."""
    factor, _ = SLOW.get(name, (1.0, ''))
    for _ in range(ATTEMPTS):
        found = cost(one_input, data)
        if found.ratio < MOST_RATIO and found.share <= factor:
            return found
    raise TooExpensive(f'{name}: {found} for {data[:100]!r}')


def cost(one_input: Callable[[bytes], None], data: bytes) -> Cost:
    """Return the cost of an input; of a file only its reading counts."""
    reset_peak()
    files.READS.clear()
    before, start_s = resident('VmRSS'), time.process_time()
    one_input(data)
    used, seconds = resident('VmHWM') - before, time.process_time() - start_s
    reads = files.READS or [(seconds, len(data), used)]
    return Cost(
        used=max(memory for _, _, memory in reads),
        seconds=max(taken for taken, _, _ in reads),
        share=max(taken / (MOST_S + MOST_S_PER_BYTE * size) for taken, size, _ in reads),
        ratio=max(max(0, memory - MOST_BYTES) / max(size, 1) for _, size, memory in reads),
    )
