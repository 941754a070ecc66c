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

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.grid import Grid
from surfel_mapper.models.kernels.coverage import count_points
from surfel_mapper.models.multi_model import MultiModel
from surfel_mapper.models.primitives import Surface

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

LEAST_POINTS = 6
"""Points in the cells of a dense patch, at least; each cell counts by its points."""

LEAST_MEAN = 1.0
"""Patches with fewer points in the area of a cell have too many gaps, and are not looked at."""

LEAST_SHARE = 0.25
"""A cell is covered if its points weigh this share of those in a usual cell of its patch."""

MOST_GAPS = 0.25
"""Patches with more empty cells inside stay as they are: between rings of a lidar are gaps."""

CLOSED_BY = 5
"""A cell with as many covered ones among its 8 neighbours is covered too."""

SIDES = ((-1, 0), (1, 0), (0, -1), (0, 1))
CORNERS = ((-1, -1), (-1, 1), (1, -1), (1, 1))


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
    every, pitch_m = model.patches, model.voxel_size_m
    number = np.bincount(model.labels[model.labels >= 0], minlength=len(every))
    cells = [np.count_nonzero(p.grid.filled) * (p.grid.pitch_m / pitch_m) ** 2 for p in every]
    chosen = np.flatnonzero(number[: len(every)] >= LEAST_MEAN * np.array(cells))
    if not len(chosen):
        return model
    patches = [every[k] for k in chosen]
    index = np.full(len(number) + 1, -1, np.int32)
    index[chosen] = np.arange(len(chosen))
    labels = model.labels if len(chosen) == len(every) else index[model.labels]
    frames = np.array([[*patch.R_patch_map, patch.mean] for patch in patches])
    table = VoxelCells.around([patch.grid for patch in patches], pitch_m)
    counts, weights = np.zeros(len(table.of), np.int64), np.zeros(len(table.of))
    grids = table.first, table.corners, table.sizes
    count_points(points, labels, frames, view, grids, pitch_m, counts, weights)
    counts[table.is_margin] = 0
    total = np.maximum(np.add.reduceat(counts, table.first), 1)
    usual_count = np.add.reduceat(counts * counts, table.first) / total
    usual_weight = np.add.reduceat(weights * counts, table.first) / total
    filled = (counts > 0) & (weights >= LEAST_SHARE * usual_weight[table.of])
    filled |= (table.around_each(filled, SIDES + CORNERS) >= CLOSED_BY) & ~table.is_margin
    rim = filled & (table.around_each(filled, SIDES) < len(SIDES))
    dense = usual_count >= LEAST_POINTS
    dense &= table.share_of_gaps([patch.grid for patch in patches], filled) <= MOST_GAPS
    finer = list(every)
    for k in np.flatnonzero(dense).tolist():
        finer[chosen[k]] = replace(patches[k], grid=table.grid(k, filled, rim))
    return replace(
        model,
        planes=finer[: len(model.planes)],
        surfaces=[patch for patch in finer if isinstance(patch, Surface)],
    )


@dataclass(frozen=True, slots=True, eq=False)
class VoxelCells:
    """
    Cells of one voxel of all patches, patch after patch, y within x, with a margin around each.

    Attributes
    ----------
    pitch_m : float
        Edge of a cell.
    corners : (K, 2) float64, m
        Lowest corner of the cells of each patch, in its frame.
    sizes : (K, 2) int64
        Cells along x and y.
    first : (K,) int64
        First cell of each patch.
    of, x, y : (C,) int64
        Patch of each cell, and its place.

    """

    pitch_m: float
    corners: Array
    sizes: Indices
    first: Indices
    of: Indices
    x: Indices
    y: Indices

    @classmethod
    def around(cls, grids: list[Grid], pitch_m: float) -> VoxelCells:
        """Return the cells that lie over grids, and two more on each side."""
        low = np.array([grid.origin for grid in grids])
        high = low + np.array([np.multiply(grid.filled.shape, grid.pitch_m) for grid in grids])
        corners = (np.floor(low / pitch_m) - 2.0) * pitch_m
        sizes = np.ceil((high - corners) / pitch_m).astype(np.int64) + 2
        number = sizes.prod(axis=1)
        first = np.cumsum(number) - number
        of = np.repeat(np.arange(len(grids)), number)
        x, y = np.divmod(np.arange(len(of)) - first[of], sizes[of, 1])
        return cls(pitch_m, corners, sizes, first, of, x, y)

    @property
    def is_margin(self) -> npt.NDArray[np.bool_]:
        """Whether cells are the first or the last of their row or column, (C,)."""
        ends = self.sizes[self.of] - 1
        at = np.stack([self.x, self.y], axis=1)
        return np.asarray(((at == 0) | (at == ends)).any(axis=1), np.bool_)

    def around_each(
        self, filled: npt.NDArray[np.bool_], steps: tuple[tuple[int, int], ...]
    ) -> Indices:
        """Return the number of filled cells among those at some steps from each, (C,)."""
        row, width = np.arange(len(filled)), self.sizes[self.of, 1]
        number = np.zeros(len(filled), np.int64)
        for x, y in steps:  # beyond the margin of a patch is that of another, which is empty
            number += filled[np.clip(row + x * width + y, 0, len(filled) - 1)]
        return number

    def share_of_gaps(self, grids: list[Grid], filled: npt.NDArray[np.bool_]) -> Array:
        """Return the share of empty cells inside of each grid, where no cell is cut, (K,)."""
        inside = np.concatenate([(grid.filled & ~grid.rim).ravel() for grid in grids])
        shapes = np.array([grid.filled.shape for grid in grids])
        start = np.cumsum(shapes.prod(axis=1)) - shapes.prod(axis=1)
        shift = self.corners - np.array([grid.origin for grid in grids])
        pitch_m = np.array([grid.pitch_m for grid in grids])[self.of]
        middle = self.pitch_m * (np.stack([self.x, self.y], axis=1) + 0.5) + shift[self.of]
        cell = np.floor(middle / pitch_m[:, None]).astype(np.int64)
        is_over = ((cell >= 0) & (cell < shapes[self.of])).all(axis=1)
        at = start[self.of] + cell[:, 0] * shapes[self.of, 1] + cell[:, 1]
        inner = is_over & inside[np.where(is_over, at, 0)]
        number = np.bincount(self.of[inner], minlength=len(grids))
        gaps = np.bincount(self.of[inner & ~filled], minlength=len(grids))
        return np.asarray(gaps / np.maximum(number, 1), np.float64)

    def grid(self, patch: int, filled: npt.NDArray[np.bool_], rim: npt.NDArray[np.bool_]) -> Grid:
        """Return the filled cells of a patch, without empty rows at its ends."""
        shape = tuple(self.sizes[patch].tolist())
        own = slice(self.first[patch], self.first[patch] + shape[0] * shape[1])
        cells = filled[own].reshape(shape)
        rows, columns = (np.flatnonzero(cells.any(axis=axis)) for axis in (1, 0))
        part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        kept = cells[part].copy()
        return Grid(
            pitch_m=self.pitch_m,
            origin=self.corners[patch] + self.pitch_m * np.array([rows[0], columns[0]]),
            filled=kept,
            rim=rim[own].reshape(shape)[part].copy(),
            corner=np.zeros(kept.shape, np.uint8),
            cuts=np.zeros((*kept.shape, 3), np.uint8),
        )
