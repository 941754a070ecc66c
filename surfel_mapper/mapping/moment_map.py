# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
MomentMap: the exact moments of voxels, which scans enter and leave.

A voxel is a row of integers in a slab: count, sum and second moment of its points in units of
voxel_size / 65536 about the voxel centre, and the sum of the directions to the sensor. A second
slab counts its scans, which the digest does not cover. Adding a
scan is integer addition and removing it integer subtraction, so that after any sequence of both
the map equals, bit for bit, the map of the remaining scans. With float32 moments the smallest
eigenvalue is 2.5 to 6 % off at 1 km after 1e5 cycles.

Limits: voxel indices within 21 signed bits an axis (524 km each way at 0.5 m), 2^23 points of a
scan in a voxel, 2^31 points of the map in a voxel.

VoxelTable owns the arrays that the kernels work on and enlarges them when a kernel has no room.
Rows and buckets grow without being copied and a full segment of the hash table splits separately:
no scan waits while the whole map is rehashed.

ChangeLog holds the rows that the latest versions changed. Without it, asking for changes would
look at the stamp of every row. It holds at most a quarter of the rows: beyond that, reading all
stamps in order is as fast.

Points are reduced to moments and surfels derived from them in ``SurfelMap`` (surfel_map.py).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_array, as_numbers, as_whole
from surfel_mapper.errors import counted, MapError, MapLimitError, NotInMapError
from surfel_mapper.kernels import hashing, layout
from surfel_mapper.mapping.channels import channel_names
from surfel_mapper.mapping.kernels.queries import keys_in_box
from surfel_mapper.mapping.kernels.rows import read_counts, read_rows
from surfel_mapper.mapping.kernels.voxels import (
    add_moments,
    add_sums,
    find_rows,
    remove_moments,
    rows_changed_after,
    rows_changed_at,
)
from surfel_mapper.mapping.moments import (
    check_arrays,
    check_possible,
    digest_of,
    pack_keys,
    ScanMoments,
    shifted_moments,
    whole_keys,
    within_reach,
)
from surfel_mapper.mapping.storage import HashTable, Slab

MAX_LEVEL = 15
"""Highest level: a voxel can hold 2^31 / 4^15 = 2 points, of the next no point."""

APART = 1e-3
"""Rounding of the distance of two origins, voxels: their coordinates have at most 16 digits."""

MAX_DEPTH = 24
"""The directory of the hash table has at most 2^24 entries, enough for 6e9 voxels."""

Change = tuple[int, npt.NDArray[np.int32]]
"""A version, and the rows that it changed."""

Arrays = tuple[npt.NDArray[Any], ...]
"""Moments as the kernels take them."""

LEAST = 1 << 18
"""Minimum capacity of the change log, rows; 1 MiB."""

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio, odd."""


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
    stamps : Slab
        Stamps and numbers of scans of the rows, 2 uint32 each.

    """

    def __init__(self, num_channels: int = 0) -> None:
        self.rows = Slab(1024, layout.ROW)
        self.stamps = Slab(1024, layout.STAMP_ROW, np.uint32)
        self._version = 0
        self._channels = Slab(1024, num_channels) if num_channels else None
        self._hash = HashTable(MAX_DEPTH)
        self.state = self._hash.state

    @property
    def nbytes(self) -> int:
        """Bytes in use for voxels and their hash table."""
        slabs = (self.rows, self.stamps, self._channels)
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
            while True:
                slab, stamps, table = self.rows.array, self.stamps.array, self._hash.arrays
                num_added = add_moments(
                    *(arrays, slab, stamps.reshape(-1), table),
                    *(self.state, stamp_of(version), num_added, rows),
                )
                if num_added == len(moments):
                    break
                del slab, stamps, table  # views would pin the memory
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
        find_rows(key, self.rows.array, self._hash.arrays, self.state, rows)
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

    def num_scans(
        self, chosen: npt.NDArray[Any], count: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.int64]:
        """
        Return the numbers of scans of some rows of ``count`` points, (K,), 1 to count.

        A number would be beyond if scans were removed in other pieces than they were added in.
        """
        num_scans = self.stamps.array[chosen.astype(np.intp), layout.SCANS].view(np.int32)
        return np.asarray(np.clip(num_scans, 1, count), np.int64)

    @property
    def rows_used(self) -> int:
        """Number of rows ever used."""
        return self._hash.rows_used

    @property
    def channel_sums(self) -> npt.NDArray[np.int64]:
        """The channel sums of all rows, (R, C)."""
        if not self._channels:
            return np.empty((len(self.rows.array), 0), np.int64)
        return self._channels.array

    def changed_after(self, version: int, min_points: int) -> npt.NDArray[np.int32]:
        """
        Return the rows of at least min_points points that were changed after a version.

        With min_points of 0 emptied rows are included.
        """
        stamps, used = self.stamps.array.reshape(-1), self._hash.rows_used
        stamp, changes = stamp_of(self._version), self._version - version
        rows = rows_changed_after(self.rows.array, stamps, used, stamp, changes, min_points)
        return np.asarray(rows)

    def changed_at(self, changes: Sequence[Change], min_points: int) -> npt.NDArray[np.int32]:
        """
        Return the rows that were last changed by one of some changes, (K,), each once.

        Rows of fewer than min_points points are left out.
        """
        stamps, selected = self.stamps.array.reshape(-1), [np.empty(0, np.int32)]
        for version, rows in changes:
            stamp = stamp_of(version)
            selected.append(rows_changed_at(self.rows.array, stamps, rows, stamp, min_points))
        return np.concatenate(selected)

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
        """
        Return at most at_most rows of at least min_points points, sorted.

        They are those of the smallest mixed keys, so the choice does not depend on the order of
        insertion, and most rows stay chosen as the map grows.
        """
        rows = self.occupied(min_points)
        if len(rows) <= at_most:
            return rows
        mixed = self.keys(rows).view(np.uint64)
        for _ in range(2):  # afterwards neighbouring voxels differ in all bits
            mixed = mixed * GOLDEN
            mixed ^= mixed >> np.uint64(29)
        return np.sort(rows[np.argpartition(mixed * GOLDEN, at_most)[:at_most]])

    def _subtract(
        self, moments: Arrays, rows: npt.NDArray[np.int32], min_points: int
    ) -> tuple[int, npt.NDArray[np.int32]]:
        """Subtract moments without channels; see remove_moments."""
        fallen: npt.NDArray[np.int32] = np.empty((len(rows), 3), np.int32)
        stamps, table = self.stamps.array.reshape(-1), self._hash.arrays
        missing, num_fallen = remove_moments(
            *(moments, self.rows.array, stamps, table),
            *(self.state, stamp_of(self._version), rows, min_points, fallen),
        )
        return missing, fallen[:num_fallen]

    def _make_room(self) -> None:
        """Enlarge the array that had no room for a new voxel."""
        num_rows = len(self.rows.array)
        if not self._hash.lacks_row(num_rows):
            self._hash.grow()
            return
        self.stamps.grow(2 * num_rows)
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
        changes = []
        for change in reversed(self._entries):
            if change[0] <= version:
                break
            changes.append(change)
        return table.changed_at(changes, min_points)


def kernel_arrays(moments: ScanMoments) -> tuple[Arrays, Arrays]:
    """
    Return moments in the types of scans, and the sums that exceed these types.

    The kernels that add and remove take two seconds to compile for each combination of types.
    Sums of a map, int64, are zero in the first result. They follow as total (K, 3) and view
    (K, 3), which ``add_sums`` adds; of a scan there are none.
    """
    key, product, total, view = moments.key, moments.product, moments.total, moments.view
    count = moments.count
    count = count.view(np.uint32) if count.dtype == np.int32 else count.astype(np.uint32)
    scans: npt.NDArray[np.uint32] = np.ones(len(key), np.uint32)
    if moments.num_scans is not None:
        scans = moments.num_scans.astype(np.uint32)
    if total.dtype == np.int32 and view.dtype == np.int16:
        return (key, count, total, product, view, scans), ()
    if not moments.view_is_sum:
        view = view * moments.count[:, None].astype(np.int64)
    sums = np.asarray(total, np.int64), np.ascontiguousarray(view, np.int64)
    zeros = np.zeros((len(key), 3), np.int32), np.zeros((len(key), 3), np.int16)
    return (key, count, zeros[0], product, zeros[1], scans), sums


def stamp_of(version: int) -> int:
    """Return the stamp of rows that a version changed; see kernels/layout.py."""
    return version << 1 & layout.STAMPS


class MomentMap:
    """
    Moments of voxels: insert and remove, exactly; the part of SurfelMap that holds the state.

    Parameters
    ----------
    voxel_size_m : float
        Edge of a voxel, m.
    columns : tuple of str
        Columns of the points whose sums are kept: ``intensity``, ``rgb``.
    level : int
        The lattice unit is ``voxel_size_m / 2^(16 + level)``.
    origin_m : (3,) float, m
        Place of the origin of the map in an outer frame.

    Errors are those of SurfelMap.

    """

    def __init__(
        self,
        voxel_size_m: float,
        columns: tuple[str, ...],
        level: int,
        origin_m: npt.ArrayLike,
    ) -> None:
        if as_whole('level', level) not in range(MAX_LEVEL + 1):
            raise ValueError(f'level: {level}, expected 0 to {MAX_LEVEL}')
        self.voxel_size_m = voxel_size_m
        self.level = int(level)
        self.origin_m = origin_m
        self.version = 0
        self.columns = columns
        self._channel_names = channel_names(columns)
        self._reset()

    def _reset(self) -> None:
        self._table = VoxelTable(len(self._channel_names))
        self._changes = ChangeLog(self.version)
        self.cleared_at = self.version

    def __len__(self) -> int:
        """Return the number of voxels."""
        return self.num_voxels

    @property
    def origin_m(self) -> npt.NDArray[np.float64]:
        """Place of the origin of the map in the outer frame, (3,) m."""
        return self._origin_m

    @origin_m.setter
    def origin_m(self, value: npt.ArrayLike) -> None:
        origin: npt.NDArray[np.float64] = as_numbers('origin_m', value).copy()
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise ValueError(f'origin_m: {origin.tolist()}, expected x y z, finite')
        origin.setflags(write=False)
        self._origin_m = origin

    @property
    def num_voxels(self) -> int:
        """Number of voxels that hold at least one point."""
        return int(self._table.state[hashing.VOXELS])

    @property
    def num_points(self) -> int:
        """Number of points in the map."""
        return int(self._table.state[hashing.POINTS])

    @property
    def nbytes(self) -> int:
        """Size of voxels and hash table in use, bytes."""
        return self._table.nbytes

    @property
    def rows_used(self) -> int:
        """Number of rows ever used."""
        return self._table.rows_used

    @property
    def slabs(self) -> Arrays:
        """Rows (R, 12), stamps (R, 2) and channel sums (R, C); valid until the map changes."""
        table = self._table
        return table.rows.array, table.stamps.array, table.channel_sums

    def insert(self, moments: ScanMoments) -> None:
        """
        Add moments.

        Raises
        ------
        MapError
            If their voxel size differs, no points can have these moments, or a voxel would hold
            more than 2^31 points (2^31 / 4^level in a coarser map). Nothing is changed.

        """
        self._check_lattice(moments)
        limit = layout.MAX_MAP_COUNT >> (2 * self.level)
        if self._table.state[hashing.POINTS] + moments.num_points > limit:
            self._check_counts(moments, limit)  # before the sums, which overflow beyond it
        if moments.num_reduced is None:
            check_possible(moments)
        self.version += 1
        try:
            rows = self._table.add(moments, self.version)
        except BaseException:
            self._changes.forget(self.version)
            raise
        self._changes.add(self.version, rows, self.num_voxels)
        object.__setattr__(moments, 'rows', rows)

    def remove(self, moments: ScanMoments, min_points: int = 1) -> npt.NDArray[np.int32]:
        """
        Subtract moments that were added before: the exact inverse.

        Parameters
        ----------
        moments : ScanMoments
            Moments that ``add`` returned.
        min_points : int
            Number of points of a surfel, for the result.

        Returns
        -------
        (E, 3) int32
            Indices of the voxels that held at least ``min_points`` before and hold fewer now.

        Raises
        ------
        MapError
            If their voxel size differs, or no points can have these moments.
        NotInMapError
            If a voxel holds fewer points, or equally many with other sums. Nothing is changed.
            Moments that were never added are detected unless every one of their voxels holds
            more points of other scans.

        """
        self._check_lattice(moments)
        if moments.num_reduced is None:
            check_possible(moments)
        if type(min_points) is not int:
            min_points = as_whole('min_points', min_points)
        self.version += 1
        try:
            missing, rows, fallen = self._table.remove(moments, self.version, min_points)
        except BaseException:
            self._changes.forget(self.version)
            raise
        if missing >= 0:
            self._changes.forget(self.version)
            index = moments.voxel_index[missing].tolist()
            raise NotInMapError(
                f'voxel {index} does not hold the {moments.count[missing]} points to be '
                'removed; were these moments added to this map, and only removed once?'
            )
        self._changes.add(self.version, rows, self.num_voxels)
        return fallen

    def merge(self, other: MomentMap) -> None:
        """
        Add all points of another map of equal voxel size: the exact union.

        Raises
        ------
        MapError
            If the voxel sizes differ, the origins are not a whole number of voxels apart, or a
            voxel would hold too many points; see ``insert``.

        """
        self.insert(self._moments_here(other))

    def subtract(self, other: MomentMap) -> None:
        """
        Remove all points of another map of equal voxel size: the exact inverse of ``merge``.

        Raises
        ------
        MapError
            If the voxel sizes differ.
        NotInMapError
            If this map does not hold all of them. Nothing is changed.

        """
        self.remove(self._moments_here(other))

    def _moments_here(self, other: MomentMap) -> ScanMoments:
        """Return the moments of another map in the voxels of this one."""
        if not isinstance(other, MomentMap):
            raise TypeError(f'a {type(other).__name__}, expected another SurfelMap')
        moments = other.moments()
        if np.array_equal(self.origin_m, other.origin_m):
            return moments
        apart = (other.origin_m - self.origin_m) / self.voxel_size_m
        voxels = np.rint(apart)
        if np.abs(apart - voxels).max() > APART:
            raise MapError(
                f'map with origin_m {other.origin_m.tolist()}, expected one a whole number of '
                f'voxels of {self.voxel_size_m:g} m from {self.origin_m.tolist()}'
            )
        return shifted_moments(moments, voxels.astype(np.int64))

    def __eq__(self, other: object) -> bool:
        """Return whether two maps are equal, to the bit, and have one origin."""
        if not isinstance(other, MomentMap):
            return NotImplemented
        if not np.array_equal(self.origin_m, other.origin_m):
            return False
        return self.num_voxels == other.num_voxels and self.digest() == other.digest()

    __hash__ = None  # type: ignore[assignment]  # a map is mutable

    def moments(self, voxel_index: npt.NDArray[Any] | None = None) -> ScanMoments:
        """
        Return the exact moments of voxels, sorted by voxel; a copy.

        Parameters
        ----------
        voxel_index : (K, 3) int, optional
            The voxels; those that the map does not contain are skipped. By default all.

        Raises
        ------
        ValueError
            If the voxels are not integers (K, 3).

        """
        if voxel_index is None:
            chosen = self._table.occupied()
            return self._moments_of(chosen[np.argsort(self._table.keys(chosen))])
        index = as_array('voxel_index', voxel_index)
        if index.dtype.kind not in 'iu' or index.ndim != 2 or index.shape[1] != 3:
            kind = f'{index.dtype} {index.shape}'
            raise ValueError(f'voxel_index: {kind}, expected integers (K, 3)')
        keys = np.unique(pack_keys(index[within_reach(index)]))  # in this order: by voxel
        chosen = self._table.find(keys)
        return self._moments_of(chosen[chosen >= 0])

    def _moments_of(self, chosen: npt.NDArray[Any]) -> ScanMoments:
        """Return the moments of rows, in the given order; a copy."""
        shapes = ((), (), (3,), (6,), (3,))
        arrays = tuple(np.empty((len(chosen), *shape), np.int64) for shape in shapes)
        read_rows(self._table.rows.array, chosen, arrays)
        key, count, total, product, view = arrays
        return ScanMoments(
            num_scans=self._table.num_scans(chosen, count),
            voxel_size_m=self.voxel_size_m,
            level=self.level,
            key=key,
            count=count,
            total=total,
            product=product,
            view=view,
            channel_names=self._channel_names,
            channels=self._table.channels(chosen),
        )

    def digest(self) -> str:
        """
        Return the SHA-256 of the state in hexadecimal.

        It covers voxel size, level, voxel indices and integer moments, sorted by voxel: equal
        digests mean equal maps, independent of the order of insertion. ``digest_of`` in
        mapping/moments.py specifies the hashed bytes.

        """
        moments = self.moments()
        return digest_of(
            self.voxel_size_m,
            self.level,
            len(moments),
            self.columns,
            lambda name: [getattr(moments, name)],
        )

    def keys(self, min_points: int = 1) -> npt.NDArray[np.int64]:
        """Return the keys (K,) of the voxels of at least min_points points, in any order."""
        return self._table.keys(self._table.occupied(as_whole('min_points', min_points)))

    def keys_within(
        self, low: npt.NDArray[np.int64], high: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.int64]:
        """Return the keys (K,) of the voxels with indices from low to high (3,), in any order."""
        return self._table.keys_in_box(low, high)

    def find(self, key: npt.NDArray[np.int64]) -> npt.NDArray[np.int32]:
        """Return the row of each voxel key (K,), -1 if not found; valid until the map changes."""
        return self._table.find(whole_keys(key))

    def keys_of(self, rows: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
        """Return the voxel keys of rows (K,), -1 for empty rows."""
        rows = self._table.checked(rows)
        return np.where(self._table.counts(rows) > 0, self._table.keys(rows), -1)

    def rows_changed(self, since: int) -> npt.NDArray[np.int32]:
        """
        Return the rows (K,) that changed after a version, each once, including emptied ones.

        Rows from before the map was cleared (``cleared_at``, a version) are not included.
        """
        since = as_whole('since', since)
        changed = self._changes.since(since, self._table, 0)
        return self._table.changed_after(since, 0) if changed is None else changed

    def clear(self) -> None:
        """Remove all voxels."""
        self.version += 1
        self._reset()

    def __repr__(self) -> str:
        """Return size and counts of the map."""
        level = f', level {self.level}' if self.level else ''
        return (
            f'SurfelMap({self.voxel_size_m:g} m{level}: {counted(self.num_points, "point")} in '
            f'{counted(self.num_voxels, "voxel")})'
        )

    def _check_lattice(self, moments: ScanMoments) -> None:
        if not isinstance(moments, ScanMoments):
            raise TypeError(
                f'a {type(moments).__name__}, expected the ScanMoments that add or reduce '
                'returned; points are added by add'
            )
        if (moments.voxel_size_m, moments.level) != (self.voxel_size_m, self.level):
            raise MapError(
                f'moments of voxel size {moments.voxel_size_m:g} m, level {moments.level}; '
                f'this map has {self.voxel_size_m:g} m, level {self.level}'
            )
        if moments.num_reduced is None:
            check_arrays(moments)
        if moments.channel_names != self._channel_names:
            raise MapError(
                f'moments with the channels {moments.channel_names}; '
                f'this map has {self._channel_names}'
            )

    def _check_counts(self, moments: ScanMoments, limit: int) -> None:
        """Raise MapLimitError if a voxel would hold more points than the integers allow."""
        rows = self._table.find(moments.key)
        largest = int((self._table.counts(rows) + moments.count).max(initial=0))
        if largest > limit:
            raise MapLimitError(
                f'a voxel would hold {largest} points; at most {limit}: use smaller voxels '
                'or a window'
            )
