# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Corners and colours of the triangles of a marker, from a mesh.

A mesh of 160,000 triangles is a marker of 20 MB; array operations pass over it ten times, and
took 80 ms of processor time instead of 8. Apart from discs.py, which draws surfels.
"""

import math

from numba import njit
import numpy as np


@njit(cache=True, nogil=True)
def draw_triangles(vertices, triangles, colors, light, points, rgba):
    """
    Write the corners of triangles, with the colours of the vertices or shaded by slope.

    vertices   (V, 3) float64, m
    triangles  (F, 3) int32
    colors     (V, 3) uint8, or no rows: grey from 0.3 to 1, by the angle to the light
    light      (3,) float64, direction to the light, of length 1
    points     (3 F, 3) float64, out
    rgba       (3 F, 4) float32, out
    """
    is_shaded = len(colors) == 0
    for f in range(len(triangles)):
        u, v, w = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        ax, ay, az = vertices[u, 0], vertices[u, 1], vertices[u, 2]
        bx, by, bz = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        cx, cy, cz = vertices[w, 0], vertices[w, 1], vertices[w, 2]
        first = 3 * f
        points[first, 0], points[first, 1], points[first, 2] = ax, ay, az
        points[first + 1, 0], points[first + 1, 1], points[first + 1, 2] = bx, by, bz
        points[first + 2, 0], points[first + 2, 1], points[first + 2, 2] = cx, cy, cz
        bx, by, bz, cx, cy, cz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
        x, y, z = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        length = math.sqrt(x * x + y * y + z * z)
        towards = x * light[0] + y * light[1] + z * light[2]
        grey = np.float32(0.65 + 0.35 * (towards / length if length > 0.0 else 0.0))
        for k in range(3):
            corner, row = triangles[f, k], first + k
            for axis in range(3):
                rgba[row, axis] = grey if is_shaded else colors[corner, axis] / np.float32(255.0)
            rgba[row, 3] = 1.0
