# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Deskewing: points are moved from the pose of the sensor at their time to that at the stamp.

Between two poses the position is linear and the rotation a slerp, of + - * / and sqrt alone, so
that node and replay get the same bits on any machine. The power series of the slerp is cut after
three terms: poses are given at most 0.005 rad apart, where the next is below 1e-22.
"""

import math

from numba import njit
import numpy as np


@njit(cache=True, nogil=True)
def move_points(points, offsets, knots, poses, turns, min_range_sq, moved):
    """
    Move points to the pose of the scan.

    points        (N, 3) float32 or float64, m, sensor frame at the time of each
    offsets       (N,) int64, ns after the stamp; outside of the knots the nearest one holds
    knots         (K,) int64, ns after the stamp, ascending, one at least
    poses         (K, 3, 4) float64, take points at the knot to the sensor frame at the stamp
    turns         (K, 3) float64, vector part of the unit quaternion that turns knot to next
    min_range_sq  float64, m^2
    moved         (N, 3) float64, out

    A point nearer to the sensor than the range (drivers write 0 0 0 for a ray without a return)
    is put into the origin, still too near; if it were moved, it could become an obstacle.
    """
    last = len(knots) - 1
    at = -1
    start = end = knots[0]
    per_ns = qx = qy = qz = drop = 0.0
    pose = following = poses[0]
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        range_sq = (x * x + y * y) + z * z
        if range_sq == 0.0 or range_sq < min_range_sq:
            moved[i, 0] = moved[i, 1] = moved[i, 2] = 0.0
            continue
        offset = min(max(offsets[i], knots[0]), knots[last])
        if at < 0 or offset < start or offset > end:
            at = max(at, 0)
            while at > 0 and offset < knots[at]:
                at -= 1
            while at < last - 1 and offset > knots[at + 1]:
                at += 1
            start, end = knots[at], knots[min(at + 1, last)]
            per_ns = 1.0 / max(end - start, 1)
            pose, following = poses[at], poses[min(at + 1, last)]
            qx, qy, qz = turns[at, 0], turns[at, 1], turns[at, 2]
            sine_sq = (qx * qx + qy * qy) + qz * qz
            drop = -sine_sq / (1.0 + math.sqrt(1.0 - sine_sq))
        alpha = (offset - start) * per_ns
        weight = slerp_weight(alpha, drop)
        vx, vy, vz = weight * qx, weight * qy, weight * qz
        w = math.sqrt(1.0 - ((vx * vx + vy * vy) + vz * vz))
        cx, cy, cz = 2.0 * (vy * z - vz * y), 2.0 * (vz * x - vx * z), 2.0 * (vx * y - vy * x)
        x, y, z = (
            (x + w * cx) + (vy * cz - vz * cy),
            (y + w * cy) + (vz * cx - vx * cz),
            (z + w * cz) + (vx * cy - vy * cx),
        )
        for axis in range(3):
            t = pose[axis, 3] + alpha * (following[axis, 3] - pose[axis, 3])
            moved[i, axis] = ((pose[axis, 0] * x + pose[axis, 1] * y) + pose[axis, 2] * z) + t


@njit(cache=True, nogil=True, inline='always')
def slerp_weight(alpha, drop):
    """
    Return sin(alpha angle) / sin(angle), drop being the cosine of a small angle less 1.

    The power series of geometry.py, its first four terms.
    """
    a = alpha * alpha
    fourth = (a - 9.0) * drop * (1.0 / 21.0)
    third = (a - 4.0) * drop * (0.1 * (1.0 + fourth))
    second = (a - 1.0) * drop * ((1.0 + third) * (1.0 / 3.0))
    return alpha * (1.0 + second)
