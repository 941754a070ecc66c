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
from surfel_mapper.models.charts import STACKED_VOXELS
from surfel_mapper.models.coarse_growth import CoarseRules, grow_coarse, SPARSE_SHARE
from surfel_mapper.models.kernels.charts import bisect_chart
from surfel_mapper.models.kernels.surfel_classes import FLAT
from surfel_mapper.models.kernels.surfel_groups import mean_normals
from surfel_mapper.models.surfel_graph import SurfelGraph

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int32]
Indices = npt.NDArray[np.int64]

FACTORS = (1.0, 2.0, 4.0)
"""Edges of the voxels in which charts are joined, in those of the map."""

BLOCK_BITS = 9
"""Blocks have two to this power of voxels a side."""

ONES = 1 << (2 * INDEX_BITS) | 1 << INDEX_BITS | 1
INSIDE, HALF = ONES * ((1 << BLOCK_BITS) - 1), ONES << (BLOCK_BITS - 1)
"""Keys of the last voxel of a block and of its middle: the origin is in the middle of a block."""


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
        self._noise_m = config.noise_m
        self._limit = math.cos(math.radians(config.fold_angle_deg))
        self.clear()

    def clear(self) -> None:
        """Forget all joins."""
        none: Indices = np.empty(0, np.int64)
        self._block: Indices = none
        self._piece: Indices = none
        self._region: Indices = none

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
        block = np.where(key >= 0, (key + HALF) & ~INSIDE, -1)
        blocks = np.unique(block[block >= 0])
        number = np.searchsorted(blocks, block)
        piece = pieces_in_blocks(owner, number, len(blocks), key)
        more = len(key) - len(self._block)
        before = np.append(self._block, np.full(more, -1))
        is_other = piece != np.append(self._piece, np.full(more, -1))
        is_other[changed] = True
        is_other |= block != before
        touched = np.union1d(block[is_other], before[is_other])
        region = np.append(self._region, np.full(more, -1))
        region[block < 0] = -1
        again = np.flatnonzero((block >= 0) & np.isin(block, touched))
        again = again[np.lexsort((key[again], number[again]))]
        ends = np.flatnonzero(np.diff(number[again])) + 1
        for rows in np.split(again, ends) if len(again) else ():
            region[rows] = self._joined(rows, piece[rows])
        self._block, self._piece, self._region = block, piece, region
        found = patches(owner, np.flatnonzero((piece >= 0) & (piece == key)), region)
        return self._separated(found, owner, block)

    def _separated(self, patch: Rows, owner: Rows, block: Indices) -> Rows:
        """Return patches (R,), those across blocks that are no height fields as charts again."""
        graph, size_m = self._graph, self._graph.map.voxel_size_m
        rows = np.flatnonzero(patch >= 0)
        low = np.full(int(patch.max(initial=-1)) + 1, np.iinfo(np.int64).max)
        high = np.full_like(low, -1)
        np.minimum.at(low, patch[rows], block[rows])
        np.maximum.at(high, patch[rows], block[rows])
        found = patch.copy()
        for name in np.flatnonzero(low < high):
            mine = rows[patch[rows] == name]
            mine = mine[np.argsort(graph.key[mine])]
            side = np.empty(len(mine), np.bool_)
            rules = self._limit, STACKED_VOXELS * size_m, size_m
            if bisect_chart(graph.normal[mine], graph.position[mine], *rules, side):
                found[mine] = np.where(owner[mine] < 0, -1, len(low) + owner[mine])
        return found

    def _joined(self, rows: Indices, piece: Indices) -> Indices:
        """Return the region of each row of a block, in the order of their keys, -1 for none."""
        graph, names = self._graph, np.unique(piece[piece >= 0])
        patch = np.where(piece >= 0, np.searchsorted(names, piece), -1).astype(np.int32)
        was_free = patch < 0
        if not len(names):
            return np.full(len(rows), -1)
        order = np.argsort(patch, kind='stable')[was_free.sum() :]
        starts = np.searchsorted(patch[order], np.arange(len(names) + 1))
        normals: Array = np.empty((len(names), 3))
        curved: npt.NDArray[np.bool_] = np.zeros(len(names), np.bool_)
        is_flat = graph.kind == FLAT
        mean_normals(rows[order].astype(np.int32), starts, is_flat, graph.normal, normals)
        points, size_m = graph.position[rows], graph.map.voxel_size_m
        rules = CoarseRules(size_m, graph.thickness_m, (self._noise_m, 0.0))
        for factor in FACTORS:
            if factor > 1.0 and np.count_nonzero(patch < 0) < SPARSE_SHARE * len(patch):
                break
            normals, curved = grow_coarse(points, patch, (normals, curved), factor * size_m, rules)
        came = np.flatnonzero(was_free & (patch >= 0))
        patch[came[~graph.is_thin(rows[came], normals[patch[came]])]] = -1
        least = np.full(len(normals), np.iinfo(np.int64).max)
        np.minimum.at(least, patch[~was_free], piece[~was_free])
        found: Indices = np.where(patch >= 0, least[patch], -1)
        return found


def pieces_in_blocks(owner: Rows, block: Indices, num_blocks: int, key: Indices) -> Indices:
    """Return the least key (R,) of the voxels of the same chart in the same block, -1 for none."""
    held = np.flatnonzero(owner >= 0)
    number = int(owner.max(initial=-1)) + 1
    code = block[held] * number + owner[held]
    least = np.full(num_blocks * number, np.iinfo(np.int64).max)
    np.minimum.at(least, code, key[held])
    found = np.full(len(owner), -1)
    found[held] = least[code]
    return found


def patches(owner: Rows, first: Indices, region: Indices) -> Rows:
    """
    Return the patch of each row (R,), -1 for none: regions of blocks that share a chart.

    Parameters
    ----------
    owner : (R,) int32
        Charts.
    first : (P,) int64
        The row of least key of every chart in every block.
    region : (R,) int64
        Regions by name, -1 for none.

    """
    from scipy.sparse import coo_array  # 0.2 s that maps without models save
    from scipy.sparse.csgraph import connected_components

    names, number = np.unique(region[first]), int(owner.max(initial=-1)) + 1
    ends = owner[first], number + np.searchsorted(names, region[first])
    size = number + len(names)
    links = coo_array((np.ones(len(first), np.bool_), ends), (size, size))
    _, part = connected_components(links, directed=False)
    found = np.full(len(owner), -1, np.int32)
    held = np.flatnonzero(region >= 0)
    found[held] = part[number + np.searchsorted(names, region[held])]
    return found
