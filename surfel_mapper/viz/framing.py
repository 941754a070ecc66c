# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The view of a map that shows most of it: level on the ground, without a ceiling, without outliers.

A lidar sees single surfaces far beyond the mapped place. A box of all surfels would make the place
itself a spot in an empty picture, so the sparse rims are cut off. The mass of a disc is its
radius: by areas a few large discs far away would count as much as the place.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surfel_mapper.viz.discs import DrawnDiscs
from surfel_mapper.viz.rendering import direction

Array = npt.NDArray[np.float64]

UPRIGHT_DEG = (35.0, 20.0, 10.0, 5.0)
"""Angles to the vertical within which normals are averaged, one after the other."""

LEAST_LEVEL = 0.05
"""Smallest share of the surface that is level ground."""

ABOVE_SENSOR_M, SQUARE_M, LEAST_COVERED = 0.3, 1.0, 0.5
"""Height of a ceiling above the sensor; the smallest share of the floor in squares below it."""

BINS, SPARSE, MOST_OUTSIDE = 96, 0.45, 0.1
"""
Strips along an axis; density of a strip relative to the mean below which it is cut off; limit of
the share of the surface outside.
"""

YAWS = np.radians([28.0, 62.0, 118.0, 152.0, 208.0, 242.0, 298.0, 332.0])
PITCH = np.radians(42.0)
"""Directions tried for the oblique view, from that of the walls, and its height."""


def upright(discs: DrawnDiscs) -> Array:
    """
    Return the rotation (3, 3) from the map to a frame with z up, x as near to that of the map.

    Up is the mean normal of the level surfaces. In the frame of a camera, y is down.
    """
    area = discs.radius_m**2
    axes = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    near = np.cos(np.radians(UPRIGHT_DEG[0]))
    level = [area[discs.normal @ axis > near].sum() for axis in axes]
    axis = up = axes[int(level[1] > 2.0 * level[0])]
    for angle in np.radians(UPRIGHT_DEG):
        rows = discs.normal @ up > np.cos(angle)
        if area[rows].sum() <= LEAST_LEVEL * area.sum():
            up = axis
            break
        mean = (area[rows, None] * discs.normal[rows]).sum(axis=0)
        up = mean / np.linalg.norm(mean)
    across = np.cross(up, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    return np.stack([np.cross(across, up), across, up])


def levelled(discs: DrawnDiscs) -> Array:
    """Return the rotation (3, 3) to z up of a map in the frame of a camera; of others, none."""
    R = upright(discs)
    return R if R[2, 2] < 0.7 else np.eye(3)


def ground_m(level: DrawnDiscs) -> float:
    """Return the height of the ground of upright discs: of the lower of the level surfaces."""
    heights = level.position[level.normal[:, 2] > 0.9, 2]
    heights = heights if len(heights) else level.position[:, 2]
    return float(np.percentile(heights, 20.0)) if len(heights) else 0.0


def ceiling_m(level: DrawnDiscs, sensor_m: float) -> float:
    """Return the height at which upright discs are cut below a ceiling; inf without one."""
    area, height = level.radius_m**2, level.position[:, 2]
    floor = level.normal[:, 2] > 0.7
    above = (level.normal[:, 2] < -0.7) & (height > sensor_m + ABOVE_SENSOR_M)
    square = np.floor(level.position[:, :2] / SQUARE_M) @ np.array([1.0, 1.0j])
    covered = floor & np.isin(square, square[above])
    if not above.any() or area[covered].sum() < LEAST_COVERED * area[floor].sum():
        return np.inf
    order = np.argsort(height[above])
    total = np.cumsum(area[above][order])
    return float(height[above][order][np.searchsorted(total, 0.1 * total[-1])]) - 0.1


def mass_box(at: Array, mass: Array) -> tuple[Array, Array]:
    """
    Return the corners of a rectangle without the sparse rims of points (K, 2), (2,) m each.

    Strips are cut off as long as they are sparse and the mass outside stays below MOST_OUTSIDE.
    """
    if not len(at):
        return np.full(2, -5.0), np.full(2, 5.0)
    low, high = np.percentile(at, [0.2, 99.8], axis=0)
    high = np.maximum(high, low + 1e-3)
    sides = [(float(low[k]), float(high[k])) for k in (0, 1)]
    counts, edges = np.histogramdd(at, BINS, sides, weights=mass)
    spare = MOST_OUTSIDE * mass.sum() - (mass.sum() - counts.sum())
    ends = np.array([[0, BINS], [0, BINS]])
    while True:
        inner = counts[ends[0, 0] : ends[0, 1], ends[1, 0] : ends[1, 1]]
        strips = [inner[0].sum(), inner[-1].sum(), inner[:, 0].sum(), inner[:, -1].sum()]
        shares = np.array(strips) * np.repeat(inner.shape, 2) / max(inner.sum(), 1e-300)
        side = int(shares.argmin())
        if shares[side] >= SPARSE or strips[side] > spare or min(inner.shape) < 4:
            break
        spare -= strips[side]
        ends[side // 2, side % 2] += 1 - 2 * (side % 2)
    corners = np.array([edge[end] for edge, end in zip(edges, ends, strict=True)])
    return corners[:, 0], corners[:, 1]


def wall_yaw(level: DrawnDiscs) -> float:
    """Return the direction of most walls of upright discs, modulo a quarter turn."""
    x, y, _ = level.normal.T
    quarter = (level.radius_m**2 * (x * x + y * y) * np.exp(4j * np.arctan2(y, x))).sum()
    return float(np.angle(quarter) / 4.0)


def best_direction(level: DrawnDiscs, lowest: float, highest: float) -> Array:
    """
    Return the oblique view, (3, 3), in which upright discs fill most of an image.

    ``lowest`` and ``highest`` limit the height of the image relative to its width.
    """
    best, most = direction(wall_yaw(level) + YAWS[0], PITCH), -1.0
    for yaw in wall_yaw(level) + YAWS:
        R = direction(yaw, PITCH)
        facing = level.normal @ R[2]
        mass = np.where(facing > 0.0, level.radius_m * facing, 0.0)
        low, high = mass_box(level.position @ R[:2].T, mass)
        across, along = high - low
        width = max(across, along / highest)
        area = (level.radius_m * mass).sum()
        filled = area / (width * max(along, width * lowest))
        if filled > most:
            best, most = R, filled
    return best
