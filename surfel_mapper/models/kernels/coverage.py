# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The points of a cloud in cells of the planes of their patches, and the cells that they cover."""

import math

import numpy as np

from surfel_mapper.kernels.compiling import kernel


@kernel(error_model='numpy')
def count_points(points, label, frames, view, grids, pitch, counts, weights, numbers):
    """
    Count the points in each cell, and sum the cubes of their distances from the sensor.

    points   (N, 3) float64, each of which stands for numbers (N,) int64 of points
    label    (N,) int32, patch of each point; others belong to none
    frames   (K, 4, 3) float64, x, y, z and origin of each patch
    view     (3,) float64, m, position of the sensor
    grids    first (K,) int64, corners (K, 2) float64, m, and sizes (K, 2) int64; y within x
    pitch    edge of a cell, m
    counts   (C,) int64, changed in place
    weights  (C,) float64, m^3, changed in place
    """
    first, corners, sizes = grids
    per_m = 1.0 / pitch
    for i in range(len(points)):
        k = label[i]
        if 0 <= k < len(frames):
            x, y, range_sq = -corners[k, 0], -corners[k, 1], 0.0
            for j in range(3):
                away = points[i, j] - frames[k, 3, j]
                x += away * frames[k, 0, j]
                y += away * frames[k, 1, j]
                range_sq += (points[i, j] - view[j]) ** 2
            column, row = np.int64(np.floor(x * per_m)), np.int64(np.floor(y * per_m))
            if 0 <= column < sizes[k, 0] and 0 <= row < sizes[k, 1]:
                cell = first[k] + column * sizes[k, 1] + row
                counts[cell] += numbers[i]
                weights[cell] += numbers[i] * range_sq * np.sqrt(range_sq)


@kernel(error_model='numpy')
def cover_cells(counts, weights, grids, pitch, coarse, rules, filled, gaps):
    """
    Find the covered cells of each dense patch; the first and last of a row or column are none.

    counts   (C,) int64 and weights (C,) float64: of count_points
    grids    first (K,) int64, corners (K, 2) float64, m, and sizes (K, 2) int64; y within x
    pitch    edge of a cell, m
    coarse   the grids of the patches: pitches (K,) float64, m, origins (K, 2) float64, m,
             first (K,) int64, sizes (K, 2) int64, and filled (D,) bool
    rules    least number of points of the usual cell, least share of its weight, least number
             of covered cells around one that is closed
    filled   (C,) uint8, zeros, changed in place: 1 for covered cells
    gaps     (K,) float64, out: share of the cells over filled ones with four filled neighbours
             that are not covered; 2 if not dense
    """
    first, corners, sizes = grids
    pitches, origins, starts, shapes, held = coarse
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
                width, over = shapes[k, 1], starts[k] + row * shapes[k, 1] + column
                if 0 < row < shapes[k, 0] - 1 and 0 < column < width - 1:
                    inner = held[over] & held[over - 1] & held[over + 1]
                    inner &= held[over - width] & held[over + width]
                    number += inner
                    empty += inner & (filled[cell] == 0)
        gaps[k] = empty / max(number, 1)


@kernel(error_model='numpy')
def place_points(points, starts, origins, axes, local):
    """Write points (N, 3) in the frames of their patches; patch k has rows from starts[k] on."""
    for k in range(len(origins)):
        for i in range(starts[k], starts[k + 1]):
            x, y = points[i, 0] - origins[k, 0], points[i, 1] - origins[k, 1]
            z = points[i, 2] - origins[k, 2]
            for j in range(3):
                local[i, j] = x * axes[k, j, 0] + y * axes[k, j, 1] + z * axes[k, j, 2]


@kernel(error_model='numpy')
def box_patches(local, patch, low, high):
    """Find the least and greatest x and y, (K, 2) each, of points (N, 3) of patches (N,)."""
    low[:], high[:] = math.inf, -math.inf
    for i in range(len(local)):
        k = patch[i]
        for j in range(2):
            low[k, j], high[k, j] = min(low[k, j], local[i, j]), max(high[k, j], local[i, j])


@kernel(error_model='numpy')
def sum_cells(local, patch, grids, rows, sums):
    """
    Sum the points of each cell.

    local  (N, 3) float64, m, in the frames of patches (N,) int64
    grids  pitches (K,), origins (K, 2), sizes (K, 2) and first (K,) of Cells
    rows   (N,) int64, out: cell of each point
    sums   (C, 4) float64, zeros, changed in place: sums of x, y and z, and number of points
    """
    pitches, origins, sizes, first = grids
    for i in range(len(local)):
        k = patch[i]
        x = min(np.int64((local[i, 0] - origins[k, 0]) / pitches[k]), sizes[k, 0] - 1)
        y = min(np.int64((local[i, 1] - origins[k, 1]) / pitches[k]), sizes[k, 1] - 1)
        row = rows[i] = first[k] + x * sizes[k, 1] + y
        for j in range(3):
            sums[row, j] += local[i, j]
        sums[row, 3] += 1.0


@kernel(error_model='numpy')
def mark_rims(grids, sums, rim, corner, surrounded):
    """
    Find the boundary cells, and the corner of each that is farthest from the mean of its points.

    grids, sums  of sum_cells
    rim, corner  (C,) of Cells, zeros, changed in place
    surrounded   (C,) bool, out for boundary cells: whether the cells at that corner hold points
    """
    pitches, origins, sizes, first = grids
    for k in range(len(first)):
        rows, columns = sizes[k, 0], sizes[k, 1]
        for x in range(rows):
            for y in range(columns):
                cell = first[k] + x * columns + y
                if sums[cell, 3] == 0.0:
                    continue
                if 0 < x < rows - 1 and 0 < y < columns - 1:
                    along_x = sums[cell - columns, 3] * sums[cell + columns, 3]
                    if along_x * sums[cell - 1, 3] * sums[cell + 1, 3] > 0.0:
                        continue
                rim[cell] = True
                mean_x = sums[cell, 0] / sums[cell, 3] - origins[k, 0]
                mean_y = sums[cell, 1] / sums[cell, 3] - origins[k, 1]
                high_x, high_y = mean_x < (x + 0.5) * pitches[k], mean_y < (y + 0.5) * pitches[k]
                corner[cell] = high_x + 2 * high_y
                dx, dy = 2 * high_x - 1, 2 * high_y - 1
                surrounded[cell] = 0 <= x + dx < rows and 0 <= y + dy < columns
                if surrounded[cell]:
                    around = sums[cell + dx * columns, 3] * sums[cell + dy, 3]
                    surrounded[cell] = around * sums[cell + dx * columns + dy, 3] > 0.0


@kernel(error_model='numpy')
def cut_rims(local, patch, rows, grids, rim, corner, least):
    """
    Find how near the points of boundary cells are to their corner.

    local, patch, rows, grids  of sum_cells
    rim, corner                of mark_rims
    least                      (C, 3) float64, m, inf, changed in place: along x, along y, and sum
    """
    pitches, origins, sizes, first = grids
    for i in range(len(local)):
        row, k = rows[i], patch[i]
        if rim[row]:
            x, y = (row - first[k]) // sizes[k, 1], (row - first[k]) % sizes[k, 1]
            from_x = local[i, 0] - origins[k, 0] - (x + (corner[row] & 1)) * pitches[k]
            from_y = local[i, 1] - origins[k, 1] - (y + (corner[row] >> 1)) * pitches[k]
            least[row, 0] = min(least[row, 0], abs(from_x))
            least[row, 1] = min(least[row, 1], abs(from_y))
            least[row, 2] = min(least[row, 2], abs(from_x) + abs(from_y))
