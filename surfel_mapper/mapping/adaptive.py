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
from surfel_mapper.kernels.layout import KEY
from surfel_mapper.mapping.channels import channel_names, means
from surfel_mapper.mapping.kernels import adaptive as kernels
from surfel_mapper.mapping.kernels.adaptive import LINKED
from surfel_mapper.mapping.kernels.rows import read_rows
from surfel_mapper.mapping.moment_map import MAX_LEVEL, MomentMap
from surfel_mapper.mapping.moments import unpack_keys
from surfel_mapper.mapping.storage import HashTable, Slab
from surfel_mapper.mapping.surfels import concatenated, derive, Surfels

MAX_LEVELS = 6
"""Cells of 64 voxels; a larger one could hold 2^31 / 4^level points only."""

LEVELS, MAX_THICKNESS_M = 4, 0.04
"""Default settings, of the configuration too."""

MAX_DEPTH = 24
"""The directory of the hash table of cells has at most 2^24 entries, as that of a map."""

Nodes = tuple[npt.NDArray[Any], ...]
"""Rows, stamps, links and channels, as the kernels take them."""

Rows = npt.NDArray[np.int32]
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


class CellTable:
    """
    The cells above the voxels of a map; kernels/adaptive.py describes the arrays.

    Parameters
    ----------
    num_channels : int
        Number of channels of the map.

    """

    def __init__(self, num_channels: int) -> None:
        self._hash = HashTable(MAX_DEPTH)
        columns: list[tuple[int, Any]] = [(layout.ROW, np.int64), (layout.STAMP_ROW, np.uint32)]
        columns += [(2, np.int64), (8, np.int32), (num_channels, np.int64)]
        self._slabs = [Slab(1024, width, dtype) for width, dtype in columns if width]

    @property
    def nbytes(self) -> int:
        """Bytes in use."""
        row_bytes = sum(slab.row_bytes for slab in self._slabs)
        return self._hash.rows_used * row_bytes + self._hash.nbytes

    @property
    def rows_used(self) -> int:
        """Number of rows ever used."""
        return self._hash.rows_used

    @property
    def nodes(self) -> Nodes:
        """The cells as nodes."""
        arrays: list[npt.NDArray[Any]] = [slab.array for slab in self._slabs]
        sums = arrays[4] if len(arrays) > 4 else np.empty((len(arrays[0]), 0), np.int64)
        return *arrays[:3], sums

    @property
    def children(self) -> npt.NDArray[np.int32]:
        """Rows + 1 of the children of each cell, (R, 8)."""
        return self._slabs[3].array

    def attach(
        self, chosen: Rows, level: int, voxels: Nodes | None, dirty: Rows, num_dirty: int
    ) -> Rows:
        """
        Link changed nodes to their parents; return these, which become dirty.

        Parameters
        ----------
        chosen : (K,) int32
            Rows of voxels, or of cells of a level if there are no voxels.
        level : int
            0 for voxels.
        voxels : tuple of array, optional
            The voxels as nodes.
        dirty : (D,) int32
            Dirty cells, overwritten; room for K more than there are.
        num_dirty : int
            Number of dirty cells.

        """
        done = 0
        while done < len(chosen):
            done, num_dirty = kernels.attach(
                *(chosen, done, level, voxels or self.nodes, self.nodes, self.children),
                *(self._hash.arrays, self._hash.state, dirty, num_dirty),
            )
            if done < len(chosen):
                self._make_room()
        return dirty[:num_dirty]

    def clean(self, dirty: Rows, level: int) -> None:
        """Mark dirty cells of a level as clean, and free the empty ones."""
        table, state = self._hash.arrays, self._hash.state
        kernels.clean(dirty, level, self.nodes, self.children, table, state)

    def _make_room(self) -> None:
        """Enlarge the array that had no room for a new cell."""
        num_rows = len(self._slabs[0].array)
        if not self._hash.lacks_row(num_rows):
            self._hash.grow()
            return
        for slab in reversed(self._slabs):  # the rows last: they tell how many there are
            slab.grow(2 * num_rows)


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
        rows, stamps, channels = self._map.slabs
        return rows, stamps, self._links.array, channels

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
            The last change did not arrive: what it removed is removed by the next one, and
            surfels may be removed that only it had.

        """
        if undo:
            self._lost = joined(self._lost, self._removed)
        self._lost = joined(self._lost, self._keys(*self._shown()))
        self._removed = NO_KEYS
        self._reset()

    def _refresh(self, covariance: bool) -> CutChange:
        changed = self._map.rows_changed(self._version)
        self._version, self._num_rows = self._map.version, self._map.rows_used
        if len(self._links.array) < self._num_rows:
            self._links.grow(2 * self._num_rows)
        dirty, detached = self._judge(changed)
        voxels, cells, left_voxels, left_cells = self._compare(dirty[-1])
        surfels = self._surfels(voxels, cells, covariance)
        shown = self._keys(voxels, cells)
        for level, dirty_cells in enumerate(dirty, 1):
            self._cells.clean(dirty_cells, level)
        kernels.clean_voxels(changed, self._links.array)
        gone = joined(self._lost, (np.concatenate([detached, left_voxels]), left_cells))
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
        """Link and judge the cells above changed voxels: dirty ones by level, detached keys."""
        detached = np.empty(len(changed), np.int64)
        parents = np.empty(2 * len(changed), np.int32)
        new = np.empty(len(changed), np.int32)
        num_dirty, num_detached, num_new = kernels.detach(
            *(changed, self._voxels, self._cells.nodes, self._cells.children),
            *(parents, detached, new),
        )
        dirty = [self._cells.attach(new[:num_new], 0, self._voxels, parents, num_dirty)]
        for level in range(1, self._levels + 1):
            nodes = self._voxels if level == 1 else self._cells.nodes
            kernels.judge(
                *(dirty[-1], level, self._bits, self._thickness),
                *(nodes, self._cells.nodes, self._cells.children),
            )
            del nodes  # views would pin the memory
            if level < self._levels:
                parents = np.empty(len(dirty[-1]), np.int32)
                dirty.append(self._cells.attach(dirty[-1], level, None, parents, 0))
        return dirty, detached[:num_detached]

    def _compare(self, roots: Rows) -> list[npt.NDArray[Any]]:
        """Return rows of changed voxels and cells, keys of those that left the cut."""
        num_voxels, num_cells = self._num_rows, self._cells.rows_used
        outputs: list[npt.NDArray[Any]]
        outputs = [np.empty(num, np.int32) for num in (num_voxels, num_cells)]
        outputs += [np.empty(num, np.int64) for num in (num_voxels, num_cells)]
        numbers = np.zeros(4, np.int64)
        nodes = self._voxels, self._cells.nodes, self._cells.children
        kernels.compare(roots, self._levels, self._min_points, *nodes, (*outputs, numbers))
        return [array[:num] for array, num in zip(outputs, numbers, strict=True)]

    def _shown(self) -> tuple[Rows, Rows]:
        """Return the rows of the voxels and cells in the cut."""
        voxels = kernels.shown_rows(self._links.array, self._num_rows)
        return voxels, kernels.shown_rows(self._cells.nodes[2], self._cells.rows_used)

    def _keys(self, voxels: Rows, cells: Rows) -> Keys:
        """Return the keys of rows of voxels and of cells."""
        linked, rows = self._links.array, self._cells.nodes[0]  # the map may have been cleared
        return linked[voxels.astype(np.intp), LINKED], rows[cells.astype(np.intp), KEY]

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
        levels = levels_of(self._cells.nodes[0][cells.astype(np.intp), KEY])
        tables = [self._surfels_at(0, voxels, covariance)]
        for level in range(1, self._levels + 1):
            tables.append(self._surfels_at(level, cells[levels == level], covariance))
        return concatenated([table for table in tables if len(table)] or tables[:1])

    def _surfels_at(self, level: int, chosen: Rows, covariance: bool) -> Surfels:
        """Return the surfels of rows of a level."""
        rows, stamps, _, channels = self._cells.nodes if level else self._voxels
        chosen = chosen.astype(np.intp)
        slab = np.empty((len(chosen), layout.ROW), np.int64)
        kernels.copy_rows(rows, chosen, level, slab)
        numbers = np.arange(len(chosen), dtype=np.int32)
        size_m = self._map.voxel_size_m * 2.0**level
        slabs, bits = (slab, stamps[chosen]), self._bits + level
        surfels = derive(slabs, numbers, size_m, bits, covariance)
        names = channel_names(self._map.columns)
        return replace(surfels, channels=means(channels[chosen], surfels.num_points, names))


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
