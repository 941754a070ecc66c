# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Growth and joining of the charts of a map, by the rules for one cloud.

A surfel counts as one point. Touching charts are joined if one height field explains both; if many
voxels are on none, planes grow over these in coarser voxels, and are joined across gaps.

A map is joined as a whole, in 1 us a voxel. The result depends on its voxels only, not on history.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.coarse_growth import (
    CoarseRules,
    grow_coarse,
    join_coarse,
    Shape,
    SPARSE_SHARE,
)
from surfel_mapper.models.frames import mean_normals
from surfel_mapper.models.growth import owner_table, pieces_of
from surfel_mapper.models.surfel_graph import SurfelGraph
from surfel_mapper.models.thinning import thin

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int32]

FACTORS = (1.0, 2.0, 4.0)
"""Edges of the voxels in which charts are joined, in those of the map."""

FARTHEST = 16.0
"""Edge of the voxels in which planes grow at last, over single voxels tens of metres apart."""


def join_charts(graph: SurfelGraph, owner: Rows) -> Rows:
    """
    Return the patch of each row (R,), -1 for none.

    Parameters
    ----------
    graph : SurfelGraph
        The voxels.
    owner : (R,) int32
        Chart of each row, with the voxels that it hosts; -1 for none.

    """
    size_m, patches = graph.map.voxel_size_m, np.full(len(owner), -1, np.int32)
    rows = np.flatnonzero(graph.key >= 0)
    rows = rows[np.argsort(graph.key[rows])]
    patch = renumbered(owner[rows])
    number = int(patch.max(initial=-1)) + 1
    if not number:
        return patches
    was_free = patch < 0
    order = np.argsort(patch, kind='stable')[was_free.sum() :]
    starts = np.searchsorted(patch[order], np.arange(number + 1))
    normals = mean_normals(graph.flat_normals(rows[order]), starts)
    shape: Shape = normals, np.zeros(number, np.bool_)
    points = graph.position[rows]
    rules = CoarseRules(size_m, graph.thickness_m, (graph.noise_m, 0.0))
    for factor in FACTORS:
        if factor > 1.0 and np.count_nonzero(patch < 0) < SPARSE_SHARE * len(patch):
            break
        shape = grow_coarse(points, patch, shape, factor * size_m, rules)
        coarse = thin(points, factor * size_m).by_voxel()
        pieces = pieces_of(coarse, owner_table(coarse, patch[coarse.rows]), len(shape[0]))
        shape = join_coarse(pieces, patch, shape, rules)
    else:
        shape = grow_coarse(points, patch, shape, FARTHEST * size_m, rules)
    came = np.flatnonzero(was_free & (patch >= 0))
    patch[came[~graph.is_thin(rows[came], shape[0][patch[came]])]] = -1
    patches[rows] = patch
    return patches


def renumbered(owner: Rows) -> Rows:
    """Return groups (n,) numbered in the order of their first rows, -1 for none."""
    names, first, inverse = np.unique(owner, return_index=True, return_inverse=True)
    first[names < 0] = -1
    rank = np.empty(len(names), np.int32)
    rank[np.argsort(first)] = np.arange(len(names)) - np.count_nonzero(names < 0)
    return rank[inverse.reshape(-1)]
