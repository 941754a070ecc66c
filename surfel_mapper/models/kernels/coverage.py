# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Which places a grid of cells covers, as cells.py fills and cuts them.

The tables of a grid, of Nx by Ny cells:

    cells   filled and rim (Nx, Ny) bool, corner (Nx, Ny) uint8, cuts (Nx, Ny, 3) uint8
    pitch   m, edge of a cell
    origin  (2,) float64, lowest corner of cell (0, 0)
"""

from numba import njit
import numpy as np


@njit(cache=True, nogil=True)
def cover_places(places, cells, pitch, origin, inside):
    """
    Find the places that are covered.

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
def cover_parts(per_side, cells, pitch, origin, covered):
    """
    Find the parts of cells whose middles are covered.

    per_side  so many along either side of a cell
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
    """Return the cell, of so many in a row, at an offset from the first; -1 for none."""
    cell = np.int64(np.floor(offset / pitch))
    if offset <= number * pitch:
        cell = min(cell, number - 1)  # the last point of a grid may stand on its end
    return cell if 0 <= cell < number else -1


@njit(cache=True, nogil=True)
def is_cut_off(dx, dy, x, y, cells, pitch):
    """Return whether what is at an offset from the origin is cut off its cell."""
    _, _, corner, cuts = cells
    from_x = abs(dx - (x + (corner[x, y] & 1)) * pitch)
    from_y = abs(dy - (y + (corner[x, y] >> 1)) * pitch)
    strip, triangle = pitch / 255.0, 2.0 * pitch / 255.0
    return (
        from_x < cuts[x, y, 0] * strip
        or from_y < cuts[x, y, 1] * strip
        or from_x + from_y < cuts[x, y, 2] * triangle
    )
