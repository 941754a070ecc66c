# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Storage of a distance field: a hash table of blocks of M x M x M voxels.

Block (a, b, c) spans from (a, b, c) * M * voxel_size_m to the next. Voxel (i, j, k) of it has the
number i + M (j + M k), x fastest, N = M^3 in all, and its centre at
((a, b, c) * M + (i, j, k) + 0.5) * voxel_size_m. Row r of every array belongs to one block:

    head    (R, 8) int64       key, version, stamp of the last change, ...; see kernels/blocks.py
    field   (R, 2, N) float32  distance in m, positive in front of a surface and negative behind
                               it; weight, 0 for a voxel that was never observed
    color   (R, 4, N) float32  red, green, blue in [0, 255]; weight of the colour
    votes   (R, 2, N) float32  for labels, see kernels/channels.py

color and votes have no rows unless the configuration asks for them. All arrays are slabs
that grow in place: a view is valid until blocks are added and must not be kept. The row of a
removed block is reused; free rows are zero except for their head.

``version`` counts the changes of the map. To follow them, keep the last version seen and ask
``changed_since`` for the rows, or ``moved_since`` for those whose triangles moved by more than
VISIBLE_VOXELS since, or changed in number.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import logging
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import MapLimitError
from surfel_mapper.kernels.layout import INDEX_BITS, INDEX_MASK, INDEX_OFFSET, KEY
from surfel_mapper.mapping.storage import HashTable, Slab
from surfel_mapper.memory import machine_bytes
from surfel_mapper.tsdf.kernels.blocks import (
    DRIFT,
    find_blocks,
    FREE,
    FREE_VISITS,
    HEAD,
    INSIDE,
    NEW,
    place_blocks,
    remove_blocks,
    STAMP,
    SURFACE,
    VERSION,
)
from surfel_mapper.tsdf.kernels.integration import INSIDE as BEHIND
from surfel_mapper.tsdf.kernels.integration import MOVED, SOLID

logger = logging.getLogger(__name__)

Int64 = npt.NDArray[np.int64]
Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """
    Content of blocks outside of a map: copied, or to be inserted.

    Attributes
    ----------
    index : (K, 3) int64
        Block index along x, y, z.
    stamp_ns : (K,) int64
        Stamp of the last change of each block, ns.
    field, color, votes
        As in the module docstring, one row a block.

    """

    index: Int64
    stamp_ns: Int64
    field: Float32
    color: Float32
    votes: Float32

    def __len__(self) -> int:
        """Return the number of blocks."""
        return len(self.index)


def copied_rows(array: npt.NDArray[Any], rows: Int64) -> Any:
    """Return a copy of rows; an empty array if the channel is not kept."""
    return array[rows] if len(array) else array.copy()


def block_keys(index: npt.NDArray[Any]) -> Int64:
    """Return the keys of blocks, (...,) int64; -1 for an index beyond 20 bits."""
    shifted = index.astype(np.int64) + INDEX_OFFSET
    within = ((shifted >= 0) & (shifted <= INDEX_MASK)).all(axis=-1)
    x, y, z = (shifted[..., axis] for axis in range(3))
    keys: Int64 = np.where(within, x << 2 * INDEX_BITS | y << INDEX_BITS | z, -1)
    return keys


def block_index(keys: Int64) -> Int64:
    """Return the (..., 3) int64 indices of blocks from their keys."""
    shifts = np.array([2 * INDEX_BITS, INDEX_BITS, 0])
    index: Int64 = (keys[..., None] >> shifts & INDEX_MASK) - INDEX_OFFSET
    return index


FIRST_ROWS = 128
"""Initial number of rows; a slab of 128 rows fills whole pages for any row width."""


class BlockArrays:
    """
    One row a block in each array that the configuration asks for.

    Parameters
    ----------
    config : TsdfConfig
        Voxels per side and channels of a voxel.

    """

    def __init__(self, config: TsdfConfig) -> None:
        self.config = config
        voxels = self.voxels_per_block
        widths = {  # in int64
            'head': HEAD,
            'field': voxels,
            'color': 2 * voxels * config.color,
            'votes': voxels * (config.semantics != 'none'),
        }
        self._slabs = {name: Slab(FIRST_ROWS, width) for name, width in widths.items() if width}
        self._row_bytes = 8 * sum(widths.values())

    @property
    def voxels_per_block(self) -> int:
        """Number of voxels in a block, N."""
        return self.config.voxels_per_side**3

    @property
    def head(self) -> Int64:
        """Key, version, stamp and further columns, (R, 8); valid until the map grows."""
        return self._slabs['head'].array[:, :HEAD]

    @property
    def field(self) -> Float32:
        """Distance and weight, (R, 2, N); valid until the map grows."""
        return self._floats('field', 2)

    @property
    def distance(self) -> Float32:
        """Signed distances, (R, N) m, a view of field."""
        return self.field[:, 0]

    @property
    def weight(self) -> Float32:
        """Weights, (R, N), 0 for voxels never observed; a view of field."""
        return self.field[:, 1]

    @property
    def color(self) -> Float32:
        """Colours and their weights, (R, 4, N), or no rows."""
        return self._floats('color', 4)

    @property
    def votes(self) -> Float32:
        """Votes for labels, (R, 2, N), or no rows."""
        return self._floats('votes', 2)

    def _floats(self, name: str, width: int) -> Float32:
        if name not in self._slabs:
            return np.empty((0, width, self.voxels_per_block), np.float32)
        flat = self._slabs[name].array.view(np.float32)
        return flat.reshape(-1, width, self.voxels_per_block)

    def _write(self, rows: Int64, blocks: Blocks) -> None:
        """Write the channels of blocks into rows; heads stay."""
        for name in self._slabs.keys() - {'head'}:
            getattr(self, name)[rows] = getattr(blocks, name)

    def _wipe(self, rows: Int64) -> None:
        """Set the channels of rows to zero; heads stay."""
        for name, slab in self._slabs.items():
            if name != 'head':
                slab.array[rows] = 0

    def _grow(self) -> None:
        """Double the number of rows."""
        num_rows = len(self.head)
        for slab in reversed(self._slabs.values()):  # the head last: it counts the rows
            if len(slab.array) < 2 * num_rows:
                slab.grow(2 * num_rows)


MAX_DEPTH = 24
"""Largest depth of the hash table's directory: 2^24 entries, more than 64 million blocks."""

SETTLED, RECHECK = 4, 8
"""
A block that was free in SETTLED measurements in a row is fused in one of RECHECK only.

With a lidar of 10 Hz a block between the beams is complete after a second or two.
"""

MOST_FORGOTTEN = 16
"""A measurement forgets at most 1 / 4 of the half-life: a single false one makes no hole."""

ROOM_KEPT = 0.9
"""Share of the limit that is filled after blocks have left, so that they leave once in a while."""

HASH_BYTES = 32
"""Bytes of the hash table for a block, at most: an entry of 8 in segments filled to a half."""

PART = 1024
"""Blocks whose voxel centres are computed at a time: 12 MB."""

VISIBLE_VOXELS = 0.02
"""Distances may drift by this much, in voxels, before a live mesh follows: 4 mm at 0.2 m."""

UPPER = np.array([(n & 1, n >> 1 & 1, n >> 2) for n in range(8)])
"""Offsets of a block and of the seven that hold the upper corners of its marching cubes."""


class BlockMap(BlockArrays):
    """
    A map of blocks: find, place, touch, evict, copy and insert.

    Parameters
    ----------
    config : TsdfConfig
        Voxel size, voxels per side, channels.

    Attributes
    ----------
    config : TsdfConfig
        The settings.
    version : int
        Number of changes so far.
    max_bytes : int
        Limit of ``nbytes``; 0: none. Half of the memory of the machine by default.
    num_evicted : int
        Number of blocks that left, or were not added, because of it.

    """

    def __init__(self, config: TsdfConfig) -> None:
        super().__init__(config)
        self.version = 0
        self.max_bytes = machine_bytes() // 2
        self.num_evicted = 0
        self._hash = HashTable(MAX_DEPTH)
        self._state = self._hash.state

    @property
    def num_blocks(self) -> int:
        """Number of blocks in the map."""
        return self._hash.num_keys

    @property
    def nbytes(self) -> int:
        """Bytes used by blocks and their hash table."""
        return self._hash.rows_used * self._row_bytes + self._hash.nbytes

    @property
    def lookup(self) -> tuple[Any, ...]:
        """Arrays by which kernels find blocks: head, table, state; valid until the map grows."""
        return self.head, self._hash.arrays, self._state

    def rows(self) -> Int64:
        """Return the rows in use, ascending."""
        return np.flatnonzero(self._used_head()[:, VERSION] != FREE)

    def changed_since(self, version: int) -> Int64:
        """Return the rows of blocks changed after a version of the map, ascending."""
        return np.flatnonzero(self._used_head()[:, VERSION] > version)

    def moved_since(self, version: int) -> Int64:
        """Return the rows of blocks whose triangles changed visibly after a version, ascending."""
        head = self._used_head()
        return np.flatnonzero((head[:, SURFACE] > version) & (head[:, VERSION] != FREE))

    def index(self, rows: Int64) -> Int64:
        """Return the block indices of rows, (K, 3) int64."""
        return block_index(self.head[rows, KEY])

    def find(self, index: npt.ArrayLike) -> Int64:
        """Return the rows of blocks by (..., 3) index, -1 for blocks not in the map."""
        keys = block_keys(np.asarray(index))
        rows = np.empty(keys.size, np.int64)
        find_blocks(keys.ravel(), self.head, self._hash.arrays, self._state, rows)
        return rows.reshape(keys.shape)

    def neighbours(self, rows: Int64, offsets: npt.ArrayLike = UPPER) -> Int64:
        """Return the rows of the blocks at (O, 3) offsets from those in rows, (K, O), or -1."""
        return self.find(self.index(rows)[:, None] + np.asarray(offsets))

    def place(self, index: npt.ArrayLike) -> Int64:
        """
        Return the rows of blocks, adding those that are missing.

        Parameters
        ----------
        index : (K, 3) int
            Block indices.

        Returns
        -------
        (K,) int64
            Rows.

        Raises
        ------
        MapLimitError
            If an index is beyond 20 bits, or memory is short; the map is unchanged.

        """
        keys = block_keys(np.asarray(index))
        if (keys < 0).any():
            raise MapLimitError(
                f'block {np.asarray(index)[keys < 0][0]}: blocks of '
                f'{self.config.block_size_m} m reach {INDEX_OFFSET * self.config.block_size_m} m '
                'from the origin; use a local frame'
            )
        rows = np.full(len(keys), -1, np.int64)
        done = 0
        while done < len(keys):
            done = place_blocks(keys, self.head, self._hash.arrays, self._state, done, rows)
            if done < len(keys):
                try:
                    self._make_room()
                except MapLimitError:
                    self.drop_new(rows[:done])
                    raise
        return rows

    def charge(self, num_bytes: int, cause: str) -> None:
        """Raise MapLimitError if working memory for a scan is beyond ``max_bytes``."""
        if 0 < self.max_bytes < num_bytes:
            raise MapLimitError(
                f'{cause}: {num_bytes} bytes of working memory, but the distance field may use '
                f'{self.max_bytes} (map.max_bytes): use larger voxels, or smaller max_range_m, '
                'carve_m or truncation_m'
            )

    def admit(self, index: Int64, position: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """
        Make room for the blocks of a scan within ``max_bytes``; the farthest blocks leave.

        Parameters
        ----------
        index : (K, 3) int64
            The blocks, each once; those in the map too.
        position : (3,) float
            Place of the sensor in the map frame, m.

        Returns
        -------
        (K,) bool
            The blocks that fit. Others are farther from the sensor than all that stay.

        """
        fit = np.ones(len(index), bool)
        allowed = self.max_bytes // self.block_bytes
        num_new = int((self.find(index) < 0).sum())
        if not self.max_bytes or self.num_blocks + num_new <= allowed:
            return fit
        rows, place = self.rows(), np.asarray(position, np.float64) / self.config.block_size_m
        apart, away = (
            np.linalg.norm(blocks + 0.5 - place, axis=1) for blocks in (self.index(rows), index)
        )
        every = np.concatenate([apart, away[self.find(index) < 0]])
        number = int(ROOM_KEPT * allowed)
        reach = np.partition(every, number)[number] if number < len(every) else np.inf
        leaving = rows[apart >= reach]
        fit &= away < reach
        if not self.num_evicted:
            logger.warning(
                'layers.tsdf: the farthest of %d blocks leave, because map.max_bytes is reached: '
                'the field may use %d bytes',
                *(self.num_blocks, self.max_bytes),
            )
        self.num_evicted += len(leaving) + int((~fit).sum())
        self.remove(leaving)
        return fit

    @property
    def block_bytes(self) -> int:
        """Bytes of a block, with its part of the hash table."""
        return self._row_bytes + HASH_BYTES

    def touch(self, rows: Int64, stamp_ns: int) -> None:
        """Mark blocks as changed in any way at a stamp; increments the version."""
        self._mark(rows, stamp_ns)
        observed = self.weight[rows] > 0.0
        self.head[rows, SURFACE] = self.version
        self.head[rows, DRIFT] = self.head[rows, FREE_VISITS] = 0
        self.head[rows, INSIDE] = (observed & (self.distance[rows] < 0.0)).sum(axis=1)

    def touch_fused(self, rows: Int64, stamp_ns: int, figures: Int64) -> None:
        """
        Mark blocks as changed by a measurement and cap weights by label; increments the version.

        Parameters
        ----------
        rows : (K,) int64
            The blocks.
        stamp_ns : int
            Stamp of the measurement, ns.
        figures : (K, NUM_FOUND) int64
            Of each block, see tsdf/kernels/integration.py.

        """
        self._mark(rows, stamp_ns)
        head = self.head
        drift = head[rows, DRIFT] + figures[:, MOVED]
        visible = drift > VISIBLE_VOXELS * self.config.voxel_size_m * 1e6
        head[rows, DRIFT] = np.where(visible, 0, drift)
        head[rows[visible], SURFACE] = self.version
        head[rows, FREE_VISITS] = np.where(figures[:, SOLID], 0, head[rows, FREE_VISITS] + 1)
        head[rows, INSIDE] = figures[:, BEHIND]
        for label, weight in self.config.label_caps.items():
            row, voxel = np.nonzero(self.votes[rows, 0] == label + 1)
            self.weight[rows[row], voxel] = np.minimum(self.weight[rows[row], voxel], weight)

    def _mark(self, rows: Int64, stamp_ns: int) -> None:
        self.version += 1
        self.head[rows, VERSION] = self.version
        self.head[rows, STAMP] = stamp_ns

    def forgetting_rates(self, rows: Int64, stamp_ns: int) -> Float32:
        """
        Return the least share of measurements that contradict voxels, (K,) in [0, 1).

        After forget_s / 4 of them a distance has moved half of its way to the new one, after
        forget_s / 2 a voxel deep behind a surface is free. A block that was not
        seen for long counts as seen forget_s / MOST_FORGOTTEN ago.
        """
        forget_s = self.config.forget_s
        if forget_s == 0.0:
            return np.zeros(len(rows), np.float32)
        since_s = (stamp_ns - self.head[rows, STAMP]) / 1e9
        shares = np.clip(since_s / forget_s, 0.0, 1.0 / MOST_FORGOTTEN)
        return np.asarray(1.0 - 2.0 ** (-4.0 * shares), np.float32)

    def settled(self, rows: Int64) -> npt.NDArray[np.bool_]:
        """
        Return which blocks were free in the last measurements and need no fusion now, (K,).

        One in RECHECK of them is fused all the same, in turn, so that voxels between the beams
        become free too.
        """
        settled: npt.NDArray[np.bool_] = self.head[rows, FREE_VISITS] >= SETTLED
        settled &= (rows + self.version) % RECHECK != 0
        return settled

    def drop_new(self, rows: Int64) -> int:
        """Remove the blocks among rows that were placed but never touched; return their number."""
        rows = rows[rows >= 0]
        rows = rows[self.head[rows, VERSION] == NEW]
        remove_blocks(rows, self.head, self._hash.arrays, self._state)
        return len(rows)

    def evict(self, position: npt.ArrayLike) -> None:
        """Remove the blocks whose centres are farther than max_radius_m from a position, m."""
        config = self.config
        if config.max_radius_m > 0.0:
            rows = self.rows()
            centres = (self.index(rows) + 0.5) * config.block_size_m
            apart_m = np.linalg.norm(centres - np.asarray(position), axis=1)
            self.remove(rows[apart_m > config.max_radius_m])

    def remove(self, rows: Int64) -> None:
        """Remove blocks."""
        self._wipe(rows)
        remove_blocks(rows, self.head, self._hash.arrays, self._state)

    def copied(self, rows: Int64) -> Blocks:
        """Return a copy of the content of blocks."""
        names = ('field', 'color', 'votes')
        channels = {name: copied_rows(getattr(self, name), rows) for name in names}
        return Blocks(index=self.index(rows), stamp_ns=self.head[rows, STAMP], **channels)

    def insert(self, blocks: Blocks) -> None:
        """Write blocks into the map, replacing those of the same index; increments the version."""
        rows = self.place(blocks.index)
        self._write(rows, blocks)
        self.touch(rows, 0)
        self.head[rows, STAMP] = blocks.stamp_ns

    def clear_region(
        self, contains: Callable[[npt.NDArray[np.float64]], Any], rows: Int64 | None = None
    ) -> None:
        """
        Set the voxels whose centres are in a region to unknown; remove blocks that become empty.

        Parameters
        ----------
        contains : callable
            Takes (P, 3) points in the map frame, m; returns which are in the region, (P,) bool.
        rows : (R,) int64, optional
            The blocks that the region can meet; all if not given.

        """
        side, size_m = self.config.voxels_per_side, self.config.voxel_size_m
        local = np.indices((side, side, side)).reshape(3, -1)[::-1].T
        rows = self.rows() if rows is None else rows
        for first in range(0, len(rows), PART):
            batch = rows[first : first + PART]
            centers = (self.index(batch)[:, None] * side + local + 0.5).astype(np.float64) * size_m
            points: npt.NDArray[np.float64] = centers.reshape(-1, 3)
            inside = np.asarray(contains(points)).reshape(len(batch), -1)
            changed, hit = batch[inside.any(axis=1)], inside[inside.any(axis=1)]
            if not len(changed):
                continue
            for array in (self.field, self.color, self.votes):
                if len(array):
                    array[changed] = np.where(hit[:, None], 0, array[changed])
            stamps = self.head[changed, STAMP]
            self.touch(changed, 0)
            self.head[changed, STAMP] = stamps
            self.remove(changed[~(self.weight[changed] > 0.0).any(axis=1)])

    def _used_head(self) -> Int64:
        return self.head[: self._hash.rows_used]

    def _make_room(self) -> None:
        """Enlarge the rows or the hash table, whichever is full."""
        if self._hash.lacks_row(len(self.head)):
            self._grow()
        else:
            self._hash.grow()
