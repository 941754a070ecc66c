# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Deskewing: points moved from the pose at their time to that at the stamp.

Between two poses the position is linear and the rotation a slerp, of + - * / and sqrt alone, so
that node and replay get the same bits on any machine. The power series of the slerp is cut after
three terms: poses are given at most 0.005 rad apart, where the next is below 1e-22.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel
from surfel_mapper.kernels.grouping import CHUNK

NEVER = np.iinfo(np.int64).max
"""A time later than all."""


@kernel()
def move_points(points, offsets, knots, poses, turns, min_range_sq, moved):
    """
    Move points to the pose of the scan.

    points        (3, N) float32 or float64, m, sensor frame at the time of each
    offsets       (N,) int64, ns after the stamp; outside of the knots the nearest one holds
    knots         (K,) int64, ns after the stamp, ascending, one at least
    poses         (K, 3, 4) float64, take points at the knot to the sensor frame at the stamp
    turns         (K, 3) float64, vector part of the unit quaternion that turns knot to next
    min_range_sq  float64, m^2
    moved         (3, N) float64, out

    A point nearer to the sensor than the range (drivers write 0 0 0 for a ray without a return)
    is put into the origin, still too near; if it were moved, it could become an obstacle.

    Points that follow each other mostly lie between the same two knots: such a run is moved with
    vector instructions, in a quarter of the time of one point after the other.
    """
    last = len(knots) - 1
    at = 0
    is_placed = False
    near, within = np.empty(CHUNK, np.bool_), np.empty(CHUNK, np.int64)
    all_x, all_y, all_z = points[0], points[1], points[2]
    out_x, out_y, out_z = moved[0], moved[1], moved[2]
    for first in range(0, len(all_x), CHUNK):
        num = min(CHUNK, len(all_x) - first)
        chunk = slice(first, first + num)
        xs, ys, zs, times = all_x[chunk], all_y[chunk], all_z[chunk], offsets[chunk]
        earliest, latest = NEVER, -NEVER
        for i in range(np.uint64(num)):
            x, y, z = np.float64(xs[i]), np.float64(ys[i]), np.float64(zs[i])
            range_sq = (x * x + y * y) + z * z
            is_near = (range_sq == 0.0) | (range_sq < min_range_sq)
            time = min(max(times[i], knots[0]), knots[last])
            near[i], within[i] = is_near, time
            earliest = min(earliest, NEVER if is_near else time)
            latest = max(latest, -NEVER if is_near else time)
        begin = 0
        while begin < num:
            start, end = knots[at], knots[min(at + 1, last)]
            offset = within[begin]
            if not near[begin] and (not is_placed or offset < start or offset > end):
                is_placed = True
                while at > 0 and offset < knots[at]:
                    at -= 1
                while at < last - 1 and offset > knots[at + 1]:
                    at += 1
                start, end = knots[at], knots[min(at + 1, last)]
            is_whole = is_placed and start <= earliest and latest <= end
            stop = num if is_whole else begin + 1
            while stop < num and (near[stop] or (is_placed and start <= within[stop] <= end)):
                stop += 1
            run = slice(first + begin, first + stop)
            pair = poses[at], poses[min(at + 1, last)]
            move_run(
                (all_x[run], all_y[run], all_z[run]),
                within[begin:stop],
                near[begin:stop],
                start,
                end,
                pair,
                turns[at],
                (out_x[run], out_y[run], out_z[run]),
            )
            begin = stop


@inlined()
def move_run(points, offsets, near, start, end, pair, turn, moved):
    """
    Move the points of a run, all between the same two knots.

    points      x, y, z (R,) each, m
    offsets     (R,) int64, ns after the stamp, from start to end
    near        (R,) bool, points to put into the origin
    start, end  int64, the knots, ns after the stamp
    pair        (3, 4) float64 each, the poses at both
    turn        (3,) float64, vector part of the quaternion between them
    moved       x, y, z (R,) float64 each, out
    """
    (a00, a01, a02, a03), (a10, a11, a12, a13), (a20, a21, a22, a23) = rows_of(pair[0])
    dx, dy, dz = pair[1][0, 3] - a03, pair[1][1, 3] - a13, pair[1][2, 3] - a23
    qx, qy, qz = turn[0], turn[1], turn[2]
    per_ns = 1.0 / max(end - start, 1)
    sine_sq = (qx * qx + qy * qy) + qz * qz
    drop = -sine_sq / (1.0 + math.sqrt(1.0 - sine_sq))
    px, py, pz = points
    mx, my, mz = moved
    for i in range(np.uint64(len(px))):
        x, y, z = np.float64(px[i]), np.float64(py[i]), np.float64(pz[i])
        alpha = (offsets[i] - start) * per_ns
        weight = slerp_weight(alpha, drop)
        vx, vy, vz = weight * qx, weight * qy, weight * qz
        w = math.sqrt(1.0 - ((vx * vx + vy * vy) + vz * vz))
        cx, cy, cz = 2.0 * (vy * z - vz * y), 2.0 * (vz * x - vx * z), 2.0 * (vx * y - vy * x)
        x, y, z = (
            (x + w * cx) + (vy * cz - vz * cy),
            (y + w * cy) + (vz * cx - vx * cz),
            (z + w * cz) + (vx * cy - vy * cx),
        )
        mx[i] = 0.0 if near[i] else ((a00 * x + a01 * y) + a02 * z) + (a03 + alpha * dx)
        my[i] = 0.0 if near[i] else ((a10 * x + a11 * y) + a12 * z) + (a13 + alpha * dy)
        mz[i] = 0.0 if near[i] else ((a20 * x + a21 * y) + a22 * z) + (a23 + alpha * dz)


@njit(cache=True, nogil=True, inline='always')
def rows_of(pose):
    """Return the rows of a (3, 4) matrix as tuples."""
    return (
        (pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]),
        (pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]),
        (pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]),
    )


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
