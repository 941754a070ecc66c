# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
VoxelTable: the memory of a map, one row of integers a voxel, found by hash.

Owns the arrays that the kernels work on and makes them larger when a kernel asks for room. Rows
and buckets grow without being copied and a full part of the hash table splits on its own, so
that no scan waits for the whole map.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import MapLimitError
from surfel_mapper.kernels import hashing, layout
from surfel_mapper.kernels.queries import keys_in_box
from surfel_mapper.mapping.hash_table import HashTable
from surfel_mapper.mapping.kernels.surfels import rows_changed_after
from surfel_mapper.mapping.kernels.thinning import rows_held
from surfel_mapper.mapping.kernels.voxels import (
    add_moments,
    find_rows,
    first_missing,
    subtract_moments,
)
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.slab import Slab
from surfel_mapper.mapping.thinning import smallest

MAX_DEPTH = 24
"""The directory of the hash table has at most 2^24 entries, enough for 6e9 voxels."""


class VoxelTable:
    """
    Rows of voxels, laid out as kernels/layout.py says, and the hash table that finds them.

    Parameters
    ----------
    num_channels : int
        Channels that are summed beside the moments, in rows of their own.

    """

    def __init__(self, num_channels: int = 0) -> None:
        """Make an empty table."""
        self._rows = Slab(1024, layout.ROW)
        self._channels = Slab(1024, num_channels) if num_channels else None
        self._hash = HashTable(MAX_DEPTH)
        self._state = self._hash.state

    @property
    def rows(self) -> npt.NDArray[np.int64]:
        """The rows, (R, 16) int64; only until the table grows."""
        return self._rows.array

    @property
    def num_voxels(self) -> int:
        """Voxels that hold at least one point."""
        return self._hash.num_keys

    @property
    def num_points(self) -> int:
        """Points of all voxels."""
        return int(self._state[hashing.POINTS])

    @property
    def nbytes(self) -> int:
        """Bytes in use for voxels and their hash table."""
        width = layout.ROW + (self._channels.array.shape[1] if self._channels else 0)
        return self._hash.rows_used * width * 8 + self._hash.nbytes

    def add(self, moments: ScanMoments, version: int) -> npt.NDArray[np.int32]:
        """
        Add moments to their voxels; return the rows changed, each once.

        Raises
        ------
        MapLimitError
            If there is no room for the voxels; the table holds what it held before.

        """
        changed = np.empty(len(moments), np.int32)
        self._state[hashing.CHANGED] = 0
        done = 0
        while done < len(moments):
            done = add_moments(
                moments.arrays,
                moments.view_is_sum,
                self.rows,
                self._hash.arrays,
                self._state,
                version,
                done,
                changed,
            )
            if done < len(moments):
                self._make_room_or_undo(moments.select(slice(done)), version)
        if self._channels:
            if len(self._channels.array) < len(self.rows):
                self._channels.grow(len(self.rows))
            self._channels.array[self.find(moments.key)] += moments.channels
        return changed[: self._state[hashing.CHANGED]]

    def find(self, key: npt.NDArray[np.int64]) -> npt.NDArray[np.int32]:
        """Return the row of each voxel key, -1 where there is none."""
        found = np.empty(len(key), np.int32)
        find_rows(key, self.rows, self._hash.arrays, self._state, found)
        return found

    def first_missing(self, moments: ScanMoments, found: npt.NDArray[np.int32]) -> int:
        """Return the first voxel that does not hold its moments in its row found, or -1."""
        return int(first_missing(moments.arrays, moments.view_is_sum, self.rows, found))

    def subtract(
        self,
        moments: ScanMoments,
        version: int,
        found: npt.NDArray[np.int32],
        min_points: int = 1,
    ) -> npt.NDArray[np.int64]:
        """Subtract moments from the rows found; return the keys that fell below min_points."""
        fallen = np.empty(len(moments), np.int64)
        num_fallen = subtract_moments(
            moments.arrays,
            moments.view_is_sum,
            self.rows,
            self._hash.arrays,
            self._state,
            version,
            found,
            max(min_points, 1),
            fallen,
        )
        if self._channels:
            self._channels.array[found] -= moments.channels
        return fallen[:num_fallen]

    def channels(self, chosen: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        """Return the sums of the channels of some rows, (K, C)."""
        if not self._channels:
            return np.empty((len(chosen), 0), np.int64)
        return np.asarray(self._channels.array[chosen])

    def changed_after(self, version: int, min_points: int) -> npt.NDArray[Any]:
        """Return the rows changed after a version that hold at least so many points."""
        used = self._hash.rows_used
        return np.asarray(rows_changed_after(self.rows, used, version, max(min_points, 1)))

    def emptied_or_changed_after(self, version: int) -> npt.NDArray[Any]:
        """Return the rows changed after a version, those that hold no points any more too."""
        return np.asarray(rows_changed_after(self.rows, self._hash.rows_used, version, 0))

    def keys_in_box(
        self, low: npt.NDArray[np.int64], high: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.int64]:
        """Return the keys of the voxels with indices from low to high, (3,) each."""
        used = self._hash.rows_used
        return np.asarray(keys_in_box(self.rows, used, low, high), np.int64)

    def thinned(self, min_points: int, at_most: int) -> npt.NDArray[np.int32]:
        """Return the rows with at least so many points, or of more than at_most some; sorted."""
        used = self._hash.rows_used
        chosen, mixed = np.empty(used, np.int32), np.empty(used, np.uint64)
        num = rows_held(self.rows, used, max(min_points, 1), chosen, mixed)
        return np.asarray(chosen[smallest(mixed[:num], at_most)])

    def _make_room_or_undo(self, added: ScanMoments, version: int) -> None:
        """Make room for one more voxel; if that fails, take out again what was added."""
        try:
            self._make_room()
        except MapLimitError:
            if self._channels:  # they would have been added last
                added = replace(added, channels=np.zeros_like(added.channels))
            self.subtract(added, version, self.find(added.key))
            raise

    def _make_room(self) -> None:
        """Enlarge what kept add_moments from placing a new voxel."""
        if self._hash.lacks_row(len(self.rows)):
            self._rows.grow(2 * len(self.rows))
        else:
            self._hash.grow()
