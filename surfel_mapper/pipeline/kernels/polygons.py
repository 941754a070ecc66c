# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Points in polygons, by counting the edges that a ray crosses.

Array operations visit all points once per edge: a polygon of 10,000 corners and a map of 400,000
surfels took 40 s. The kernel visits each point once, tests the bounding box first, and keeps the
edges in the cache.

Source: Shimrat 1962, Algorithm 112, Position of point relative to polygon.
"""

from numba import njit


@njit(cache=True, nogil=True)
def mark_inside(xy, corners, inside):
    """
    Mark the points inside of a polygon, its last corner joined to the first.

    xy       (N, 2) float64
    corners  (C, 2) float64
    inside   (N,) bool, out

    If edges cross, a point is inside if a ray from it along x crosses an odd number of them. nan
    is outside.
    """
    low_x, low_y = corners[0, 0], corners[0, 1]
    high_x, high_y = low_x, low_y
    for k in range(len(corners)):
        low_x, high_x = min(low_x, corners[k, 0]), max(high_x, corners[k, 0])
        low_y, high_y = min(low_y, corners[k, 1]), max(high_y, corners[k, 1])
    for i in range(len(xy)):
        x, y = xy[i, 0], xy[i, 1]
        inside[i] = False
        if not (low_x <= x <= high_x and low_y <= y <= high_y):
            continue
        x0, y0 = corners[-1, 0], corners[-1, 1]
        odd = False
        for k in range(len(corners)):
            x1, y1 = corners[k, 0], corners[k, 1]
            if (y0 <= y) != (y1 <= y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
                odd = not odd
            x0, y0 = x1, y1
        inside[i] = odd
