# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Growth and joining of the charts of a map, by the rules for one cloud.

A surfel counts as one point. Touching charts are joined if one height field explains both; if many
voxels are on none, planes grow over these in coarser voxels, and are joined across gaps.

Joins of a whole map take 1 us a voxel, however little changes. So the map is cut into blocks of
512 voxels a side, in which the parts of charts are joined; charts that cross blocks carry joins
on. Blocks without a change stay. Joins of a block depend on its voxels only, not on the history.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import ModelsLayerConfig
from surfel_mapper.kernels.layout import INDEX_BITS
from surfel_mapper.models.charts import chart_side, STACKED_VOXELS
from surfel_mapper.models.coarse_growth import (
    CoarseRules,
    extend_coarse,
    grow_coarse,
    SPARSE_SHARE,
)
from surfel_mapper.models.kernels.surfel_classes import FLAT
from surfel_mapper.models.kernels.surfel_groups import find_doubtful, find_pieces, mean_normals
from surfel_mapper.models.surfel_graph import SurfelGraph

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int32]
Indices = npt.NDArray[np.int64]

FACTORS = (1.0, 2.0, 4.0)
"""Edges of the voxels in which charts are joined, in those of the map."""

FARTHEST = 16.0
"""Edge of the voxels in which planes grow at last, over single voxels tens of metres apart."""

BLOCK_BITS = 9
"""Blocks have two to this power of voxels a side."""

ONES = 1 << (2 * INDEX_BITS) | 1 << INDEX_BITS | 1
BLOCK = ONES * ((1 << INDEX_BITS) - (1 << BLOCK_BITS))
HALF = ONES << (BLOCK_BITS - 1)
"""
Bits of a key that name its block, and the key of the middle of a block: the origin is in the
middle of one. The last half block of an axis wraps around to the first one.
"""


class SurfelJoining:
    """
    The joins of the charts of a map.

    Parameters
    ----------
    graph : SurfelGraph
        The voxels.
    config : ModelsLayerConfig
        Settings.

    """

    def __init__(self, graph: SurfelGraph, config: ModelsLayerConfig) -> None:
        self._graph = graph
        self._limit = math.cos(math.radians(config.fold_angle_deg))
        self.clear()

    def clear(self) -> None:
        """Forget all joins."""
        none: Rows = np.empty(0, np.int32)
        self._blocks: dict[int, int] = {}
        self._key: Indices = np.empty(0, np.int64)
        self._block = self._piece = self._region = none
        self._overlaps: dict[bytes, bool] = {}

    def update(self, owner: Rows, changed: Rows) -> Rows:
        """
        Return the patch of each row (R,), -1 for none.

        Parameters
        ----------
        owner : (R,) int32
            Chart of each row, with the voxels that it hosts; -1 for none.
        changed : (N,) int32
            Rows whose voxels changed since the last call.

        """
        key = self._graph.key
        was = self._moved(key)
        piece, old_piece = np.empty_like(owner), self._piece
        find_pieces(owner, self._block, key, piece)
        is_touched = np.zeros(len(self._blocks) + 1, np.bool_)  # the last: rows without a voxel
        for rows in (changed, piece != old_piece):
            is_touched[self._block[rows]] = True
        is_touched[was] = True
        is_touched[-1] = False
        region, block = self._region, self._block
        region[block < 0] = -1
        again = np.flatnonzero(is_touched[block])
        again = again[np.lexsort((key[again], block[again]))]
        ends = np.flatnonzero(np.diff(block[again])) + 1
        for rows in np.split(again, ends) if len(again) else ():
            region[rows] = self._joined(rows.astype(np.int64), piece[rows])
        self._piece = piece
        first = np.flatnonzero(piece == np.arange(len(piece)))
        merged = patches(owner, first, region)
        return self._separated(merged, owner, first, is_touched)

    def _moved(self, key: Indices) -> Rows:
        """Find the blocks of new voxels; return the previous ones of rows with other voxels."""
        more = len(key) - len(self._key)
        if more:
            self._key = np.append(self._key, np.full(more, -1))
            none = np.full(more, -1, np.int32)
            self._block, self._piece, self._region = (
                np.append(rows, none) for rows in (self._block, self._piece, self._region)
            )
        moved = np.flatnonzero(key != self._key)
        was: Rows = np.unique(self._block[moved])
        self._key[moved] = key[moved]
        block = np.where(key[moved] >= 0, (key[moved] + HALF) & BLOCK, -1)
        names, inverse = np.unique(block, return_inverse=True)
        numbers = [-1 if n < 0 else self._blocks.setdefault(n, len(self._blocks)) for n in names]
        self._block[moved] = np.array(numbers, np.int32)[inverse]
        return was

    def _separated(
        self, patch: Rows, owner: Rows, first: Indices, is_touched: npt.NDArray[np.bool_]
    ) -> Rows:
        """Return patches (R,), those across blocks that are no height fields as charts again."""
        number, block = int(patch.max(initial=-1)) + 1, self._block[first]
        low, high = np.full(number, len(self._blocks)), np.full(number, -1)
        np.minimum.at(low, patch[first], block)
        np.maximum.at(high, patch[first], block)
        overlaps, self._overlaps = self._overlaps, {}
        separated = patch.copy()
        for name in np.flatnonzero(low < high):
            pieces = first[patch[first] == name]
            code = pieces.tobytes()
            if is_touched[self._block[pieces]].any() or code not in overlaps:
                overlaps[code] = self._overlaps_itself(np.flatnonzero(patch == name))
            self._overlaps[code] = overlaps[code]
            if overlaps[code]:
                mine = np.flatnonzero(patch == name)
                charts, inverse = np.unique(owner[mine], return_inverse=True)
                separated[mine] = np.where(owner[mine] < 0, -1, number + inverse)
                number += len(charts)  # fewer than its voxels: names stay below R
        return separated

    def _overlaps_itself(self, rows: Indices) -> bool:
        """Return whether voxels are no height field."""
        graph, size_m = self._graph, self._graph.map.voxel_size_m
        rows = rows[graph.kind[rows] == FLAT]  # others are on no chart, or have no normal
        rules, starts = (self._limit, STACKED_VOXELS * size_m), np.array([0, len(rows)])
        mean, doubtful = np.empty((1, 3)), np.empty(1, np.bool_)
        every = np.ones(len(graph.key), np.bool_)
        mean_normals(rows, starts, every, graph.normal, mean)
        find_doubtful(rows, starts, mean, graph.normal, graph.position, rules, doubtful)
        if not doubtful[0]:
            return False
        rows = rows[np.argsort(graph.key[rows])]
        side = chart_side(graph.normal[rows], graph.position[rows], self._limit, size_m)
        return side is not None

    def _joined(self, rows: Indices, piece: Rows) -> Rows:
        """Return the region (n,) of each row of a block, in the order of their keys, or -1."""
        graph, size_m = self._graph, self._graph.map.voxel_size_m
        graph.index_of[rows] = np.arange(len(rows))
        index = np.where(piece >= 0, graph.index_of[piece], -1)
        graph.index_of[rows] = -1
        names = np.flatnonzero(index == np.arange(len(rows)))
        if not len(names):
            return np.full(len(rows), -1, np.int32)
        patch = np.where(index >= 0, np.searchsorted(names, index), -1).astype(np.int32)
        was_free = patch < 0
        order = np.argsort(patch, kind='stable')[was_free.sum() :]
        starts = np.searchsorted(patch[order], np.arange(len(names) + 1))
        normals: Array = np.empty((len(names), 3))
        curved: npt.NDArray[np.bool_] = np.zeros(len(names), np.bool_)
        is_flat = graph.kind == FLAT
        mean_normals(rows[order].astype(np.int32), starts, is_flat, graph.normal, normals)
        points = graph.position[rows]
        rules = CoarseRules(size_m, graph.thickness_m, (graph.noise_m, 0.0))
        for factor in FACTORS:
            if factor > 1.0 and np.count_nonzero(patch < 0) < SPARSE_SHARE * len(patch):
                break
            normals, curved = grow_coarse(points, patch, (normals, curved), factor * size_m, rules)
        else:
            shape = normals, curved
            extend_coarse(points, patch, shape, FARTHEST * size_m, rules)
        came = np.flatnonzero(was_free & (patch >= 0))
        patch[came[~graph.is_thin(rows[came], normals[patch[came]])]] = -1
        least = np.full(len(normals), len(rows))
        np.minimum.at(least, patch[names], names)
        regions: Rows = np.full(len(rows), -1, np.int32)
        regions[patch >= 0] = rows[least[patch[patch >= 0]]]
        return regions


def patches(owner: Rows, first: Indices, region: Rows) -> Rows:
    """
    Return the patch of each row (R,), -1 for none: regions of blocks that share a chart.

    Parameters
    ----------
    owner : (R,) int32
        Charts.
    first : (P,) int64
        The row of least key of every chart in every block.
    region : (R,) int32
        Regions, by the row of least key of their charts, -1 for none.

    """
    from scipy.sparse import coo_array  # 0.2 s that maps without models save
    from scipy.sparse.csgraph import connected_components

    names, index = np.unique(region[first], return_inverse=True)
    number = int(owner.max(initial=-1)) + 1
    size = number + len(names)
    ends = owner[first], number + index
    links = coo_array((np.ones(len(first), np.bool_), ends), (size, size))
    _, component = connected_components(links, directed=False)
    table = np.full(len(owner) + 1, -1, np.int32)  # the last: no region
    table[names] = component[number:]
    patch: Rows = table[region]
    return patch
