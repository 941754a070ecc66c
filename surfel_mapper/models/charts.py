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

from surfel_mapper.models.kernels.folds import halve_part
from surfel_mapper.models.kernels.piece_groups import hang_together, mean_normals, suspects
from surfel_mapper.models.pieces import Pieces

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int32]
Indices = npt.NDArray[np.int64]

STACKED_VOXELS = 4.0
"""A part lies over itself in columns that are so high; a slope of 60 deg is 2.5 voxels high."""


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
    found, waiting, size_m = [], [members], pieces.map.voxel_size_m
    while waiting:
        part = waiting.pop()
        if len(part) < least:
            continue
        side = np.empty(len(part), np.bool_)
        normals, points = pieces.normal[part], pieces.position[part]
        if halve_part(normals, points, limit, STACKED_VOXELS * size_m, size_m, side):
            for half in (part[side], part[~side]):
                waiting += connected(pieces, half)
        else:
            found.append(part)
    return found


def connected(pieces: Pieces, rows: Rows) -> list[Rows]:
    """Return which of some rows hang together, each part in their order."""
    parent = np.empty(len(rows), np.int64)
    hang_together(rows, pieces.links, pieces.around, pieces.places, parent)
    if not parent.any():  # as mostly: all with the first
        return [rows]
    order = np.argsort(parent, kind='stable')
    return np.split(rows[order], np.flatnonzero(np.diff(parent[order])) + 1)
