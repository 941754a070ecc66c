# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Keep freed memory in the process instead of returning it to the system.

Messages of megabytes are allocated and freed for every scan. By default glibc gets such memory
from the system each time and returns it, and the system clears it page by page: 14 of 22 ms for
the markers of 20,000 surfels. The environment variables MALLOC_MMAP_THRESHOLD_ and
MALLOC_TRIM_THRESHOLD_ change that before a process starts; this module changes it from inside.

``lasting_objects`` keeps the garbage collector away from compiler, kernels and libraries: 145,000
objects, which every full collection would visit while scans are mapped, 70 ms at a time.

``limit_address_space`` makes an allocation beyond the memory of the machine a MemoryError.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import gc
import os
from pathlib import Path
import resource

CGROUP_LIMIT = Path('/sys/fs/cgroup/memory.max')
"""Limit of a container, bytes, or ``max``."""

RESERVED_BYTES, RESERVED_EACH = 2 << 30, 256 << 20
"""Address space that a process and each core take without using it, for stacks and arenas of
threads and for the compiler; a replay with registration on two cores reserved 1.8 GB."""

LARGEST = 31 << 20
"""Size of the freed block, bytes; glibc adapts its threshold to blocks of up to 32 MiB."""


def keep_freed_memory() -> None:
    """
    Make glibc keep freed blocks of up to 31 MiB, and up to 62 MiB at the end of each arena.

    Each thread that allocates has an arena. Freeing a block that came from the system raises
    glibc's threshold for such blocks to its size, and the threshold for returning memory to twice
    the size (mallopt(3), M_MMAP_THRESHOLD). The block is never touched, so it costs nothing.
    Without glibc this has no effect; thresholds set by the environment stay.
    """
    bytes(LARGEST)


@contextmanager
def lasting_objects() -> Iterator[None]:
    """
    Never visit the objects made until the end of a with-block when garbage is collected.

    For the start of a process whose objects stay: imported libraries and compiled kernels.
    """
    try:
        yield
    finally:
        gc.collect()
        gc.freeze()


def machine_bytes() -> int:
    """Return the memory of the machine, or of the container if that is limited to less, bytes."""
    total = os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES')
    try:
        text = CGROUP_LIMIT.read_text(encoding='ascii').strip()
    except OSError:
        return total
    return min(total, int(text)) if text.isdigit() else total


def limit_address_space(most: int = 0) -> None:
    """
    Limit the address space of this process, so that an allocation beyond it is a MemoryError.

    Parameters
    ----------
    most : int
        Memory to use, bytes; 0 means three quarters of that of the machine or container.

    """
    reserved = RESERVED_BYTES + RESERVED_EACH * (os.cpu_count() or 1)
    limit = (most or machine_bytes() * 3 // 4) + reserved
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    if soft == resource.RLIM_INFINITY or limit < soft:
        resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
