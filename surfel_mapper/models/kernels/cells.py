# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What patches cover: a grid of cells over each, and what is cut off at the rim.

The points of patch k are rows starts[k] to starts[k + 1] - 1. Cells of all patches stand in
one row, patch after patch, x by x. A rim cell loses, at the corner farthest from the mean of its
points, two strips and a triangle in which there are none; they are kept as bytes, rounded down,
so that no point is ever cut off.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.models.kernels.patches import to_local


@njit(cache=True, nogil=True, error_model='numpy')
def lay_grids(points, starts, means, frames, pitches, snapped, local, origins, sizes):
    """
    Bring all points into the frames of their patches and lay a grid over each.

    pitches  (K,) float64, m
    snapped  whether grids begin at multiples of their pitch, else at the first point
    local    (N, 3) float64, out
    origins  (K, 2) float64, out: lowest corner, m
    sizes    (K, 2) int64, out: cells along x and y
    """
    ends = np.empty((2, 2))
    for k in range(len(starts) - 1):
        low, high = starts[k], starts[k + 1]
        to_local(points, low, high, means[k], frames[k], local[low:high], ends)
        for j in range(2):
            lowest = ends[0, j]
            if snapped:
                lowest = math.floor(lowest / pitches[k]) * pitches[k]
            origins[k, j] = lowest
            sizes[k, j] = np.int64((ends[1, j] - lowest) / pitches[k]) + 1


@njit(cache=True, nogil=True, error_model='numpy')
def fill_cells(local, starts, pitches, origins, sizes, first, sums, rim, corner, cuts, margin):
    """
    Sum the points of every cell, and cut the cells at the rim.

    local    (N, 3) float64, of lay_grids, as are pitches, origins, sizes
    first    (K,) int64, first cell of each patch
    sums     (C, 4) float64, zeros; out: sum of x, y, z and number of points
    rim      (C,) bool, zeros; out: holds points and some neighbour across an edge does not
    corner   (C,) uint8, zeros; out: 1 for the high x, 2 for the high y
    cuts     (C, 3) uint8, zeros; out: strips along x and y in 1/255 of the pitch, triangle in
             2/255
    margin   m, is left between a cut and the points
    """
    least = np.full((len(sums), 3), np.inf)
    cells = np.empty(len(local), np.int32)
    for k in range(len(starts) - 1):
        nx, ny = sizes[k, 0], sizes[k, 1]
        pitch, x0, y0, begin = pitches[k], origins[k, 0], origins[k, 1], first[k]
        for i in range(starts[k], starts[k + 1]):
            x = min(np.int64((local[i, 0] - x0) / pitch), nx - 1)
            y = min(np.int64((local[i, 1] - y0) / pitch), ny - 1)
            row = begin + x * ny + y
            cells[i] = row
            for j in range(3):
                sums[row, j] += local[i, j]
            sums[row, 3] += 1.0
        for x in range(nx):
            for y in range(ny):
                row = begin + x * ny + y
                if sums[row, 3] == 0.0 or not on_rim(sums, begin, nx, ny, x, y):
                    continue
                rim[row] = True
                high_x = sums[row, 0] / sums[row, 3] < x0 + (x + 0.5) * pitch
                high_y = sums[row, 1] / sums[row, 3] < y0 + (y + 0.5) * pitch
                corner[row] = 1 * high_x + 2 * high_y
        for i in range(starts[k], starts[k + 1]):
            row = cells[i]
            if rim[row]:
                x, y = (row - begin) // ny, (row - begin) % ny
                from_x = abs(local[i, 0] - (x0 + (x + (corner[row] & 1)) * pitch))
                from_y = abs(local[i, 1] - (y0 + (y + (corner[row] >> 1)) * pitch))
                least[row, 0] = min(least[row, 0], from_x)
                least[row, 1] = min(least[row, 1], from_y)
                least[row, 2] = min(least[row, 2], from_x + from_y)
        for x in range(nx):
            for y in range(ny):
                row = begin + x * ny + y
                if rim[row] and not surrounded(sums, begin, nx, ny, x, y, corner[row]):
                    for j in range(3):
                        away = margin if j < 2 else math.sqrt(2.0) * margin
                        unit = pitch / 255.0 if j < 2 else 2.0 * pitch / 255.0
                        cuts[row, j] = np.uint8(
                            min(max(math.floor((least[row, j] - away) / unit), 0.0), 255.0)
                        )


@njit(cache=True, nogil=True, error_model='numpy')
def occupied(sums, begin, nx, ny, x, y):
    """Return whether a cell holds points; none does beyond the grid."""
    return 0 <= x < nx and 0 <= y < ny and sums[begin + x * ny + y, 3] > 0.0


@njit(cache=True, nogil=True, error_model='numpy')
def on_rim(sums, begin, nx, ny, x, y):
    """Return whether a neighbour across an edge is empty."""
    return not (
        occupied(sums, begin, nx, ny, x - 1, y)
        and occupied(sums, begin, nx, ny, x + 1, y)
        and occupied(sums, begin, nx, ny, x, y - 1)
        and occupied(sums, begin, nx, ny, x, y + 1)
    )


@njit(cache=True, nogil=True, error_model='numpy')
def surrounded(sums, begin, nx, ny, x, y, corner):
    """Return whether the three other cells at a corner all hold points."""
    dx = 1 if corner & 1 else -1
    dy = 1 if corner & 2 else -1
    return (
        occupied(sums, begin, nx, ny, x + dx, y)
        and occupied(sums, begin, nx, ny, x, y + dy)
        and occupied(sums, begin, nx, ny, x + dx, y + dy)
    )
