# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Halve a surface by the normals of its pieces: 2-means that begin across their longest axis.

A surface has some dozen pieces, for which the calls of numpy take ten times as long.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.eigen_frames import eigen_frame

MEANS_ITERATIONS = 20


@njit(cache=True, nogil=True, error_model='numpy')
def halve_normals(normals, side):
    """
    Find the halves of normals; return whether both hold some.

    normals  (n, 3) float64
    side     (n,) bool, out
    """
    number = len(normals)
    mean, scatter = np.zeros(3), np.zeros((3, 3))
    values, axes = np.empty(3), np.empty((3, 3))
    for i in range(number):
        for j in range(3):
            mean[j] += normals[i, j] / number
    for i in range(number):
        for j in range(3):
            for k in range(3):
                scatter[j, k] += (normals[i, j] - mean[j]) * (normals[i, k] - mean[k])
    eigen_frame(scatter, values, axes)
    plane = np.empty(4)
    plane[:3] = axes[2]
    plane[3] = axes[2, 0] * mean[0] + axes[2, 1] * mean[1] + axes[2, 2] * mean[2]
    sums, counts = np.empty((2, 3)), np.empty(2)
    for iteration in range(MEANS_ITERATIONS + 1):
        sums[:] = 0.0
        counts[:] = 0.0
        changed = False
        for i in range(number):
            along = 0.0
            for j in range(3):
                along += normals[i, j] * plane[j]
            beyond = along > plane[3]
            changed = changed or beyond != side[i]
            side[i] = beyond
            half = 1 if beyond else 0
            counts[half] += 1.0
            for j in range(3):
                sums[half, j] += normals[i, j]
        if counts[0] == 0.0 or counts[1] == 0.0:
            return False
        if iteration > 0 and not changed:
            break
        plane[3] = 0.0
        for j in range(3):
            first, second = sums[1, j] / counts[1], sums[0, j] / counts[0]
            plane[j] = first - second
            plane[3] += 0.5 * (first * first - second * second)
    return True
