# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A grid of costs of the ground: its slope, and the height of its steps.

A cell is a column of voxels. Its ground is its lowest surfel and those above it that are too low
for a robot to pass under. A slope is no step: heights of neighbouring cells are compared on the
border between them, each continued along its own slope to there.

Only flat surfels (Surfels.is_flat) tell a slope. A cell without one is unknown, unless a step
makes it an obstacle: heights are right even if a normal is not. The number of scans does not
matter: a robot may stand still, and a map may be of one merged cloud.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import Record
from surfel_mapper.config import GridConfig
from surfel_mapper.mapping.surfels import Surfels

UNKNOWN = -1
"""Cost of a cell without a flat surfel, as nav_msgs/OccupancyGrid has it."""

OBSTACLE = 100
"""Cost of a cell that cannot be driven on."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class CostGrid(Record):
    """
    Costs of the cells of an area.

    Attributes
    ----------
    resolution_m : float
        Edge of a cell.
    origin : (2,) float64, m
        x and y of the outer corner of the first cell.
    cost : (rows along y, columns along x) int8
        0 free to 100 obstacle, -1 unknown.

    """

    resolution_m: float
    origin: npt.NDArray[np.float64]
    cost: npt.NDArray[np.int8]


@dataclass(frozen=True, slots=True, eq=False)
class CellGround:
    """The ground of the cells that hold surfels, one row a cell, by ascending cell."""

    cell: npt.NDArray[np.int64]
    top: npt.NDArray[np.int64]
    lowest: npt.NDArray[np.int64]
    upright: npt.NDArray[np.float64]
    has_slope: npt.NDArray[np.bool_]


def traversability(
    surfels: Surfels, voxel_size_m: float, center: npt.ArrayLike, limits: GridConfig
) -> CostGrid:
    """
    Return the costs of the ground around a position.

    Parameters
    ----------
    surfels : Surfels
        In a frame whose z is up; those without a normal are left out.
    voxel_size_m : float
        Edge of a voxel, and of a cell.
    center : (2,) float, m
        Centre of the grid.
    limits : GridConfig
        Size of the grid, and the slope and step that make an obstacle.

    Returns
    -------
    CostGrid
        The larger of slope and step, in percent of its limit; 100 from the limit on. A cell
        without a flat surfel has only the cost of a step that is an obstacle.

    """
    number = max(math.ceil(limits.size_m / voxel_size_m), 1)
    first = np.floor(np.asarray(center, np.float64) / voxel_size_m).astype(np.int64) - number // 2
    index = surfels.voxel_index[:, :2] - first
    inside = ((index >= 0) & (index < number)).all(axis=1) & np.isfinite(surfels.planarity)
    cost = np.full(number * number, UNKNOWN, np.int8)
    if inside.any():
        chosen = surfels.select(inside)
        cell = index[inside, 1] * number + index[inside, 0]
        ground = ground_of(chosen, cell, limits.clearance_m)
        slope_deg = np.degrees(np.arccos(np.minimum(ground.upright, 1.0)))
        step_m = steps(chosen, ground, voxel_size_m, number, limits.max_slope_deg)
        step = step_m / limits.max_step_m
        share = np.maximum(slope_deg / limits.max_slope_deg, step)
        valid = ground.has_slope | (step >= 1.0)
        cost[ground.cell[valid]] = np.minimum(share[valid] * OBSTACLE, OBSTACLE).astype(np.int8)
    origin = first.astype(np.float64) * voxel_size_m
    return CostGrid(voxel_size_m, origin, cost.reshape(number, number))


def ground_of(surfels: Surfels, cell: npt.NDArray[np.int64], clearance_m: float) -> CellGround:
    """Return the ground of every cell: its lowest, top and steepest flat surfel."""
    height = surfels.position[:, 2]
    order = np.lexsort((height, cell))
    starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
    lowest = order[starts]
    bottom = np.repeat(height[lowest], np.diff(starts, append=len(order)))
    is_ground = height[order] <= bottom + clearance_m
    number = np.add.reduceat(is_ground.astype(np.int64), starts)
    is_flat = is_ground & surfels.is_flat[order]
    upright = np.where(is_flat, np.abs(surfels.normal[order, 2]), 1.0)
    return CellGround(
        cell=cell[lowest],
        top=order[starts + number - 1],
        lowest=lowest,
        upright=np.minimum.reduceat(upright, starts),
        has_slope=np.logical_or.reduceat(is_flat, starts),
    )


def steps(
    surfels: Surfels, ground: CellGround, voxel_size_m: float, number: int, max_slope_deg: float
) -> npt.NDArray[np.float64]:
    """Return the highest step within each cell and towards its four neighbours, m."""
    steepest = math.tan(math.radians(min(max_slope_deg, 89.0)))
    top, lowest = surfels.position[ground.top], surfels.position[ground.lowest]
    normal = surfels.normal[ground.top]
    upright = np.where(normal[:, 2] == 0.0, 1e-9, normal[:, 2])
    slope = np.clip(-normal[:, :2] / upright[:, None], -steepest, steepest)
    slope[~surfels.is_flat[ground.top]] = 0.0
    rise = ((top - lowest)[:, :2] * slope).sum(axis=1)
    highest = np.abs(top[:, 2] - lowest[:, 2] - rise)
    row_of = np.full(number * number, -1)
    row_of[ground.cell] = np.arange(len(ground.cell))
    index = surfels.voxel_index[ground.top, :2]
    for axis, stride in ((0, 1), (1, number)):
        has_next = ground.cell // (number if axis else 1) % number < number - 1
        own = np.flatnonzero(has_next)
        neighbour = row_of[ground.cell[own] + stride]
        own, neighbour = own[neighbour >= 0], neighbour[neighbour >= 0]
        border = (index[own] + 0.5) * voxel_size_m
        border[:, axis] += 0.5 * voxel_size_m
        heights = [
            top[rows, 2] + ((border - top[rows, :2]) * slope[rows]).sum(axis=1)
            for rows in (own, neighbour)
        ]
        step = np.abs(heights[0] - heights[1])
        for rows in (own, neighbour):  # each row is the neighbour of one at most
            highest[rows] = np.maximum(highest[rows], step)
    return np.asarray(highest)
