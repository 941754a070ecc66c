# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Conditions of the figures beside the code: the machine, its load, the number of cores."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
import mmap
import os
from pathlib import Path
import platform
from typing import Any


def facts() -> dict[str, Any]:
    """Return the properties that are constant during a run."""
    return {
        'cpu': cpu_model(),
        'cores': os.cpu_count(),
        'python': platform.python_version(),
        'numpy': installed('numpy'),
        'numba': installed('numba'),
    }


def load() -> float:
    """Return the load average over the last minute."""
    return round(os.getloadavg()[0], 2)


def cpu_model() -> str:
    """Return the name of the processor."""
    cpuinfo = Path('/proc/cpuinfo')
    lines = cpuinfo.read_text(encoding='utf-8').splitlines() if cpuinfo.exists() else []
    names = [line.split(':', 1)[1].strip() for line in lines if line.startswith('model name')]
    return names[0] if names else platform.processor()


def installed(package: str) -> str | None:
    """Return the version of a package, None if it is missing."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def resident_bytes() -> int:
    """Return the memory of this process as Linux states it."""
    pages = int(Path('/proc/self/statm').read_text(encoding='ascii').split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE')


def prefault(num_bytes: int = 1 << 28) -> None:
    """
    Touch memory and free it, so that page faults of a virtual machine are not timed.

    The host of one takes free memory back within a minute. The first access to a page of 2 MiB
    takes 5.8 ms afterwards instead of 0.24, so that scan is the slowest of a run.
    """
    with mmap.mmap(-1, num_bytes, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS) as memory:
        if hasattr(mmap, 'MADV_HUGEPAGE'):
            with suppress(OSError):  # only a hint
                memory.madvise(mmap.MADV_HUGEPAGE)
        memory[:: mmap.PAGESIZE] = bytes(-(-num_bytes // mmap.PAGESIZE))


@contextmanager
def one_core() -> Iterator[None]:
    """
    Pin this thread and its children to one core, if the system can.

    The last core is used, as systems run their own work on the first.
    """
    if not hasattr(os, 'sched_setaffinity'):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
