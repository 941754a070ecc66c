# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Choose points one by one, each for the motion constrained least so far.

Every choice depends on all before it, which numpy cannot vectorise.
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
