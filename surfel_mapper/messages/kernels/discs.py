# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Vertices of surfel markers: discs as triangles, normals as lines.

A disc is a regular polygon cut into a fan of triangles. Each corner is computed once, in
registers; array operations move each through memory five times, which for 20,000 discs takes
three times as long.
"""

import math

from numba import njit
import numpy as np


@njit(cache=True, nogil=True)
def draw_discs(surfels, rows, radius, shades, circle, points, colors):
    """
    Write the triangles of discs, counter-clockwise as seen from the side of the normal.

    surfels  position (M, 3) and normal (M, 3), float64
    rows     (K,) int64, rows of the surfels to draw
    radius   (K,) float64, m
    shades   (K, 4) float32, red green blue opacity
    circle   (S, 2) float64, cosine and sine of the corners
    points   (K (S - 2) 3, 3) float64, out: three corners per triangle, disc by disc
    colors   (K (S - 2) 3, 4) float32, out

    The frame of a disc is that of Duff et al. 2017, Building an Orthonormal Basis, Revisited: no
    branch, and no normal near which it loses digits.
    """
    position, normal = surfels
    corners = np.empty((len(circle), 3))
    out = 0
    for i in range(len(rows)):
        row = rows[i]
        x, y, z = normal[row, 0], normal[row, 1], normal[row, 2]
        sign = math.copysign(1.0, z)
        a = -1.0 / (sign + z)
        b = x * y * a
        ux, uy, uz = 1.0 + sign * x * x * a, sign * b, -sign * x
        vx, vy, vz = b, sign + y * y * a, -y
        for k in range(len(circle)):
            c, s = radius[i] * circle[k, 0], radius[i] * circle[k, 1]
            corners[k, 0] = position[row, 0] + (c * ux + s * vx)
            corners[k, 1] = position[row, 1] + (c * uy + s * vy)
            corners[k, 2] = position[row, 2] + (c * uz + s * vz)
        for k in range(1, len(circle) - 1):
            for corner in (0, k, k + 1):
                for axis in range(3):
                    points[out, axis] = corners[corner, axis]
                for channel in range(4):
                    colors[out, channel] = shades[i, channel]
                out += 1


@njit(cache=True, nogil=True)
def draw_normals(surfels, rows, length, points):
    """
    Write the normals as line segments.

    surfels  position (M, 3) and normal (M, 3), float64
    rows     (K,) int64, rows of the surfels to draw
    length   float64, m
    points   (2 K, 3) float64, out: from and to
    """
    position, normal = surfels
    for i in range(len(rows)):
        for axis in range(3):
            start = position[rows[i], axis]
            points[2 * i, axis] = start
            points[2 * i + 1, axis] = start + length * normal[rows[i], axis]
