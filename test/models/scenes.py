# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Clouds with known truth: sheets, and a room with a box, a cylinder and a ball before a camera.

Everything follows from equations; points are in the frame of the room, m.
"""

from __future__ import annotations

import numpy as np

A = 0.03
"""Voxel size that the room is judged at, m."""

VIEW = np.array([0.0, -0.2, 1.5])
FLOOR, LEFT, BACK, TOP, FRONT, SIDE, CYLINDER, BALL = range(8)
"""Objects of the room: floor, two walls, three faces of the box, and round ones."""

FLAT = (FLOOR, LEFT, BACK, TOP, FRONT, SIDE)

FOCAL_PX = 525.0
BOX = np.array([[0.5, 1.8, 0.0], [1.1, 2.4, 0.7]])
AXIS, CYLINDER_RADIUS = np.array([-0.6, 2.3]), 0.35
CENTRE, BALL_RADIUS = np.array([0.2, 2.9, 0.7]), 0.40
LEFT_X, BACK_Y = -1.8, 3.6


def sheet(width, height, spacing, normal=(0.0, 0.0, 1.0), centre=(0.0, 0.0, 0.0), sigma=0.0):
    """Return points on a rectangle, (N, 3) float64."""
    rng = np.random.default_rng(4)
    x = np.arange(-width / 2, width / 2, spacing)
    y = np.arange(-height / 2, height / 2, spacing)
    local = np.stack([*np.meshgrid(x, y, indexing='ij'), np.zeros((len(x), len(y)))], -1)
    local = local.reshape(-1, 3)
    local[:, 2] += sigma * rng.standard_normal(len(local))
    z = np.array(normal, float) / np.linalg.norm(normal)
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x_axis = np.cross(helper, z) / np.linalg.norm(np.cross(helper, z))
    return local @ np.stack([x_axis, np.cross(z, x_axis), z]) + centre


def rays(columns=640, rows=480):
    """Return the directions (R, 3) of a camera that looks along y and 0.35 down."""
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    scale = 640 / columns / FOCAL_PX
    x = (u - (columns - 1) / 2) * scale
    z = -(v - (rows - 1) / 2) * scale
    tilt = 0.35
    ahead = np.array([0, np.cos(tilt), -np.sin(tilt)])
    up = np.array([0, np.sin(tilt), np.cos(tilt)])
    directions = x[..., None] * np.array([1.0, 0, 0]) + ahead + z[..., None] * up
    return directions.reshape(-1, 3)


def room(columns=640, rows=480, noise_per_range_sq=0.0, seed=3):
    """Return points (N, 3) float32 of a room and the object of each (N,)."""
    d = rays(columns, rows)
    with np.errstate(divide='ignore', invalid='ignore'):
        ranges = [
            -VIEW[2] / d[:, 2],
            (LEFT_X - VIEW[0]) / d[:, 0],
            (BACK_Y - VIEW[1]) / d[:, 1],
        ]
        ranges = [np.where(t > 0, t, np.inf) for t in ranges]
        for axis, place in ((2, BOX[1, 2]), (1, BOX[0, 1]), (0, BOX[0, 0])):
            t = (place - VIEW[axis]) / d[:, axis]
            hit = VIEW + t[:, None] * d
            others = [k for k in range(3) if k != axis]
            inside = ((hit >= BOX[0] - 1e-9) & (hit <= BOX[1] + 1e-9))[:, others].all(axis=1)
            ranges.append(np.where(inside & (t > 0), t, np.inf))
        ranges.append(round_hit(d[:, :2], VIEW[:2] - AXIS, CYLINDER_RADIUS))
        ranges.append(round_hit(d, VIEW - CENTRE, BALL_RADIUS))
    ranges = np.array(ranges)
    ranges[CYLINDER] = np.where(
        (VIEW + ranges[CYLINDER][:, None] * d)[:, 2] <= 1.2, ranges[CYLINDER], np.inf
    )
    which = ranges.argmin(axis=0)
    t = ranges.min(axis=0)
    seen = np.isfinite(t)
    far = t[seen] * np.linalg.norm(d[seen], axis=1)
    noise = noise_per_range_sq * far**2 * np.random.default_rng(seed).standard_normal(seen.sum())
    points = VIEW + d[seen] * (t[seen] * (1.0 + noise / far))[:, None]
    return points.astype(np.float32), which[seen]


def round_hit(d, start, radius):
    """Return the distance along rays to a cylinder or ball about the origin, inf for a miss."""
    a, b, c = (d * d).sum(axis=1), d @ start, start @ start - radius**2
    under_root = b * b - a * c
    t = (-b - np.sqrt(np.maximum(under_root, 0.0))) / a
    return np.where((under_root > 0) & (t > 0), t, np.inf)
