# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Charts: what hangs together, cut until each part has one height everywhere over one plane.

A component is cut where its normals turn too far from their mean, or where it lies over itself, as
ramps do. The result depends on the voxels of the component alone, not on how it was cut before.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.kernels.piece_groups import hang_together, mean_normals, suspects
from surfel_mapper.models.folds import FOLD_PERCENTILE, folded, percentile
from surfel_mapper.models.pieces import Pieces

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int32]
Indices = npt.NDArray[np.int64]

STACKED_VOXELS, STACKED_SHARE = 4.0, 0.05
"""A part lies over itself where it is so high in more than this share of its columns; a slope of
60 deg is 2.5 voxels high in one."""


def charts_of(
    pieces: Pieces, rows: Rows, starts: Indices, fold_angle_deg: float, least: int
) -> list[Rows]:
    """
    Return the voxels of every chart.

    Parameters
    ----------
    pieces : Pieces
        The voxels.
    rows, starts : (M,) int32, (K + 1,) int64
        Components: k has rows starts[k] to starts[k + 1] - 1.
    fold_angle_deg : float
        Normals turn at most so far from their mean.
    least : int
        Charts of fewer voxels are left out.

    """
    means, doubtful = np.empty((len(starts) - 1, 3)), np.empty(len(starts) - 1, np.bool_)
    flat = np.ones(len(pieces.key), np.bool_)
    mean_normals(rows, starts, flat, pieces.normal, means)
    rules = (math.cos(math.radians(fold_angle_deg)), STACKED_VOXELS * pieces.map.voxel_size_m)
    suspects(rows, starts, means, pieces.normal, pieces.position, rules, doubtful)
    found: list[Rows] = []
    for k in range(len(means)):
        members = rows[starts[k] : starts[k + 1]]
        if doubtful[k]:
            found += cut(pieces, members[np.argsort(pieces.key[members])], rules[0], least)
        else:
            found.append(members)
    return found


def cut(pieces: Pieces, members: Rows, limit: float, least: int) -> list[Rows]:
    """Return the charts of one component whose rows are in the order of their keys."""
    found, waiting = [], [members]
    while waiting:
        part = waiting.pop()
        if len(part) < least:
            continue
        side = side_of(pieces, part, limit)
        if side is None:
            found.append(part)
        else:
            for half in (part[side], part[~side]):
                waiting += connected(pieces, half)
    return found


def side_of(pieces: Pieces, part: Rows, limit: float) -> npt.NDArray[np.bool_] | None:
    """Return how to halve a part (n,) bool; None where it has one height everywhere."""
    normals = pieces.normal[part]
    mean = unit(normals.sum(axis=0))
    side = folded(normals, mean, limit)
    if side is not None:
        axis = np.linalg.eigh(normals.T @ normals)[1][:, -1]
        if percentile(np.abs(normals @ axis), 100.0 - FOLD_PERCENTILE) < limit:
            return side
        mean = axis  # they are alike but for their signs: nobody saw these voxels from one side
    return stacked(pieces.position[part], mean, pieces.map.voxel_size_m)


def unit(vector: Array) -> Array:
    """Return a vector of length 1; 0 for 0."""
    length = float(np.linalg.norm(vector))
    return vector / length if length > 0.0 else vector


def stacked(points: Array, normal: Array, size_m: float) -> npt.NDArray[np.bool_] | None:
    """Return the upper part (n,) bool of what lies over itself; None where nothing does."""
    heights = points @ normal
    middle = 0.5 * (heights.min() + heights.max())
    if heights.max() - heights.min() <= STACKED_VOXELS * size_m:
        return None
    x = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal)
    across = np.stack([x / np.linalg.norm(x), np.cross(normal, x) / np.linalg.norm(x)])
    columns = np.floor(points @ across.T / size_m).astype(np.int64)
    columns -= columns.min(axis=0)
    number = columns[:, 0] * (columns[:, 1].max() + 1) + columns[:, 1]
    order = np.argsort(number, kind='stable')
    firsts = np.flatnonzero(np.diff(number[order], prepend=-1))
    ordered = heights[order]
    high = np.maximum.reduceat(ordered, firsts) - np.minimum.reduceat(ordered, firsts)
    if np.mean(high > STACKED_VOXELS * size_m) <= STACKED_SHARE:
        return None
    upper: npt.NDArray[np.bool_] = heights > middle
    return upper


def connected(pieces: Pieces, rows: Rows) -> list[Rows]:
    """Return which of some rows hang together, each part in their order."""
    parent = np.empty(len(rows), np.int64)
    hang_together(rows, pieces.links, pieces.around, pieces.places, parent)
    order = np.argsort(parent, kind='stable')
    return np.split(rows[order], np.flatnonzero(np.diff(parent[order])) + 1)
