# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Choose points one by one: for the motion constrained least so far, or the farthest from the rest.

Every choice depends on all before it, so numpy cannot vectorise them. Alone in its module because
these are the compiled loops of filters/sampling.py.
"""

from numba import njit
import numpy as np


@njit(cache=True, nogil=True)
def choose(resists, by_motion, number, chosen):
    """
    Choose points.

    resists    (N, M) float64, how much each point constrains each motion
    by_motion  (M, N) int64, points sorted by that, most first
    number     points to choose, at most N
    chosen     (N,) bool, in: false, out: whether chosen
    """
    num_motions = resists.shape[1]
    constrained = np.zeros(num_motions)
    rank = np.zeros(num_motions, np.int64)
    for _ in range(number):
        motion = np.argmin(constrained)
        while chosen[by_motion[motion, rank[motion]]]:
            rank[motion] += 1
        point = by_motion[motion, rank[motion]]
        chosen[point] = True
        for k in range(num_motions):
            constrained[k] += resists[point, k] * resists[point, k]


@njit(cache=True, nogil=True)
def choose_farthest(points, number, chosen):
    """
    Choose points, each the farthest from those chosen before; the first of equal ones.

    points  (N, 3) float64, finite, m
    number  points to choose, 1 to N
    chosen  (N,) bool, in: false, out: whether chosen; points at one place count once
    """
    nearest_sq = np.full(len(points), np.inf)
    last = 0
    for _ in range(number):
        chosen[last] = True
        x, y, z = points[last, 0], points[last, 1], points[last, 2]
        farthest, far_sq = last, 0.0
        for i in range(len(points)):
            dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
            nearest_sq[i] = min(nearest_sq[i], (dx * dx + dy * dy) + dz * dz)
            if nearest_sq[i] > far_sq:
                farthest, far_sq = i, nearest_sq[i]
        if far_sq == 0.0:
            return
        last = farthest
