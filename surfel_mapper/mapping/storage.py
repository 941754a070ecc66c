# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Storage that grows without a pause: rows of integers, and the hash table that finds them.

Slab: rows live in an anonymous memory map. Growing moves pages, not bytes (mremap: 0.1 ms for
256 MiB; allocating and copying takes 0.7 s), and a page costs memory only once a row in it is
written, so the slab may double.

HashTable: the arrays of kernels/hashing.py. Kernels stop when there is no room; the caller makes
room and calls again. The table grows by segments, each of which splits separately, so that no step
is long.
"""

from __future__ import annotations

import contextlib
import mmap
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import MapLimitError
from surfel_mapper.kernels import hashing

HUGE_FROM = 1 << 21
"""Size in bytes from which huge pages are requested: fewer misses of address translation save 40 %
of the time of a merge at 0.2 m."""


class Slab:
    """
    Rows of integers, zero until written.

    Parameters
    ----------
    num_rows : int
        Number of rows.
    width : int
        Number of columns.
    dtype : type
        Type of an integer.

    Attributes
    ----------
    array : (R, width), C order
        The rows; replaced when the slab grows, so it must not be kept.

    """

    def __init__(self, num_rows: int, width: int, dtype: type[np.integer[Any]] = np.int64) -> None:
        self._shape = num_rows, width
        self._dtype = np.dtype(dtype)
        self._memory = _anonymous(num_rows * self.row_bytes)
        self.array = self._view()

    @property
    def row_bytes(self) -> int:
        """Size of a row, bytes."""
        return self._shape[1] * self._dtype.itemsize

    def grow(self, num_rows: int) -> None:
        """
        Enlarge to num_rows rows; existing rows keep their index and content.

        Raises
        ------
        MapLimitError
            If the system refuses the memory.

        """
        num_bytes = num_rows * self.row_bytes
        self.array = np.empty((0, self._shape[1]), self._dtype)  # a view would pin the memory
        try:
            self._enlarge(num_bytes)
            self._shape = num_rows, self._shape[1]
        finally:
            self.array = self._view()
        if num_bytes >= HUGE_FROM and hasattr(mmap, 'MADV_HUGEPAGE'):
            with contextlib.suppress(OSError):  # only a hint
                self._memory.madvise(mmap.MADV_HUGEPAGE)

    def _enlarge(self, num_bytes: int) -> None:
        """Enlarge the memory map in place, or copy it."""
        try:
            self._memory.resize(num_bytes)
        except (BufferError, SystemError, OSError, ValueError):
            # a view is held elsewhere, the system has no mremap, or memory is exhausted
            self._memory = self._copied(num_bytes)

    def _copied(self, num_bytes: int) -> mmap.mmap:
        """Return a larger memory map with the content of this one."""
        try:
            memory = _anonymous(num_bytes)
        except OSError as error:
            raise MapLimitError(
                f'no memory for a map of {num_bytes / 2**20:.0f} MiB ({error}); '
                'set a limit of the window'
            ) from error
        memory[: len(self._memory)] = self._memory[:]
        return memory

    def _view(self) -> npt.NDArray[Any]:
        num_rows, width = self._shape  # memory may be larger, it has whole pages
        return np.frombuffer(self._memory, self._dtype, num_rows * width).reshape(self._shape)


def _anonymous(num_bytes: int) -> mmap.mmap:
    """Return zeroed private memory of whole pages."""
    size = -(-num_bytes // mmap.PAGESIZE) * mmap.PAGESIZE
    return mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)


SEGMENTS = 16
"""Segments of a new table."""


class HashTable:
    """
    Hash table from key to row of a slab.

    Parameters
    ----------
    max_depth : int
        The directory has at most 2^max_depth entries.

    Attributes
    ----------
    state : (S,) int64
        The scalars that kernels write; see kernels/hashing.py.
    arrays : tuple of array
        Directory, buckets, rows of each segment and local depth; replaced when the table grows.

    """

    def __init__(self, max_depth: int) -> None:
        self._max_depth = max_depth
        self._buckets = Slab(SEGMENTS, hashing.SEGMENT)
        self._directory: npt.NDArray[np.int32] = np.zeros(1, np.int32)
        self._num_rows: npt.NDArray[np.int32] = np.zeros(SEGMENTS, np.int32)
        self._local_depth: npt.NDArray[np.int8] = np.zeros(SEGMENTS, np.int8)
        self.state = np.zeros(hashing.STATE, np.int64)
        self.state[hashing.FREE_ROW] = -1
        self.state[hashing.NEXT_SEGMENT] = 1
        self.arrays: tuple[npt.NDArray[Any], ...] = ()
        self._set_arrays()

    def _set_arrays(self) -> None:
        """Enter the arrays as the kernels take them, after one was replaced."""
        buckets = self._buckets.array.reshape(-1)
        self.arrays = self._directory, buckets, self._num_rows, self._local_depth

    @property
    def num_keys(self) -> int:
        """Number of keys in the table."""
        return int(self.state[hashing.VOXELS])

    @property
    def rows_used(self) -> int:
        """Number of rows of the slab ever used."""
        return int(self.state[hashing.NEXT_ROW])

    @property
    def nbytes(self) -> int:
        """Bytes in use."""
        buckets = int(self.state[hashing.NEXT_SEGMENT]) * hashing.SEGMENT * 8
        return buckets + self._directory.nbytes + self._num_rows.nbytes

    def lacks_row(self, num_rows: int) -> bool:
        """Return whether a slab of num_rows has no row for a new key."""
        return bool(self.state[hashing.FREE_ROW] < 0) and self.rows_used == num_rows

    def grow(self) -> None:
        """
        Enlarge the part of the table that had no room for a key.

        Raises
        ------
        MapLimitError
            If the table has its maximum size, or memory is exhausted.

        """
        num_segments = len(self._num_rows)
        self.arrays = ()  # a view would pin the memory of the buckets
        try:
            if self.state[hashing.NEXT_SEGMENT] < num_segments:
                self._double_directory()
                return
            self._buckets.grow(2 * num_segments)
            self._num_rows = np.append(self._num_rows, np.zeros_like(self._num_rows))
            self._local_depth = np.append(self._local_depth, np.zeros_like(self._local_depth))
        finally:
            self._set_arrays()

    def _double_directory(self) -> None:
        depth = int(self.state[hashing.DEPTH])
        if depth == self._max_depth:
            raise MapLimitError(f'{self.num_keys} keys: the hash table is full')
        self._directory = np.repeat(self._directory, 2)
        self.state[hashing.DEPTH] = depth + 1
