# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Adaptive surfels: each place has the largest cell of voxels whose points lie on one plane.

A cell of level l is a cube of 2^l voxels an axis, with indices (voxel index) >> l. Its moments are
the exact sums of those of its voxels. It is a plane if its points lie near one and spread over the
cell, and if its children agree, in offset and normal; one child with points off a plane rules out
all cells around it. The cut holds the largest planes, and the other voxels: every point is in
exactly one surfel.

The cut depends on the integers of the map alone, hence not on the order of scans, and removing a
scan restores it. After a change only the cells above changed voxels are summed and judged again.

Source: Yuan et al. 2022 (VoxelMap) for octrees of planes; exactness, removal and the agreement
of children are our own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import hashlib
import math
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_real, as_whole
from surfel_mapper.errors import MapError
from surfel_mapper.kernels import layout
from surfel_mapper.kernels.layout import KEY, STAMP
from surfel_mapper.mapping.channels import channel_names, means
from surfel_mapper.mapping.kernels import adaptive as kernels
from surfel_mapper.mapping.kernels.adaptive import DIRTY, EMPTY, LINK, LINK_BITS, LINKED, SHOWN
from surfel_mapper.mapping.kernels.rows import read_rows
from surfel_mapper.mapping.kernels.surfels import derive_surfels
from surfel_mapper.mapping.moment_map import MAX_LEVEL, MomentMap, VoxelTable
from surfel_mapper.mapping.moments import pack_keys, ScanMoments, unpack_keys
from surfel_mapper.mapping.storage import Slab
from surfel_mapper.mapping.surfels import concatenated, derive, Surfels

MAX_LEVELS = 6
"""Cells of 64 voxels; a larger one could hold 2^31 / 4^level points only."""

LEVELS, MAX_THICKNESS_M = 4, 0.04
"""Default settings, of the configuration too."""

BLOCK = 1024
"""Number of cells judged at once: their shapes stay in the cache."""

EACH_AXIS = 1 | 1 << layout.INDEX_BITS | 1 << 2 * layout.INDEX_BITS
"""A key of index 1 on each axis, without the offset."""

Nodes = tuple[npt.NDArray[Any], ...]
"""Rows, stamps and links, as the kernels take them."""

Space = tuple[Any, ...]
"""Arrays that the judgement of a block of cells overwrites; see ``workspace``."""

Rows = npt.NDArray[np.intp]
Keys = tuple[npt.NDArray[Any], npt.NDArray[Any]]
"""Keys of voxels and of cells."""

NO_KEYS: Keys = np.empty(0, np.int64), np.empty(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class CutChange:
    """
    Changes of the adaptive surfels of a map.

    Attributes
    ----------
    surfels : Surfels
        Those that appeared or changed.
    removed_index : (E, 3) int32
        Indices floor(point / size) of cells and voxels that had a surfel and have none now.
    removed_size : (E,) float64, m
        Their sizes.

    """

    surfels: Surfels
    removed_index: npt.NDArray[np.int32]
    removed_size: npt.NDArray[np.float64]


class CellTable(VoxelTable):
    """
    The cells above the voxels of a map; kernels/adaptive.py describes the arrays.

    Parameters
    ----------
    num_channels : int
        Number of channels of the map.

    """

    def __init__(self, num_channels: int) -> None:
        super().__init__(num_channels)
        self._links = Slab(1024, 2)
        self._children = Slab(1024, 8, np.int32)

    @property
    def nbytes(self) -> int:
        """Bytes in use."""
        row_bytes = self._links.row_bytes + self._children.row_bytes
        return super().nbytes + self.rows_used * row_bytes

    @property
    def nodes(self) -> Nodes:
        """The cells as nodes."""
        return self.rows.array, self.stamps.array, self._links.array

    @property
    def children(self) -> npt.NDArray[np.int32]:
        """Rows + 1 of the children of each cell, (R, 8)."""
        return self._children.array

    def find_or_add(self, key: npt.NDArray[np.int64]) -> Rows:
        """Return the rows of cells (K,), which are added if they are missing."""
        keys, numbers = np.unique(key, return_inverse=True)
        rows = self.add(no_points(keys, self.channel_sums.shape[1]), 0).astype(np.intp)
        for slab in (self._links, self._children):
            if len(slab.array) < len(self.rows.array):
                slab.grow(len(self.rows.array))
        return rows[numbers]


class AdaptiveCut:
    """
    The adaptive surfels of a map, which follow its changes.

    Parameters
    ----------
    surfel_map : SurfelMap
        The map; another thread must not change it during a call.
    min_points : int
        Cells and voxels with fewer points have no surfel.
    levels : int
        The largest cells have 2^levels voxels an axis; 1 to 6.
    max_thickness_m : float
        Maximum ``thickness`` of a cell, m.

    Raises
    ------
    TypeError, ValueError
        If a setting is of another type or out of range.

    """

    def __init__(
        self,
        surfel_map: MomentMap,
        *,
        min_points: int = 1,
        levels: int = LEVELS,
        max_thickness_m: float = MAX_THICKNESS_M,
    ) -> None:
        highest = min(MAX_LEVELS, MAX_LEVEL - surfel_map.level)
        if not 1 <= as_whole('levels', levels) <= highest:
            raise ValueError(f'levels: {levels}, expected 1 to {highest}')
        if not 0.0 < as_real('max_thickness_m', max_thickness_m) < math.inf:
            raise ValueError(f'max_thickness_m: {max_thickness_m}, expected positive and finite')
        self._map = surfel_map
        self.min_points = min_points
        self._levels = levels
        self._bits = layout.BITS + surfel_map.level
        self._thickness = max_thickness_m / surfel_map.voxel_size_m * 2**self._bits
        self._lost = self._removed = NO_KEYS
        self._reset()

    @property
    def min_points(self) -> int:
        """Cells and voxels with fewer points have no surfel; a new number holds after restart."""
        return self._min_points

    @min_points.setter
    def min_points(self, value: int) -> None:
        self._min_points = max(as_whole('min_points', value), 1)

    def _reset(self) -> None:
        """Forget the map; ``_lost`` keeps the keys of the surfels that were reported."""
        self._version = self._num_rows = 0
        self._cells = CellTable(len(channel_names(self._map.columns)))
        self._links = Slab(1024, 2)

    @property
    def nbytes(self) -> int:
        """Bytes in use for the cells and the links of the voxels."""
        return self._cells.nbytes + self._num_rows * self._links.row_bytes

    @property
    def _voxels(self) -> Nodes:
        """The voxels of the map as nodes."""
        rows, stamps, _ = self._map.slabs
        return rows, stamps, self._links.array

    def refresh(self, *, covariance: bool = False) -> CutChange:
        """
        Follow the map; return the changes of the surfels since the last call.

        Parameters
        ----------
        covariance : bool
            With the covariances of the points.

        Raises
        ------
        MapLimitError
            If there is no memory for the cells; the next call starts anew, its changes are whole.

        """
        if self._map.cleared_at > self._version:
            self.restart()
        try:
            change = self._refresh(covariance)
        except BaseException:
            self.restart()
            raise
        self._lost = NO_KEYS
        return change

    def restart(self, *, undo: bool = False) -> None:
        """
        Start anew: the next change has all surfels, and those of the former ones to be removed.

        Parameters
        ----------
        undo : bool
            The last change did not arrive. The next one removes its removed surfels too, and
            may remove surfels that only the last change had.

        """
        if undo:
            self._lost = joined(self._lost, self._removed)
        self._lost = joined(self._lost, self._keys(*self._shown()))
        self._removed = NO_KEYS
        self._reset()

    def _refresh(self, covariance: bool) -> CutChange:
        changed = self._map.rows_changed(self._version).astype(np.intp)
        self._version, self._num_rows = self._map.version, self._map.rows_used
        if len(self._links.array) < self._num_rows:
            self._links.grow(2 * self._num_rows)
        dirty, unlinked = self._judge(changed)
        voxels, cells, left_voxels, left_cells = self._compare(dirty[-1])
        surfels = self._surfels(voxels, cells, covariance)
        shown = self._keys(voxels, cells)
        for level, dirty_cells in enumerate(dirty, 1):
            self._clean(dirty_cells, level)
        kernels.clean(changed, self._links.array)
        gone = joined(self._lost, (np.concatenate([unlinked, left_voxels]), left_cells))
        self._removed = np.setdiff1d(gone[0], shown[0]), np.setdiff1d(gone[1], shown[1])
        index, levels = indices(*self._removed)
        size = np.asarray(self._map.voxel_size_m * 2.0**levels)
        return CutChange(surfels, index, size)

    def surfels(self, *, covariance: bool = False) -> Surfels:
        """
        Return the surfels, with the covariances of their points if asked for.

        Raises
        ------
        MapError
            If the map has changed since the last call of ``refresh``.

        """
        return self._surfels(*self._current(), covariance)

    def _current(self) -> tuple[Rows, Rows]:
        if self._map.version != self._version:
            raise MapError('the map has changed since the cut followed it; call refresh first')
        return self._shown()

    def digest(self) -> str:
        """
        Return the SHA-256 of the cut in hexadecimal.

        Hashed are: the text ``adaptive cut 1`` and the voxel size as float64; then level and
        index (floor(point / size)), counts, sums, products and view sums of all cells and voxels,
        array by array as int64 and little-endian, sorted by level and index.

        Raises
        ------
        MapError
            If the map has changed since the last call of ``refresh``.

        """
        voxels, cells = self._current()
        index, level = indices(*self._keys(voxels, cells))
        order = np.lexsort((*index.T[::-1], level))
        state = hashlib.sha256(b'adaptive cut 1' + struct.pack('<d', self._map.voxel_size_m))
        arrays: list[npt.NDArray[Any]] = [level, index, *self._moments(voxels, cells)]
        for array in arrays:
            state.update(np.ascontiguousarray(array[order], '<i8').data)
        return state.hexdigest()

    def _judge(self, changed: Rows) -> tuple[list[Rows], npt.NDArray[np.int64]]:
        """Link and judge the cells above changed voxels: dirty ones by level, unlinked keys."""
        cells, gone = self._link(changed, 0)
        dirty, space = [cells], workspace()
        for level in range(1, self._levels + 1):
            for start in range(0, len(dirty[-1]), BLOCK):
                self._judge_cells(dirty[-1][start : start + BLOCK], level, space)
            if level < self._levels:
                dirty.append(self._link(dirty[-1], level)[0])
        return dirty, gone

    def _link(self, chosen: Rows, level: int) -> tuple[Rows, npt.NDArray[np.int64]]:
        """
        Link changed nodes of a level to their parents.

        Returns the rows of the parents that become dirty, and the keys of voxels of the cut that
        the chosen rows hold no longer.
        """
        new, dirty, gone = self._mark(chosen, level)
        key = self._nodes(level)[0][new, KEY]
        if key.min(initial=0) < 0:  # emptied voxels
            new, key = new[key >= 0], key[key >= 0]
        parents = self._cells.find_or_add(parent_keys(key, level))
        self._cells.children.reshape(-1)[parents * 8 + octants(key, level)] = new + 1
        links = self._nodes(level)[2]
        links[new] = np.column_stack([key, ((parents + 1) << LINK_BITS) | DIRTY])
        return np.sort(np.concatenate([dirty, self._mark(new, level)[1]])), gone

    def _mark(self, chosen: Rows, level: int) -> list[npt.NDArray[np.int64]]:
        """Return the outputs of the kernel ``mark`` for nodes of a level."""
        outputs = [np.empty(len(chosen), np.int64) for _ in range(3)]
        links, children = self._cells.nodes[2], self._cells.children
        numbers = kernels.mark(chosen, self._nodes(level), links, children, *outputs)
        return [array[:num] for array, num in zip(outputs, numbers, strict=True)]

    def _clean(self, dirty: Rows, level: int) -> None:
        """Mark dirty cells of a level as clean, and free the empty ones."""
        rows, stamps, links = self._cells.nodes
        kernels.clean(dirty, links)
        empty = dirty[stamps[dirty, STAMP] == EMPTY]
        if len(empty):
            moments = no_points(rows[empty, KEY], self._cells.channel_sums.shape[1])
            object.__setattr__(moments, 'rows', empty)  # hints save compiling the look-up
            self._cells.remove(moments, 0)
            self._mark(empty, level)
            links[empty] = 0

    def _judge_cells(self, dirty: Rows, level: int, space: Space) -> None:
        """Sum and judge cells of a level."""
        nodes, cells, bits = self._nodes(level - 1), self._cells.nodes, self._bits + level
        summed, full, means, ends, of_cells, of_children = space
        num = kernels.sum_children(
            *(dirty, level, self._bits, nodes, cells, self._cells.children),
            *(summed, full, means, ends),
        )
        size, summed, full = 2.0**bits, summed[:num], full[: ends[num, 1]]
        derive_surfels(cells[0], cells[1], summed, size, bits, of_cells)
        derive_surfels(nodes[0], nodes[1], full, size / 2.0, bits - 1, of_children)
        shapes = (of_cells[1], of_cells[4]), (of_children[1], of_children[4])
        kernels.judge(summed, means, ends, *shapes, self._thickness, size, cells[1])
        if self._map.columns:
            chosen = summed.astype(np.intp)
            below = self._cells.children[chosen].astype(np.intp)
            sums = self._channel_sums(level - 1)[below - 1] * (below > 0)[:, :, None]
            self._cells.channel_sums[chosen] = sums.sum(axis=1)

    def _compare(self, roots: Rows) -> list[npt.NDArray[Any]]:
        """Return rows of changed voxels and cells, keys of those that left the cut."""
        num_voxels, num_cells = self._num_rows, self._cells.rows_used
        outputs: list[npt.NDArray[Any]]
        outputs = [np.empty(num, np.intp) for num in (num_voxels, num_cells)]
        outputs += [np.empty(num, np.int64) for num in (num_voxels, num_cells)]
        numbers = np.zeros(4, np.int64)
        nodes = self._voxels, self._cells.nodes, self._cells.children
        kernels.compare(roots, self._levels, self._min_points, *nodes, (*outputs, numbers))
        return [array[:num] for array, num in zip(outputs, numbers, strict=True)]

    def _nodes(self, level: int) -> Nodes:
        """Return the nodes of a level, 0 for voxels."""
        return self._cells.nodes if level else self._voxels

    def _shown(self) -> tuple[Rows, Rows]:
        """Return the rows of the voxels and cells in the cut."""
        voxels = self._links.array[: self._num_rows, LINK]
        cells = self._cells.nodes[2][: self._cells.rows_used, LINK]
        return np.flatnonzero(voxels & SHOWN), np.flatnonzero(cells & SHOWN)

    def _keys(self, voxels: Rows, cells: Rows) -> Keys:
        """Return the keys of rows of voxels and of cells."""
        linked, rows = self._links.array, self._cells.nodes[0]  # the map may have been cleared
        return linked[voxels, LINKED], rows[cells, KEY]

    def _moments(self, voxels: Rows, cells: Rows) -> list[npt.NDArray[np.int64]]:
        """Return count, total, product and view of rows of voxels and cells."""
        tables = []
        for slab, chosen in ((self._map.slabs[0], voxels), (self._cells.nodes[0], cells)):
            shapes = ((), (), (3,), (6,), (3,))
            arrays = tuple(np.empty((len(chosen), *shape), np.int64) for shape in shapes)
            read_rows(slab, chosen, arrays)
            tables.append(arrays[1:])
        return [np.concatenate(arrays) for arrays in zip(*tables, strict=True)]

    def _surfels(self, voxels: Rows, cells: Rows, covariance: bool) -> Surfels:
        """Return the surfels of rows of voxels and cells."""
        levels = levels_of(self._cells.keys(cells))
        tables = [self._surfels_at(0, voxels, covariance)]
        for level in range(1, self._levels + 1):
            tables.append(self._surfels_at(level, cells[levels == level], covariance))
        return concatenated([table for table in tables if len(table)] or tables[:1])

    def _surfels_at(self, level: int, chosen: Rows, covariance: bool) -> Surfels:
        """Return the surfels of rows of a level."""
        rows, stamps, _ = self._nodes(level)
        numbers, channels = chosen.astype(np.int32), self._channel_sums(level)[chosen]
        if level:  # keyed by index >> level
            rows, stamps, numbers = (
                rows[chosen],
                stamps[chosen],
                np.arange(len(chosen), dtype=np.int32),
            )
            rows[:, KEY] = pack_keys(unpack_keys(rows[:, KEY]) >> level)
        size_m = self._map.voxel_size_m * 2.0**level
        surfels = derive((rows, stamps), numbers, size_m, self._bits + level, covariance)
        names = channel_names(self._map.columns)
        return replace(surfels, channels=means(channels, surfels.num_points, names))

    def _channel_sums(self, level: int) -> npt.NDArray[np.int64]:
        """Return the channel sums of the nodes of a level, (R, C)."""
        return self._cells.channel_sums if level else self._map.slabs[2]


def workspace() -> Space:
    """Return arrays for the sums and shapes of a block of cells and their children."""
    shapes = [
        (
            *(np.empty((num, 3)), np.empty((num, 3)), np.empty(num), np.empty(num)),
            *(np.empty((num, 3)), np.empty(num, np.int64), np.empty((num, 3), np.int32)),
            *(np.empty(num, np.int64), np.empty((0, 6))),
        )
        for num in (BLOCK, 8 * BLOCK)
    ]
    rows = np.empty(BLOCK, np.int32), np.empty(8 * BLOCK, np.int32)
    ends = np.zeros((BLOCK + 1, 2), np.int64)
    return *rows, np.empty((8 * BLOCK, 5)), ends, *shapes


def no_points(key: npt.NDArray[np.int64], num_channels: int) -> ScanMoments:
    """Return moments of no points, by which a table adds and removes cells."""
    num = len(key)
    return ScanMoments(
        voxel_size_m=1.0,
        key=key,
        count=np.zeros(num, np.int32),
        total=np.zeros((num, 3), np.int32),
        product=np.zeros((num, 6), np.int64),
        view=np.zeros((num, 3), np.int16),
        channels=np.zeros((num, num_channels), np.int64),
        num_scans=np.zeros(num, np.int64),
    )


def parent_keys(key: npt.NDArray[np.int64], level: int) -> npt.NDArray[np.int64]:
    """Return the keys of the cells of the next level around nodes of a level."""
    return np.asarray(key & ~(((2 << level) - 1) * EACH_AXIS) | (EACH_AXIS << level))


def octants(key: npt.NDArray[np.int64], level: int) -> npt.NDArray[np.int64]:
    """Return the octants of nodes of a level in their parents: 4 x + 2 y + z, each 0 or 1."""
    x, y, z = (key >> (level + axis * (layout.INDEX_BITS - 1)) & 1 << axis for axis in (2, 1, 0))
    return np.asarray(x | y | z)


def joined(first: Keys, second: Keys) -> Keys:
    """Return the keys of two."""
    return np.concatenate([first[0], second[0]]), np.concatenate([first[1], second[1]])


def levels_of(cell_keys: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return the levels of cells: one more than the zero bits at the end of their keys."""
    return np.asarray(np.log2(cell_keys & -cell_keys), np.int64) + 1


def indices(
    voxel_keys: npt.NDArray[Any], cell_keys: npt.NDArray[Any]
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int64]]:
    """Return the indices floor(point / size), (K, 3), and levels of voxels and then cells."""
    level = levels_of(cell_keys)
    index = unpack_keys(cell_keys) >> level[:, None].astype(np.int32)
    levels = np.concatenate([np.zeros(len(voxel_keys), np.int64), level])
    return np.concatenate([unpack_keys(voxel_keys), index]), levels
