# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Free space and obstacles for planners in the plane: slices at heights.

Distances in the plane are scipy's exact transform (Maurer, Qi and Raghavan 2003). See
tsdf/euclidean.py for those in space.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from surfel_mapper.layers.costs.traversability import CostGrid, OBSTACLE
from surfel_mapper.layers.costs.traversability import UNKNOWN as UNSEEN
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.queries import checked_size, extent


def slice_at(blocks: BlockMap, height_m: float) -> CostGrid:
    """
    Return the occupancy grid of all blocks at a height.

    Raises
    ------
    MapLimitError
        If the blocks span more than MAX_VOXELS.

    """
    occupied, observed, origin = columns_between(blocks, (height_m, height_m))
    cost = np.where(occupied, OBSTACLE, np.where(observed, 0, UNSEEN)).astype(np.int8)
    return CostGrid(resolution_m=blocks.config.voxel_size_m, origin=origin, cost=cost)


def clearance_slice(
    blocks: BlockMap,
    heights_m: tuple[float, float],
    max_m: float,
    center: npt.ArrayLike = (0.0, 0.0),
    radius_m: float = 0.0,
) -> CostGrid:
    """
    Return costs by the horizontal distance to the nearest obstacle between two heights.

    Parameters
    ----------
    blocks : BlockMap
        The field.
    heights_m : (float, float)
        Lowest and largest height of obstacles, m, both included.
    max_m : float
        Distance from which a cell costs nothing, m.
    center : (2,) float, m
        Centre of the area.
    radius_m : float
        Blocks within this of the centre count, m; 0: all.

    Returns
    -------
    CostGrid
        100 in obstacles, else 100 (1 - distance / max_m), at most 99; -1 if none of the voxels
        between the heights was observed.

    Raises
    ------
    MapLimitError
        If the blocks span more than MAX_VOXELS.

    """
    size_m = blocks.config.voxel_size_m
    occupied, observed, origin = columns_between(blocks, heights_m, center, radius_m)
    distance = np.full(occupied.shape, max_m)
    if occupied.any():
        distance = np.minimum(distance_transform_edt(~occupied, sampling=size_m), max_m)
    cost = np.minimum(np.rint(100.0 * (1.0 - distance / max_m)), OBSTACLE - 1)
    cost = np.where(occupied, OBSTACLE, np.where(observed, cost, UNSEEN)).astype(np.int8)
    return CostGrid(resolution_m=size_m, origin=origin, cost=cost)


def columns_between(
    blocks: BlockMap,
    heights_m: tuple[float, float],
    center: npt.ArrayLike = (0.0, 0.0),
    radius_m: float = 0.0,
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_], npt.NDArray[np.float64]]:
    """
    Return which columns of voxels, (ny, nx), are occupied and observed between two heights.

    Third comes the lowest corner of the columns, x y, m.
    """
    side, size_m = blocks.config.voxels_per_side, blocks.config.voxel_size_m
    layers = np.floor(np.asarray(heights_m) / size_m).astype(np.int64)
    rows = blocks.rows()
    index = blocks.index(rows)
    chosen = (index[:, 2] >= layers[0] // side) & (index[:, 2] <= layers[1] // side)
    if radius_m > 0.0:
        offsets = (index[:, :2] + 0.5) * blocks.config.block_size_m - np.asarray(center)
        chosen &= np.linalg.norm(offsets, axis=1) <= radius_m
    rows, index = rows[chosen], index[chosen]
    low, high = extent(blocks, index)
    columns, lines = checked_size((high - low)[:2]).tolist()
    layer = index[:, 2:] * side + np.arange(side)
    between = ((layer >= layers[0]) & (layer <= layers[1]))[:, :, None, None]
    observed = (blocks.weight[rows] > 0.0).reshape(-1, side, side, side) & between
    near = blocks.distance[rows].reshape(observed.shape) <= 0.5 * size_m
    first = index[:, :2] * side - low[:2]
    masks = []
    for voxels in (observed & near, observed):
        cells = np.zeros((lines, columns), bool)
        number, y, x = np.nonzero(voxels.any(axis=1))
        cells[first[number, 1] + y, first[number, 0] + x] = True
        masks.append(cells)
    return masks[0], masks[1], np.asarray(low[:2] * size_m, np.float64)
