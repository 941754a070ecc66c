# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Keeps freed memory in the process.

A message of megabytes is made and freed for every scan. By default glibc takes such memory from
the system each time and gives it back, and the system clears it page by page: of 22 ms for the
markers of 20,000 surfels 14 went there. The environment variables MALLOC_MMAP_THRESHOLD_ and
MALLOC_TRIM_THRESHOLD_ change that before a process starts; this changes it from inside.
"""

from __future__ import annotations

LARGEST = 31 << 20
"""Bytes; glibc adapts its threshold to freed blocks of up to 32 MiB."""


def keep_freed_memory() -> None:
    """
    Make glibc keep freed blocks of up to 31 MiB, and of all freed memory up to 62 MiB.

    Freeing one block that came from the system raises glibc's threshold for such blocks to its
    size, and that for giving memory back to twice the size (mallopt(3), M_MMAP_THRESHOLD). The
    block is never touched, so it costs nothing. Without glibc nothing happens; where the
    environment sets the thresholds, they stay.
    """
    bytes(LARGEST)
