# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The area that dense patches cover, cell by cell of one voxel, from all points of the cloud.

Patches are fitted to few points a voxel, so their grids have cells of three voxels with cut
corners, and cover what lies between: on frames of rooms, 4 % of the points were in cells with a
quarter of the samples of the models, 2 cm from the next point. Where the cloud is dense, a cell of
one voxel is covered if it has enough points. A sensor sees a plane with as many points an area as
the cube of the inverse range, so each counts by the cube of its range.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.grid import Grid, rim_of
from surfel_mapper.models.kernels.coverage import count_points
from surfel_mapper.models.multi_model import MultiModel
from surfel_mapper.models.primitives import Plane, Surface

Array = npt.NDArray[np.float64]

LEAST_POINTS = 6
"""Points in the cells that half of the points of a dense patch are in, at least."""

LEAST_SHARE = 0.25
"""A cell is covered if its points weigh this share of those in a usual cell."""

MOST_GAPS = 0.25
"""
Patches with a larger share of empty cells inside stay as they are: rings of a lidar have gaps.
"""

CLOSED_BY = 5
"""A cell with as many covered ones among its 8 neighbours is covered too."""


def covered(model: MultiModel, points: npt.NDArray[Any], view: Array) -> MultiModel:
    """
    Return models whose dense patches cover cells of one voxel.

    Parameters
    ----------
    model : MultiModel
        Models of the points; the ids of patches are 0, 1, 2, ... in order.
    points : (N, 3) float32 or float64, m
        All points of the cloud.
    view : (3,) float64, m
        Position of the sensor.

    """
    patches, pitch_m = model.patches, model.voxel_size_m
    if not patches:
        return model
    frames = np.array([[*patch.R_patch_map, patch.mean] for patch in patches])
    grids = [patch.grid for patch in patches]
    low = np.array([grid.origin for grid in grids]) - pitch_m
    edges = np.array([np.multiply(grid.filled.shape, grid.pitch_m) for grid in grids])
    corners = np.floor(low / pitch_m) * pitch_m
    sizes = ((low + edges + 2.0 * pitch_m - corners) / pitch_m).astype(np.int64) + 1
    ends = sizes.prod(axis=1).cumsum()
    first = ends - sizes.prod(axis=1)
    counts, weights = np.zeros(ends[-1], np.int64), np.zeros(ends[-1])
    table = first, corners, sizes
    count_points(points, model.labels, frames, view, table, pitch_m, counts, weights)
    finer = []
    for k, patch in enumerate(patches):
        own, shape = slice(first[k], ends[k]), tuple(sizes[k])
        cells = counts[own].reshape(shape), weights[own].reshape(shape)
        finer.append(refined(patch, corners[k], pitch_m, cells))
    return replace(
        model,
        planes=finer[: len(model.planes)],
        surfaces=[patch for patch in finer if isinstance(patch, Surface)],
    )


def refined(
    patch: Plane,
    corner: Array,
    pitch_m: float,
    cells: tuple[npt.NDArray[np.int64], Array],
) -> Plane:
    """Return a patch that covers cells with enough points; as it is if these are sparse."""
    counts, weights = cells
    if weighted_median(counts, counts) < LEAST_POINTS:
        return patch
    filled = closed(weights >= LEAST_SHARE * weighted_median(weights, counts))
    if share_of_gaps(patch.grid, filled, corner, pitch_m) > MOST_GAPS:
        return patch
    rows, columns = (np.flatnonzero(filled.any(axis=axis)) for axis in (1, 0))
    filled = filled[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].copy()
    grid = Grid(
        pitch_m=pitch_m,
        origin=corner + pitch_m * np.array([rows[0], columns[0]]),
        filled=filled,
        rim=rim_of(filled),
        corner=np.zeros(filled.shape, np.uint8),
        cuts=np.zeros((*filled.shape, 3), np.uint8),
    )
    return replace(patch, grid=grid)


def weighted_median(values: npt.NDArray[Any], weights: npt.NDArray[Any]) -> float:
    """Return the value up to which half of the weights are; 0 without weights."""
    order = np.argsort(values, axis=None)
    total = np.cumsum(weights.ravel()[order])
    middle = np.searchsorted(total, 0.5 * total[-1])
    return float(values.ravel()[order[min(middle, len(order) - 1)]])


def closed(filled: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return cells (Nx, Ny) with those of which most neighbours are covered."""
    wide, (x, y) = np.pad(filled, 1).astype(np.int8), filled.shape
    around = sum(wide[i : i + x, j : j + y] for i in range(3) for j in range(3)) - filled
    return np.asarray(filled | (around >= CLOSED_BY), np.bool_)


def share_of_gaps(
    grid: Grid, filled: npt.NDArray[np.bool_], corner: Array, pitch_m: float
) -> float:
    """Return the share of empty cells among those inside of the grid, where no cell is cut."""
    inside = grid.filled & ~grid.rim
    middles = [corner[k] + pitch_m * (np.arange(filled.shape[k]) + 0.5) for k in (0, 1)]
    index = [((middles[k] - grid.origin[k]) // grid.pitch_m).astype(np.int64) for k in (0, 1)]
    in_grid = [(index[k] >= 0) & (index[k] < inside.shape[k]) for k in (0, 1)]
    cells = filled[np.ix_(*in_grid)]
    inner = inside[np.ix_(index[0][in_grid[0]], index[1][in_grid[1]])]
    return float(np.mean(~cells[inner])) if inner.any() else 0.0
