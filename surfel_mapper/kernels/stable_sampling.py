# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Choose points one by one, each for the motion that those chosen before hold least.

Every choice depends on all before it, which numpy cannot do at once.
"""

from numba import njit
import numpy as np


@njit(cache=True, nogil=True)
def choose(resists, by_motion, number, chosen):
    """
    Choose points.

    resists    (N, 6) float64, how each point resists each motion
    by_motion  (6, N) int64, points by how much they resist a motion, most first
    number     points to choose, at most N
    chosen     (N,) bool, in: false, out: whether chosen
    """
    held = np.zeros(6)
    place = np.zeros(6, np.int64)
    for _ in range(number):
        motion = np.argmin(held)
        while chosen[by_motion[motion, place[motion]]]:
            place[motion] += 1
        point = by_motion[motion, place[motion]]
        chosen[point] = True
        for k in range(6):
            held[k] += resists[point, k] * resists[point, k]
