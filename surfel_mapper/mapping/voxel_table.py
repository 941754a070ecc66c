# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
VoxelTable: the memory of a map, a row of integers for each voxel, found by hash.

Owns the arrays that the kernels work on and enlarges them when a kernel has no room. Rows and
buckets grow without being copied and a full segment of the hash table splits separately, so that
no scan waits while the whole map is rehashed. Divides a scan into parts that threads change at the
same time.

ChangeLog: the rows that the latest versions changed. Without it, asking for changes would look at
the stamp of every row. It holds at most a quarter of the rows: beyond that, reading all stamps in
order is as fast.

(One module because the log is read by means of the stamps of the table.)
"""

from __future__ import annotations

from bisect import bisect_left
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
    find_rows,
    remove_moments,
    restore_moments,
)
from surfel_mapper.mapping.moments import LEAST_SHARED, ScanMoments, STRIPE_BITS
from surfel_mapper.mapping.storage import HashTable, ROWS, Slab
from surfel_mapper.threads import share_parts, together

MAX_DEPTH = 24
"""The directory of the hash table has at most 2^24 entries, enough for 6e9 voxels."""

UNDO_BYTES = 64
"""Memory that undoing takes, bytes a voxel: it is allocated before, and freed for it."""

Part = tuple[int, int, int]
"""The first voxel of a part of a scan, the one after its last, and a stripe that counts for it."""

NO_PART: Part = 0, 0, 0
"""A part without voxels."""

Change = tuple[int, npt.NDArray[np.int32]]
"""A version, and the rows that it changed."""

LEAST = 1 << 18
"""Minimum capacity of the change log, rows; 1 MiB."""


class VoxelTable:
    """
    Rows of voxels and their stamps (kernels/layout.py), and the hash table that finds them.

    Parameters
    ----------
    num_channels : int
        Number of channels that are summed beside the moments, in rows of their own.
    threads : int
        Number of threads that share the work.

    Attributes
    ----------
    rows : Slab
        The rows, 12 int64 each.

    """

    def __init__(self, num_channels: int = 0, threads: int = 1) -> None:
        self.rows = Slab(1024, layout.ROW)
        self._stamps = Slab(1024, 1, np.uint32)
        self._version = 0
        self._channels = Slab(1024, num_channels) if num_channels else None
        self._hash = HashTable(MAX_DEPTH, STRIPE_BITS if threads > 1 else 0)
        self._threads = threads
        self._undoable: set[tuple[np.dtype[Any], ...]] = set()
        self._state = self._hash.state

    @property
    def num_voxels(self) -> int:
        """Number of voxels that hold at least one point."""
        return self._hash.num_keys

    @property
    def num_points(self) -> int:
        """Number of points of all voxels."""
        return sum(self._hash.of_stripes(hashing.POINTS))

    @property
    def nbytes(self) -> int:
        """Bytes in use for voxels and their hash table."""
        slabs = (self.rows, self._stamps, self._channels)
        row_bytes = sum(slab.row_bytes for slab in slabs if slab)
        return self._hash.num_rows_used * row_bytes + self._hash.nbytes

    def add(self, moments: ScanMoments, version: int) -> npt.NDArray[np.int32]:
        """
        Add moments to their voxels; return the row of each.

        Raises
        ------
        MapLimitError
            If there is no memory for the voxels.

        The table is unchanged after any exception, including a failed allocation anywhere, and
        if there is no memory at all from then on.

        """
        found = np.empty(len(moments), np.int32)
        found.fill(-1)  # np.full takes 10 us more in a cold cache
        reserve = np.empty(len(moments) * UNDO_BYTES, np.uint8)
        try:
            self._add(moments, version, found)
            if self._channels:
                self._channels.array[found.astype(np.intp)] += moments.channels
        except BaseException:
            del reserve
            self._undo_add(moments, version, found)
            raise
        return found

    def find(self, key: npt.NDArray[np.int64]) -> npt.NDArray[np.int32]:
        """Return the row of each voxel key, -1 if not found."""
        found = np.empty(len(key), np.int32)
        find_rows(key, self.rows.array, self._hash.arrays, self._state, found)
        return found

    def remove(
        self, moments: ScanMoments, version: int, min_points: int = 1
    ) -> tuple[int, npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """
        Subtract moments from their voxels, or nothing if one does not hold them.

        The table is unchanged after any exception, as after one of ``add``.

        Returns
        -------
        missing : int
            The first voxel that does not hold its moments, or -1.
        rows : (K,) int32
            The row of each voxel.
        fallen : (E, 3) int32
            The indices of the voxels that fell below min_points.

        """
        if moments.rows is None or len(moments.rows) != len(moments):
            rows = self.find(moments.key)
        else:
            rows = np.array(moments.rows, np.int32)  # hints, confirmed by the kernel
        before = self._hash.of_stripes(hashing.POINTS)
        kind = moments.count.dtype, moments.total.dtype, moments.view.dtype
        if kind not in self._undoable:  # compile it while there is memory
            self._restore(moments, version, rows, NO_PART)
            self._undoable.add(kind)
        try:
            missing, fallen = self._subtract(moments, version, rows, min_points)
            if missing >= 0:
                self._undo_subtract(moments, version, rows, before)
            elif self._channels:
                self._channels.array[rows.astype(np.intp)] -= moments.channels
        except BaseException:
            self._undo_subtract(moments, version, rows, before)
            raise
        return missing, rows, fallen

    def checked(self, rows: npt.ArrayLike) -> npt.NDArray[np.int32]:
        """Return rows (K,) as the kernels take them; IndexError if the table does not have one."""
        found = as_array('rows', rows)
        if found.ndim != 1 or found.dtype.kind != 'i':
            raise IndexError(f'rows: {found.dtype} {found.shape}, expected those of find')
        last = self._hash.rows_used - 1
        if len(found) and not 0 <= found.min() <= found.max() <= last:
            raise IndexError(
                f'rows {found.min()} to {found.max()}, expected 0 to {last}; find returns -1 for '
                'voxels that are not in the map'
            )
        return found.astype(np.int32, copy=False)

    def keys(self, chosen: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        """
        Return the voxel keys of some rows, (K,).

        With indices of another width than intp NumPy (2.4) may end the process when memory runs
        out, both in reading and in assigning.
        """
        found: npt.NDArray[np.int64] = self.rows.array[chosen.astype(np.intp), layout.KEY]
        return found

    def counts(self, chosen: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        """Return the numbers of points of some rows, (K,); 0 for rows of -1."""
        found = np.empty(len(chosen), np.int64)
        read_counts(self.rows.array, chosen, found)
        return found

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
        parts = [np.empty(0, np.int32)] * len(changes)

        def select(part: int) -> None:
            version, rows = changes[part]
            stamp = stamp_of(version)
            parts[part] = rows_changed_at(self.rows.array, stamps, rows, stamp, min_points)

        is_large = sum(len(rows) for _, rows in changes) >= LEAST_SHARED
        share_parts(select, range(len(changes)), self._threads if is_large else 1)
        return np.concatenate([np.empty(0, np.int32), *parts])

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

    def _parts(self, moments: ScanMoments) -> npt.NDArray[np.int64]:
        """Return the parts of the voxels that threads may change at the same time, (P, 3)."""
        if self._threads == 1 or moments.stripes is None:
            return np.array([[0, len(moments), 0]])
        return moments.stripes

    def _add(self, moments: ScanMoments, version: int, found: npt.NDArray[np.int32]) -> None:
        """Add moments without channels; write the row of each voxel to found once it is added."""
        self._version = version
        parts = self._parts(moments).copy()
        while len(parts):
            self._add_parts(moments, version, parts, found)
            parts = parts[parts[:, 0] < parts[:, 1]]
            if len(parts):
                self._make_room()

    def _add_parts(
        self,
        moments: ScanMoments,
        version: int,
        parts: npt.NDArray[np.int64],
        found: npt.NDArray[np.int32],
    ) -> None:
        """Add parts of moments as far as there is room; see add_moments."""
        claims = np.zeros(1, np.int64)

        def add() -> None:
            stamps, table = self._stamps.array.reshape(-1), self._hash.arrays
            add_moments(
                *(moments.arrays, moments.view_is_sum, self.rows.array, stamps, table),
                *(self._state, stamp_of(version), parts, claims, found),
            )

        together(add, self._threads if len(parts) > 1 else 1)

    def _undo_add(self, moments: ScanMoments, version: int, found: npt.NDArray[np.int32]) -> None:
        """Subtract the moments that an incomplete ``add`` added; channels are added last."""
        for start, stop, _ in self._parts(moments).tolist():
            end = bisect_left(found, True, start, stop, key=lambda row: row < 0)
            if end > start:
                added = slice(start, end)
                self._subtract(moments.select(added), version, found[added], 1)

    def _subtract(
        self,
        moments: ScanMoments,
        version: int,
        found: npt.NDArray[np.int32],
        min_points: int,
    ) -> tuple[int, npt.NDArray[np.int32]]:
        """
        Subtract moments without channels; see remove_moments.

        Of several parts those that have all their voxels are subtracted even if another has not.
        """
        self._version = version
        parts, claims = self._parts(moments), np.zeros(1, np.int64)
        ends, least = np.zeros((len(parts), 2), np.int64), max(min_points, 1)
        fallen: npt.NDArray[np.int32] = np.empty((len(moments), 3), np.int32)

        def subtract() -> None:
            stamps, table = self._stamps.array.reshape(-1), self._hash.arrays
            remove_moments(
                *(moments.arrays, moments.view_is_sum, self.rows.array, stamps, table),
                *(self._state, stamp_of(version), parts, claims, found, least, fallen, ends),
            )

        together(subtract, self._threads if len(parts) > 1 else 1)
        if len(parts) == 1:
            return int(ends[0, 0]), fallen[: ends[0, 1]]
        missing = [voxel for voxel in ends[:, 0].tolist() if voxel >= 0]
        fell = [fallen[first:][:num] for first, num in zip(parts[:, 0], ends[:, 1], strict=True)]
        return missing[0] if missing else -1, np.concatenate(fell)

    def _undo_subtract(
        self,
        moments: ScanMoments,
        version: int,
        found: npt.NDArray[np.int32],
        before: list[int],
    ) -> None:
        """
        Add the moments that an incomplete ``remove`` subtracted; channels are subtracted last.

        Parameters
        ----------
        moments, version
            As for ``remove``.
        found : (K,) int32
            Rows of the voxels.
        before : list of int
            Number of points that each stripe had counted before.

        """
        now = self._hash.of_stripes(hashing.POINTS)
        for start, stop, stripe in self._parts(moments).tolist():
            if now[stripe] < before[stripe]:
                self._restore(moments, version, found, (start, stop, stripe))

    def _restore(
        self,
        moments: ScanMoments,
        version: int,
        found: npt.NDArray[np.int32],
        part: Part,
    ) -> None:
        """Add the moments of a part again that was subtracted, without channels."""
        restore_moments(
            moments.arrays,
            moments.view_is_sum,
            self.rows.array,
            self._stamps.array.reshape(-1),
            self._hash.arrays,
            self._state,
            stamp_of(version),
            part,
            found,
        )

    def _make_room(self) -> None:
        """Give rows to the stripes, or enlarge the array that had no room for a new voxel."""
        if not self._hash.lacks_row():
            self._hash.grow()
            return
        num_rows = len(self.rows.array)
        first = self._hash.rows_given
        self._stamps.array[first : first + (ROWS << STRIPE_BITS)] = layout.EMPTIED
        if not self._hash.give_rows(num_rows):
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


def stamp_of(version: int) -> int:
    """Return the stamp of rows that a version changed; see kernels/layout.py."""
    return version << 1 & layout.STAMPS


def smallest(mixed: npt.NDArray[np.uint64], number: int) -> npt.NDArray[np.int64]:
    """Return the sorted indices of the ``number`` smallest values, or of all if fewer."""
    if len(mixed) <= number:
        return np.arange(len(mixed))
    return np.sort(np.argpartition(mixed, number - 1)[:number])
