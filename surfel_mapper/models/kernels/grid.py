# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The area that each patch covers: a grid of cells in its plane, and the cuts of boundary cells.

The points of patch k are rows starts[k] to starts[k + 1] - 1. The cells of all patches are stored
in one array, patch after patch, y within x. A boundary cell loses two strips and a triangle that
hold no points, at the corner farthest from the mean of its points. Cuts are stored as bytes and
rounded down, so no point is ever cut off.

Tables of one grid of Nx by Ny cells, as the queries take them:

    cells   filled and rim (Nx, Ny) bool, corner (Nx, Ny) uint8, cuts (Nx, Ny, 3) uint8
    pitch   m, edge of a cell
    origin  (2,) float64, lowest corner of cell (0, 0)
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.models.kernels.patches import to_local


@njit(cache=True, nogil=True, error_model='numpy')
def place_grids(points, starts, means, frames, pitches, snapped, local, origins, sizes):
    """
    Transform all points into the frames of their patches and place a grid over each.

    points   (N, 3) float64, m
    starts   (K + 1,) int64
    means    (K, 3), frames (K, 3, 3) float64
    pitches  (K,) float64, m
    snapped  whether grids start at multiples of their pitch, else at the first point
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
    Sum the points of every cell, and cut the boundary cells.

    local    (N, 3) float64, of place_grids, as are pitches, origins, sizes
    first    (K,) int64, first cell of each patch
    sums     (C, 4) float64, zeros; out: sums of x, y, z, and number of points
    rim      (C,) bool, zeros; out: holds points and has an empty 4-neighbour
    corner   (C,) uint8, zeros; out: 1 for the high x, 2 for the high y
    cuts     (C, 3) uint8, zeros; out: strips along x and y in 1/255 of the pitch, triangle in
             2/255
    margin   m, left between a cut and the points
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
                if sums[row, 3] == 0.0 or not is_boundary(sums, begin, nx, ny, x, y):
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
    """Return whether a cell holds points; cells beyond the grid do not."""
    return 0 <= x < nx and 0 <= y < ny and sums[begin + x * ny + y, 3] > 0.0


@njit(cache=True, nogil=True, error_model='numpy')
def is_boundary(sums, begin, nx, ny, x, y):
    """Return whether a 4-neighbour is empty."""
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


@njit(cache=True, nogil=True)
def find_covered(places, cells, pitch, origin, inside):
    """
    Find the locations that are covered.

    places  (M, 2) float64, m
    inside  (M,) bool, out
    """
    filled = cells[0]
    for i in range(len(places)):
        dx, dy = places[i, 0] - origin[0], places[i, 1] - origin[1]
        x, y = cell_at(dx, pitch, filled.shape[0]), cell_at(dy, pitch, filled.shape[1])
        within = x >= 0 and y >= 0 and filled[x, y]
        inside[i] = within and not is_cut_off(dx, dy, x, y, cells, pitch)


@njit(cache=True, nogil=True)
def find_covered_squares(per_side, cells, pitch, origin, covered):
    """
    Find the squares of divided cells whose centres are covered.

    per_side  squares along either side of a cell
    covered   (Nx per_side, Ny per_side) bool, out
    """
    filled, rim, _, _ = cells
    step = pitch / per_side
    for px in range(covered.shape[0]):
        for py in range(covered.shape[1]):
            x, y = px // per_side, py // per_side
            covered[px, py] = filled[x, y]
            if rim[x, y]:  # only these are cut
                dx = origin[0] + (px + 0.5) * step - origin[0]
                dy = origin[1] + (py + 0.5) * step - origin[1]
                covered[px, py] = not is_cut_off(dx, dy, x, y, cells, pitch)


@njit(cache=True, nogil=True)
def cell_at(offset, pitch, number):
    """Return the index of the cell at an offset from the first one, -1 beyond the grid."""
    cell = np.int64(np.floor(offset / pitch))
    if offset <= number * pitch:
        cell = min(cell, number - 1)  # the last point of a grid may stand on its end
    return cell if 0 <= cell < number else -1


@njit(cache=True, nogil=True)
def is_cut_off(dx, dy, x, y, cells, pitch):
    """Return whether an offset from the origin is cut off its cell."""
    _, _, corner, cuts = cells
    from_x = abs(dx - (x + (corner[x, y] & 1)) * pitch)
    from_y = abs(dy - (y + (corner[x, y] >> 1)) * pitch)
    strip, triangle = pitch / 255.0, 2.0 * pitch / 255.0
    return (
        from_x < cuts[x, y, 0] * strip
        or from_y < cuts[x, y, 1] * strip
        or from_x + from_y < cuts[x, y, 2] * triangle
    )
