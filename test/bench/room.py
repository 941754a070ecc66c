# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A room seen by a depth camera, both exact: walls, a block, a ball, a circling camera.

Everything follows from equations, so a mesh can be compared with the true surface.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surfel_mapper.tsdf.sensors import CameraModel

FloatArray = npt.NDArray[np.float64]

CAMERA = CameraModel(
    columns=640, rows=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5, max_range_m=8.0
)

ROOM = np.array([[-2.5, -2.0, 0.0], [2.5, 2.0, 2.8]])
BLOCK = np.array([[0.6, -0.5, 0.0], [1.6, 0.5, 0.75]])
BALL, BALL_RADIUS_M = np.array([1.1, 0.0, 1.05]), 0.3


def pose(number: int, of: int = 60) -> FloatArray:
    """Return T_room_camera of one of several stations on a circle, looking at the far side."""
    angle = 2.0 * np.pi * number / of
    ahead = np.array([np.cos(angle), np.sin(angle), -0.25])
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    T[:3, 3] = [-0.9 * np.cos(angle), -0.9 * np.sin(angle), 1.4]
    return T


def depth(T_room_camera: FloatArray) -> npt.NDArray[np.float32]:
    """Return the depth image of the camera, (rows, columns) m along z, without noise."""
    ahead = CAMERA.directions.astype(np.float64) @ T_room_camera[:3, :3].T
    start = T_room_camera[:3, 3]
    with np.errstate(divide='ignore', invalid='ignore'):
        walls = np.sort((ROOM[:, None, None] - start) / ahead, axis=0)[1].min(axis=-1)
        enters, leaves = np.sort((BLOCK[:, None, None] - start) / ahead, axis=0)
        near, far = enters.max(axis=-1), leaves.min(axis=-1)
        block = np.where((near <= far) & (near > 0.0), near, np.inf)
        b = ahead @ (BALL - start)
        under_root = b * b - np.sum((BALL - start) ** 2) + BALL_RADIUS_M**2
        ball = np.where((under_root > 0.0) & (b > 0.0), b - np.sqrt(under_root), np.inf)
    range_m = np.minimum(np.minimum(walls, block), ball)
    found: npt.NDArray[np.float32] = (range_m / CAMERA.ray_length).astype(np.float32)
    return found


def distance(points: FloatArray) -> FloatArray:
    """Return the distance of (N, 3) points from the nearest surface, m."""
    walls = np.abs(box_distance(points, ROOM))
    block = np.abs(box_distance(points, BLOCK))
    ball = np.abs(np.linalg.norm(points - BALL, axis=1) - BALL_RADIUS_M)
    return np.minimum(np.minimum(walls, block), ball)


def box_distance(points: FloatArray, corners: FloatArray) -> FloatArray:
    """Return the signed distance of points to the surface of a box, negative inside."""
    beyond = np.maximum(corners[0] - points, points - corners[1])
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    result: FloatArray = outside + np.minimum(beyond.max(axis=1), 0.0)
    return result
