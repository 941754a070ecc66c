# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The heap of this process by glibc: in use, and freed but kept for later allocations.

A module of its own: the layer of the soak calls it in the node, without the rest of the soak.
Resident memory alone does not tell growth from memory that glibc keeps (memory.py).
"""

from __future__ import annotations

import ctypes
import json
from pathlib import Path
import sys

FILE = 'heap.json'


class Mallinfo(ctypes.Structure):
    """The struct mallinfo2 of mallinfo(3), bytes."""

    _names = ('arena', 'ordblks', 'smblks', 'hblks', 'hblkhd', 'usmblks', 'fsmblks')
    _fields_ = [(n, ctypes.c_size_t) for n in (*_names, 'uordblks', 'fordblks', 'keepcost')]


def heap() -> dict[str, float]:
    """Return the memory in use and freed, MB, and the number of blocks of Python's allocator."""
    function = ctypes.CDLL(None).mallinfo2
    function.restype = Mallinfo
    found = function()
    return {
        'in_use_MB': (found.uordblks + found.hblkhd) / 2**20,
        'freed_MB': found.fordblks / 2**20,
        'python_blocks': sys.getallocatedblocks(),
    }


def write_heap(folder: Path) -> None:
    """Replace heap.json in a folder by the figures of this process."""
    part = folder / f'{FILE}.part'
    part.write_text(json.dumps(heap()), encoding='ascii')
    part.replace(folder / FILE)


def read_heap(folder: Path) -> dict[str, float]:
    """Return the figures that another process wrote last; none if it has not yet."""
    path = folder / FILE
    return json.loads(path.read_text(encoding='ascii')) if path.is_file() else {}
