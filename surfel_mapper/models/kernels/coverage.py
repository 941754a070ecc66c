# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The points of a cloud in cells of the planes of the patches that they belong to."""

import numpy as np

from surfel_mapper.kernels.compiling import kernel


@kernel(error_model='numpy')
def count_points(points, label, frames, view, grids, pitch, counts, weights):
    """
    Count the points in each cell, and sum the cubes of their distances from the sensor.

    points   (N, 3)
    label    (N,) int32, patch of each point; others belong to none
    frames   (K, 4, 3) float64, x, y, z and origin of each patch
    view     (3,) float64, m, position of the sensor
    grids    first (K,) int64, corners (K, 2) float64, m, and sizes (K, 2) int64; y within x
    pitch    edge of a cell, m
    counts   (C,) int64, changed in place
    weights  (C,) float64, m^3, changed in place
    """
    first, corners, sizes = grids
    for i in range(len(points)):
        k = label[i]
        if 0 <= k < len(frames):
            x, y, range_sq = -corners[k, 0], -corners[k, 1], 0.0
            for j in range(3):
                away = points[i, j] - frames[k, 3, j]
                x += away * frames[k, 0, j]
                y += away * frames[k, 1, j]
                range_sq += (points[i, j] - view[j]) ** 2
            column, row = np.int64(np.floor(x / pitch)), np.int64(np.floor(y / pitch))
            if 0 <= column < sizes[k, 0] and 0 <= row < sizes[k, 1]:
                cell = first[k] + column * sizes[k, 1] + row
                counts[cell] += 1
                weights[cell] += range_sq * np.sqrt(range_sq)
