# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Free space and obstacles for planners: slices at heights, and Euclidean distances in a box.

The signed distances of the field are measured along rays and end at the truncation; a planner
needs the Euclidean distance to the nearest obstacle at any position. It is computed on request
from the occupied voxels by scipy's exact transform (Maurer, Qi and Raghavan 2003).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from surfel_mapper.arguments import as_numbers
from surfel_mapper.layers.costs.traversability import CostGrid, OBSTACLE
from surfel_mapper.layers.costs.traversability import UNKNOWN as UNSEEN
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.queries import checked_size, extent, OCCUPIED, states, UNKNOWN

MAX_INDEX = 1 << 31
"""Limit of the index of a voxel; those of blocks are int32."""

COSTS = np.array([UNSEEN, 0, OBSTACLE], np.int8)
"""Occupancy grid values of unknown, free and occupied voxels."""


@dataclass(frozen=True, kw_only=True)
class ObstacleDistances:
    """
    Euclidean distances to the nearest occupied voxel of a box.

    Attributes
    ----------
    voxel_size_m : float
        Edge of a voxel.
    origin : (3,) float64, m
        Lower corner of the first voxel, map frame.
    distance_m : (nx, ny, nz) float32
        Between voxel centres; 0 for occupied voxels, inf if the box has none.
    known : (nx, ny, nz) bool
        Whether a voxel was observed.

    """

    voxel_size_m: float
    origin: npt.NDArray[np.float64]
    distance_m: npt.NDArray[np.float32]
    known: npt.NDArray[np.bool_]

    def at_height(self, height_m: float) -> npt.NDArray[np.float32]:
        """
        Return the distances of the voxel layer at a height, (nx, ny).

        Raises
        ------
        ValueError
            If the height is outside of the box.

        """
        layer = int(np.floor((height_m - self.origin[2]) / self.voxel_size_m))
        if not 0 <= layer < self.distance_m.shape[2]:
            top = self.origin[2] + self.distance_m.shape[2] * self.voxel_size_m
            raise ValueError(
                f'height {height_m} m, expected one within [{self.origin[2]:g}, {top:g}) m'
            )
        return self.distance_m[:, :, layer]


def slice_at(blocks: BlockMap, height_m: float) -> CostGrid:
    """
    Return the occupancy grid of all blocks at a height.

    Raises
    ------
    MapLimitError
        If the blocks span more than MAX_VOXELS.

    """
    size_m = blocks.config.voxel_size_m
    layer = int(np.floor(height_m / size_m))
    index = blocks.index(blocks.rows())
    index = index[index[:, 2] == layer // blocks.config.voxels_per_side]
    if not len(index):
        return CostGrid(resolution_m=size_m, origin=np.zeros(2), cost=np.empty((0, 0), np.int8))
    low, high = extent(blocks, index)
    low[2], high[2] = layer, layer + 1
    found = box_states(blocks, low, high)[:, :, 0]
    origin = np.asarray(low[:2] * size_m, np.float64)
    return CostGrid(resolution_m=size_m, origin=origin, cost=COSTS[found.T])


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
    side, size_m = blocks.config.voxels_per_side, blocks.config.voxel_size_m
    layers = np.floor(np.asarray(heights_m) / size_m).astype(np.int64)
    rows = blocks.rows()
    index = blocks.index(rows)
    chosen = (index[:, 2] >= layers[0] // side) & (index[:, 2] <= layers[1] // side)
    if radius_m > 0.0:
        offsets = (index[:, :2] + 0.5) * blocks.config.block_size_m - np.asarray(center)
        chosen &= np.linalg.norm(offsets, axis=1) <= radius_m
    rows, index = rows[chosen], index[chosen]
    if not len(rows):
        return CostGrid(resolution_m=size_m, origin=np.zeros(2), cost=np.empty((0, 0), np.int8))
    low, high = extent(blocks, index)
    checked_size((high - low)[:2])
    occupied, seen = columns_between(blocks, rows, layers)
    distance = np.full(occupied.shape, max_m)
    if occupied.any():
        distance = np.minimum(distance_transform_edt(~occupied, sampling=size_m), max_m)
    cost = np.minimum(np.rint(100.0 * (1.0 - distance / max_m)), OBSTACLE - 1)
    cost = np.where(occupied, OBSTACLE, np.where(seen, cost, UNSEEN)).astype(np.int8)
    origin = np.asarray(low[:2] * size_m, np.float64)
    return CostGrid(resolution_m=size_m, origin=origin, cost=cost)


def columns_between(
    blocks: BlockMap, rows: npt.NDArray[np.int64], layers: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Return which columns of voxels, (ny, nx), are occupied and observed between two layers."""
    side, index = blocks.config.voxels_per_side, blocks.index(rows)
    low, high = extent(blocks, index)
    columns, lines = (high - low)[:2].tolist()
    layer = index[:, 2:] * side + np.arange(side)
    between = ((layer >= layers[0]) & (layer <= layers[1]))[:, :, None, None]
    known = (blocks.weight[rows] > 0.0).reshape(-1, side, side, side) & between
    near = blocks.distance[rows].reshape(known.shape) <= 0.5 * blocks.config.voxel_size_m
    first = index[:, :2] * side - low[:2]
    found = []
    for here in (known & near, known):
        cells = np.zeros((lines, columns), bool)
        number, y, x = np.nonzero(here.any(axis=1))
        cells[first[number, 1] + y, first[number, 0] + x] = True
        found.append(cells)
    return found[0], found[1]


def obstacle_distances(
    blocks: BlockMap,
    low_m: npt.ArrayLike | None = None,
    high_m: npt.ArrayLike | None = None,
) -> ObstacleDistances:
    """
    Return the distance to the nearest occupied voxel in a box.

    Parameters
    ----------
    blocks : BlockMap
        The field.
    low_m, high_m : (3,) float, optional
        Corners of the box, map frame, m; by default it spans all blocks. Obstacles outside of
        the box do not count.

    Raises
    ------
    ValueError
        If a corner is not (3,), beyond the indices of voxels, or low is not below high.
    MapLimitError
        If the box has more than MAX_VOXELS.

    """
    size_m = blocks.config.voxel_size_m
    low, high = extent(blocks, blocks.index(blocks.rows()))
    if low_m is not None:
        low = np.floor(in_voxels('low_m', low_m, size_m)).astype(np.int64)
    if high_m is not None:
        high = np.ceil(in_voxels('high_m', high_m, size_m)).astype(np.int64)
    if low.shape != (3,) or high.shape != (3,) or (low > high).any():
        raise ValueError(f'box from {low * size_m} to {high * size_m} m, expected low below high')
    found = box_states(blocks, low, high)
    occupied = found == OCCUPIED
    distance = np.full(found.shape, np.inf, np.float32)
    if occupied.any():
        distance = distance_transform_edt(~occupied, sampling=size_m).astype(np.float32)
    return ObstacleDistances(
        voxel_size_m=size_m,
        origin=np.asarray(low * size_m, np.float64),
        distance_m=distance,
        known=found != UNKNOWN,
    )


def box_states(
    blocks: BlockMap, low: npt.NDArray[np.int64], high: npt.NDArray[np.int64]
) -> npt.NDArray[np.uint8]:
    """Return the states of the voxels in [low, high), (nx, ny, nz)."""
    shape = tuple(checked_size(high - low).tolist())
    found = np.empty(shape, np.uint8)
    y, z = (np.arange(low[axis], high[axis]) for axis in (1, 2))
    for plane in range(shape[0]):
        places = np.stack(np.meshgrid(low[0] + plane, y, z, indexing='ij'), axis=-1)
        centers = (places.reshape(-1, 3) + 0.5) * blocks.config.voxel_size_m
        found[plane] = states(blocks, centers).reshape(shape[1:])
    return found


def in_voxels(name: str, place: npt.ArrayLike, size_m: float) -> npt.NDArray[np.float64]:
    """Return a place in units of voxels; raise ValueError if no voxel has it."""
    found = as_numbers(name, place)
    if not (np.abs(found) < MAX_INDEX * size_m).all():  # false for nan
        raise ValueError(f'{name}: {found.tolist()}, expected within {MAX_INDEX * size_m:g} m')
    return found / size_m
