# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
VoxelTable: the memory of a map, a row of integers for each voxel, found by hash.

Owns the arrays that the kernels work on and enlarges them when a kernel has no room. Rows and
buckets grow without being copied and a full segment of the hash table splits separately, so that
no scan waits while the whole map is rehashed.

ChangeLog: the rows that the latest versions changed. Without it, asking for changes would look at
the stamp of every row. It holds at most a quarter of the rows: beyond that, reading all stamps in
order is as fast.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import takewhile
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_array
from surfel_mapper.kernels import hashing, layout
from surfel_mapper.mapping.kernels.queries import (
    keys_in_box,
    rows_changed_after,
    rows_changed_at,
    rows_held,
)
from surfel_mapper.mapping.kernels.rows import read_counts
from surfel_mapper.mapping.kernels.voxels import (
    add_moments,
    add_sums,
    find_rows,
    remove_moments,
)
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.storage import HashTable, Slab

MAX_DEPTH = 24
"""The directory of the hash table has at most 2^24 entries, enough for 6e9 voxels."""

Change = tuple[int, npt.NDArray[np.int32]]
"""A version, and the rows that it changed."""

Arrays = tuple[npt.NDArray[Any], ...]
"""Moments as the kernels take them."""

LEAST = 1 << 18
"""Minimum capacity of the change log, rows; 1 MiB."""


class VoxelTable:
    """
    Rows of voxels and their stamps (kernels/layout.py), and the hash table that finds them.

    Parameters
    ----------
    num_channels : int
        Number of channels that are summed beside the moments, in rows of their own.

    Attributes
    ----------
    rows : Slab
        The rows, 12 int64 each.

    """

    def __init__(self, num_channels: int = 0) -> None:
        self.rows = Slab(1024, layout.ROW)
        self._stamps = Slab(1024, 1, np.uint32)
        self._version = 0
        self._channels = Slab(1024, num_channels) if num_channels else None
        self._hash = HashTable(MAX_DEPTH)
        self._state = self._hash.state

    @property
    def num_voxels(self) -> int:
        """Number of voxels that hold at least one point."""
        return self._hash.num_keys

    @property
    def num_points(self) -> int:
        """Number of points of all voxels."""
        return int(self._state[hashing.POINTS])

    @property
    def nbytes(self) -> int:
        """Bytes in use for voxels and their hash table."""
        slabs = (self.rows, self._stamps, self._channels)
        row_bytes = sum(slab.row_bytes for slab in slabs if slab)
        return self._hash.rows_used * row_bytes + self._hash.nbytes

    def add(self, moments: ScanMoments, version: int) -> npt.NDArray[np.int32]:
        """
        Add moments to their voxels; return the row of each.

        Raises
        ------
        MapLimitError
            If there is no memory for the voxels. The table is unchanged.

        """
        rows = np.empty(len(moments), np.int32)
        arrays, sums = kernel_arrays(moments)
        num_added, self._version = 0, version
        try:
            while (num_added := self._add(arrays, num_added, rows)) < len(moments):
                self._make_room()
        except BaseException:
            for start in range(0, num_added, 1024):  # there may be no memory for all at once
                voxels = slice(start, min(start + 1024, num_added))
                self._subtract(tuple(array[voxels] for array in arrays), rows[voxels], 1)
            raise
        if sums:
            add_sums(self.rows.array, rows, 1, *sums)
        if self._channels:
            self._channels.array[rows.astype(np.intp)] += moments.channels
        return rows

    def find(self, key: npt.NDArray[np.int64]) -> npt.NDArray[np.int32]:
        """Return the row of each voxel key, -1 if not found."""
        rows = np.empty(len(key), np.int32)
        find_rows(key, self.rows.array, self._hash.arrays, self._state, rows)
        return rows

    def remove(
        self, moments: ScanMoments, version: int, min_points: int = 1
    ) -> tuple[int, npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """
        Subtract moments from their voxels, or nothing if one does not hold them.

        Returns
        -------
        missing : int
            The first voxel that does not hold its moments, or -1.
        rows : (K,) int32
            The row of each voxel.
        fallen : (E, 3) int32
            The indices of the voxels that fell below min_points.

        """
        arrays, sums = kernel_arrays(moments)
        if sums or moments.rows is None or len(moments.rows) != len(moments):
            rows = self.find(moments.key)
        else:
            rows = np.array(moments.rows, np.int32)  # hints, confirmed by the kernel
        self._version = version
        if sums:
            add_sums(self.rows.array, rows, -1, *sums)
        missing, fallen = self._subtract(arrays, rows, max(min_points, 1))
        if missing >= 0 and sums:
            add_sums(self.rows.array, rows, 1, *sums)
        if missing < 0 and self._channels:
            self._channels.array[rows.astype(np.intp)] -= moments.channels
        return missing, rows, fallen

    def checked(self, rows: npt.ArrayLike) -> npt.NDArray[np.int32]:
        """Return rows (K,) as the kernels take them; IndexError if the table does not have one."""
        array = as_array('rows', rows)
        if array.ndim != 1 or array.dtype.kind != 'i':
            raise IndexError(f'rows: {array.dtype} {array.shape}, expected those of find')
        last = self._hash.rows_used - 1
        if len(array) and not 0 <= array.min() <= array.max() <= last:
            raise IndexError(
                f'rows {array.min()} to {array.max()}, expected 0 to {last}; find returns -1 for '
                'voxels that are not in the map'
            )
        return array.astype(np.int32, copy=False)

    def keys(self, chosen: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        """
        Return the voxel keys of some rows, (K,).

        With indices of another width than intp NumPy (2.4) may end the process when memory runs
        out, both in reading and in assigning.
        """
        keys: npt.NDArray[np.int64] = self.rows.array[chosen.astype(np.intp), layout.KEY]
        return keys

    def counts(self, chosen: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        """Return the numbers of points of some rows, (K,); 0 for rows of -1."""
        counts = np.empty(len(chosen), np.int64)
        read_counts(self.rows.array, chosen, counts)
        return counts

    def channels(self, chosen: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        """Return the channel sums of some rows, (K, C)."""
        if not self._channels:
            return np.empty((len(chosen), 0), np.int64)
        return np.asarray(self._channels.array[chosen.astype(np.intp)])

    def changed_after(self, version: int, min_points: int) -> npt.NDArray[np.int32]:
        """
        Return the rows of at least min_points points that were changed after a version.

        With min_points of 0 emptied rows are included.
        """
        stamps, used = self._stamps.array.reshape(-1), self._hash.rows_used
        stamp, changes = stamp_of(self._version), self._version - version
        rows = rows_changed_after(self.rows.array, stamps, used, stamp, changes, min_points)
        return np.asarray(rows)

    def changed_at(self, changes: Sequence[Change], min_points: int) -> npt.NDArray[np.int32]:
        """
        Return the rows that were last changed by one of some changes, (K,), each once.

        Rows of fewer than min_points points are left out.
        """
        stamps = self._stamps.array.reshape(-1)
        selected = [
            rows_changed_at(self.rows.array, stamps, rows, stamp_of(version), min_points)
            for version, rows in changes
        ]
        return np.concatenate([np.empty(0, np.int32), *selected])

    def occupied(self, min_points: int = 1) -> npt.NDArray[np.int32]:
        """Return the rows of at least min_points points, one point at least."""
        return self.changed_after(-1, max(min_points, 1))

    def keys_in_box(
        self, low: npt.NDArray[np.int64], high: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.int64]:
        """Return the keys of the voxels with indices from low to high, (3,) each."""
        used = self._hash.rows_used
        return np.asarray(keys_in_box(self.rows.array, used, low, high), np.int64)

    def thinned(self, min_points: int, at_most: int) -> npt.NDArray[np.int32]:
        """Return at most at_most rows of at least min_points points, sorted."""
        used = self._hash.rows_used
        chosen, mixed = np.empty(used, np.int32), np.empty(used, np.uint64)
        num = rows_held(self.rows.array, used, max(min_points, 1), chosen, mixed)
        return np.asarray(chosen[smallest(mixed[:num], at_most)])

    def _add(self, moments: Arrays, start: int, rows: npt.NDArray[np.int32]) -> int:
        """Add moments from a voxel on, as far as there is room; see add_moments."""
        stamps, table = self._stamps.array.reshape(-1), self._hash.arrays
        done: int = add_moments(
            *(moments, self.rows.array, stamps, table),
            *(self._state, stamp_of(self._version), start, rows),
        )
        return done

    def _subtract(
        self, moments: Arrays, rows: npt.NDArray[np.int32], min_points: int
    ) -> tuple[int, npt.NDArray[np.int32]]:
        """Subtract moments without channels; see remove_moments."""
        fallen: npt.NDArray[np.int32] = np.empty((len(rows), 3), np.int32)
        stamps, table = self._stamps.array.reshape(-1), self._hash.arrays
        missing, num_fallen = remove_moments(
            *(moments, self.rows.array, stamps, table),
            *(self._state, stamp_of(self._version), rows, min_points, fallen),
        )
        return missing, fallen[:num_fallen]

    def _make_room(self) -> None:
        """Enlarge the array that had no room for a new voxel."""
        num_rows = len(self.rows.array)
        if not self._hash.lacks_row(num_rows):
            self._hash.grow()
            return
        self._stamps.grow(2 * num_rows)
        if self._channels:
            self._channels.grow(2 * num_rows)
        self.rows.grow(2 * num_rows)  # last: the rows tell how many there are


class ChangeLog:
    """
    Rows changed by the latest versions of a map.

    Parameters
    ----------
    version : int
        Version of the map at the start of the log.

    """

    def __init__(self, version: int) -> None:
        self._entries: deque[Change] = deque()
        self._num_rows = 0
        self._start = version

    def add(self, version: int, rows: npt.NDArray[np.int32], num_voxels: int) -> None:
        """Record the rows that a version changed; drop the oldest entries beyond the capacity."""
        if not len(rows):
            return
        self._entries.append((version, rows))
        self._num_rows += len(rows)
        while self._num_rows > max(LEAST, num_voxels // 4):
            self._start, forgotten = self._entries.popleft()
            self._num_rows -= len(forgotten)

    def forget(self, version: int) -> None:
        """
        Forget all versions up to one that failed and was undone.

        Undoing stamps the rows anew, so that those of earlier versions cannot be told apart.
        """
        self._entries.clear()
        self._num_rows, self._start = 0, version

    def since(
        self, version: int, table: VoxelTable, min_points: int
    ) -> npt.NDArray[np.int32] | None:
        """
        Return the rows of a table of min_points points changed after a version, each once.

        With min_points of 0 emptied rows are included. None if the log does not reach back to
        the version.
        """
        if version < self._start:
            return None
        changes = [*takewhile(lambda change: change[0] > version, reversed(self._entries))]
        return table.changed_at(changes, min_points)


def kernel_arrays(moments: ScanMoments) -> tuple[Arrays, Arrays]:
    """
    Return moments in the types of scans, and the sums that exceed these types.

    The kernels that add and remove take two seconds to compile for each combination of types.
    Sums of a map, int64, are zero in the first result. They follow as total (K, 3) and view
    (K, 3), which ``add_sums`` adds; of a scan there are none.
    """
    key, count, total, product, view = moments.arrays
    count = count.view(np.uint32) if count.dtype == np.int32 else count.astype(np.uint32)
    if total.dtype == np.int32 and view.dtype == np.int16:
        return (key, count, total, product, view), ()
    if not moments.view_is_sum:
        view = view * moments.count[:, None].astype(np.int64)
    sums = np.asarray(total, np.int64), np.ascontiguousarray(view, np.int64)
    zeros = np.zeros((len(key), 3), np.int32), np.zeros((len(key), 3), np.int16)
    return (key, count, zeros[0], product, zeros[1]), sums


def stamp_of(version: int) -> int:
    """Return the stamp of rows that a version changed; see kernels/layout.py."""
    return version << 1 & layout.STAMPS


def smallest(mixed: npt.NDArray[np.uint64], number: int) -> npt.NDArray[np.int64]:
    """Return the sorted indices of the ``number`` smallest values, or of all if fewer."""
    if len(mixed) <= number:
        return np.arange(len(mixed))
    return np.sort(np.argpartition(mixed, number - 1)[:number])
