# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The points of a cloud in cells of the planes of their patches, and the cells that they cover."""

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


@kernel(error_model='numpy')
def cover_cells(counts, weights, grids, pitch, coarse, rules, filled, gaps):
    """
    Find the covered cells of each dense patch; the first and last of a row or column are none.

    counts   (C,) int64 and weights (C,) float64: of count_points
    grids    first (K,) int64, corners (K, 2) float64, m, and sizes (K, 2) int64; y within x
    pitch    edge of a cell, m
    coarse   the grids of the patches: pitches (K,) float64, m, origins (K, 2) float64, m,
             first (K,) int64, sizes (K, 2) int64, and inner (D,) bool, cells that nothing cuts
    rules    least number of points of the usual cell, least share of its weight, least number
             of covered cells around one that is closed
    filled   (C,) uint8, zeros, changed in place: 1 for covered cells
    gaps     (K,) float64, out: share of the inner cells that are not covered; 2 if not dense
    """
    first, corners, sizes = grids
    pitches, origins, starts, shapes, inner = coarse
    for k in range(len(first)):
        rows, columns = sizes[k, 0], sizes[k, 1]
        total, square, weighted = 0.0, 0.0, 0.0
        for i in range(1, rows - 1):
            for j in range(1, columns - 1):
                cell = first[k] + i * columns + j
                total += counts[cell]
                square += counts[cell] * counts[cell]
                weighted += weights[cell] * counts[cell]
        gaps[k] = 2.0
        if total == 0.0 or square < rules[0] * total:
            continue
        least = rules[1] * weighted / total
        for i in range(1, rows - 1):
            for j in range(1, columns - 1):
                cell = first[k] + i * columns + j
                filled[cell] = counts[cell] > 0 and weights[cell] >= least
        number, empty = 0, 0
        for i in range(1, rows - 1):
            row = np.int64(
                np.floor((corners[k, 0] + pitch * (i + 0.5) - origins[k, 0]) / pitches[k])
            )
            for j in range(1, columns - 1):
                cell = first[k] + i * columns + j
                around = 0
                for near in range(cell - columns, cell + columns + 1, columns):
                    around += (filled[near - 1] & 1) + (filled[near] & 1) + (filled[near + 1] & 1)
                if filled[cell] == 0 and around >= rules[2]:
                    filled[cell] = 2
                y = corners[k, 1] + pitch * (j + 0.5) - origins[k, 1]
                column = np.int64(np.floor(y / pitches[k]))
                is_over = 0 <= row < shapes[k, 0] and 0 <= column < shapes[k, 1]
                if is_over and inner[starts[k] + row * shapes[k, 1] + column]:
                    number += 1
                    empty += filled[cell] == 0
        gaps[k] = empty / max(number, 1)
