# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Storage that grows without a pause: rows of integers, and the hash table that finds them.

Slab: rows live in an anonymous memory map. Growing moves pages, not bytes (mremap: 0.1 ms for
256 MiB; allocating and copying takes 0.7 s), and a page costs memory only once a row in it is
written, so the slab may double.

HashTable: the arrays of kernels/hashing.py. Kernels stop when there is no room; the caller makes
room and calls again. The table grows by segments, each of which splits separately, so that no step
is long. Rows and segments are given to the stripes of a table in groups.
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
        self._array: npt.NDArray[Any] | None = None

    @property
    def row_bytes(self) -> int:
        """Size of a row, bytes."""
        return self._shape[1] * self._dtype.itemsize

    @property
    def array(self) -> npt.NDArray[Any]:
        """The rows; made again after growing, also if there was no memory for it then."""
        if self._array is None:
            self._array = self._view()
        return self._array

    def grow(self, num_rows: int) -> None:
        """
        Enlarge to num_rows rows; existing rows keep their index and content.

        Raises
        ------
        MapLimitError
            If the system refuses the memory.

        """
        num_bytes = num_rows * self.row_bytes
        self._array = None  # a view would pin the memory
        try:
            self._memory.resize(num_bytes)
        except (BufferError, SystemError, OSError, ValueError):
            # a view is held elsewhere, the system has no mremap, or memory is exhausted
            self._memory = self._copied(num_bytes)
        self._shape = num_rows, self._shape[1]
        if num_bytes >= HUGE_FROM and hasattr(mmap, 'MADV_HUGEPAGE'):
            with contextlib.suppress(OSError):  # only a hint
                self._memory.madvise(mmap.MADV_HUGEPAGE)

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
"""Segments that a stripe is given at once: their numbers of rows fill a cache line."""

ROWS = 8192
"""Rows that a stripe is given at once, so that those of two stripes share no cache line."""


class HashTable:
    """
    Hash table from key to row of a slab.

    Parameters
    ----------
    max_depth : int
        The directory has at most 2^max_depth entries.
    stripe_bits : int
        There are 2^stripe_bits stripes; see kernels/hashing.py.

    Attributes
    ----------
    state : (S,) int64
        The scalars that kernels write; see kernels/hashing.py.
    rows_given : int
        Number of rows of the slab that the stripes were given; later ones are untouched.

    """

    def __init__(self, max_depth: int, stripe_bits: int = 0) -> None:
        self._max_depth = max_depth
        stripes = 1 << stripe_bits  # each has a segment at the start
        num_segments = stripes * SEGMENTS
        first = np.arange(0, num_segments, SEGMENTS, np.int32)
        self._buckets = Slab(num_segments, hashing.SEGMENT)
        self._directory: npt.NDArray[np.int32] = first
        self._held: npt.NDArray[np.int32] = np.zeros(num_segments, np.int32)
        self._local_depth: npt.NDArray[np.int8] = np.full(num_segments, stripe_bits, np.int8)
        self.rows_given, self._segments_given = 0, num_segments
        self.state = np.zeros((1 + stripes) * hashing.LINE, np.int64)
        self.state[hashing.DEPTH] = self.state[hashing.STRIPING] = stripe_bits
        for stripe, segment in enumerate(first.tolist()):
            self.state[hashing.FREE_ROW + stripe * hashing.LINE] = -1
            self._give(hashing.NEXT_SEGMENT, stripe, segment + 1, segment + SEGMENTS)

    @property
    def arrays(self) -> tuple[npt.NDArray[Any], ...]:
        """Directory, buckets, held, local_depth, as the kernels take them."""
        buckets = self._buckets.array.reshape(-1)
        return self._directory, buckets, self._held, self._local_depth

    def of_stripes(self, entry: int) -> list[int]:
        """Return an entry of the state for each stripe."""
        found: list[int] = self.state[entry :: hashing.LINE].tolist()
        return found

    def _give(self, entry: int, stripe: int, first: int, end: int) -> None:
        """Give rows or segments to a stripe, in one step: Ctrl-C may come between two."""
        at = entry + stripe * hashing.LINE
        self.state[at : at + 2] = first, end

    @property
    def num_keys(self) -> int:
        """Number of keys in the table."""
        return sum(self.of_stripes(hashing.VOXELS))

    @property
    def rows_used(self) -> int:
        """Number of rows of the slab from which on none was ever used."""
        return max(self.of_stripes(hashing.NEXT_ROW))

    @property
    def num_rows_used(self) -> int:
        """Number of rows of the slab ever used."""
        return self.rows_given - self._num_left(hashing.NEXT_ROW, hashing.END_ROW)

    @property
    def nbytes(self) -> int:
        """Bytes in use."""
        num_left = self._num_left(hashing.NEXT_SEGMENT, hashing.END_SEGMENT)
        buckets = (self._segments_given - num_left) * hashing.SEGMENT * 8
        return buckets + self._directory.nbytes + self._held.nbytes

    def _num_left(self, following: int, end: int) -> int:
        """Return how many rows or segments the stripes were given and have not used."""
        return sum(self.of_stripes(end)) - sum(self.of_stripes(following))

    def _without(self, following: int, end: int) -> list[int]:
        """Return the stripes that have used all rows or segments that they were given."""
        lefts = zip(self.of_stripes(following), self.of_stripes(end), strict=True)
        return [stripe for stripe, (first, last) in enumerate(lefts) if first == last]

    def _short_of_rows(self) -> list[int]:
        """Return the stripes that have no row for a new key."""
        free = self.of_stripes(hashing.FREE_ROW)
        used_up = self._without(hashing.NEXT_ROW, hashing.END_ROW)
        return [stripe for stripe in used_up if free[stripe] < 0]

    def lacks_row(self) -> bool:
        """Return whether a stripe has no row for a new key."""
        return bool(self._short_of_rows())

    def give_rows(self, num_rows: int) -> bool:
        """Give rows of a slab of num_rows to the stripes without any; False if all are given."""
        before = self.rows_given
        for stripe in self._short_of_rows():
            first, end = self.rows_given, min(self.rows_given + ROWS, num_rows)
            self.rows_given = end  # first: rows may be lost, but not given twice
            self._give(hashing.NEXT_ROW, stripe, first, end)
        return self.rows_given > before

    def grow(self) -> None:
        """
        Enlarge the part of the table that had no room for a key.

        Raises
        ------
        MapLimitError
            If the table has its maximum size, or memory is exhausted.

        """
        num_segments = len(self._held)
        used_up = self._without(hashing.NEXT_SEGMENT, hashing.END_SEGMENT)
        if not used_up:
            self._double_directory()
        elif self._segments_given == num_segments:
            self._buckets.grow(2 * num_segments)
            held = np.append(self._held, np.zeros_like(self._held))
            local_depth = np.append(self._local_depth, np.zeros_like(self._local_depth))
            self._held, self._local_depth = held, local_depth  # both or none: of one length
        else:
            first = self._segments_given
            self._segments_given = first + SEGMENTS
            self._give(hashing.NEXT_SEGMENT, used_up[0], first, first + SEGMENTS)

    def _double_directory(self) -> None:
        depth = int(self.state[hashing.DEPTH])
        if depth == self._max_depth:
            raise MapLimitError(f'{self.num_keys} keys: the hash table is full')
        directory = np.repeat(self._directory, 2)
        self.state[hashing.DEPTH], self._directory = depth + 1, directory
