# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Points in polygons, by counting the edges that a ray crosses.

Centres of voxels lie in rows of equal y. The places where the edges cross a row are computed and
sorted once, and each point of the row is searched among them. A test of each point with each edge
took 5 s for 10,000 corners and 318,000 voxels.

Source: Shimrat 1962, Algorithm 112, Position of point relative to polygon.
"""

from numba import njit
import numpy as np


@njit(cache=True, nogil=True)
def cross_rows(corners, rows, first, last, starts, crossings):
    """
    Compute where the edges of a polygon cross the rows, sorted in each row.

    corners    (C, 2) float64, the last is joined to the first
    rows       (R,) float64, y of each row, ascending
    first      (C,) int64, first row that the edge ending at a corner crosses
    last       (C,) int64, one past its last row
    starts     (R + 1,) int64, where the crossings of each row start
    crossings  (starts[R],) float64, out
    """
    ends = starts[:-1].copy()
    x0, y0 = corners[-1, 0], corners[-1, 1]
    for k in range(len(corners)):
        x1, y1 = corners[k, 0], corners[k, 1]
        for row in range(first[k], last[k]):
            crossings[ends[row]] = x0 + (rows[row] - y0) / (y1 - y0) * (x1 - x0)
            ends[row] += 1
        x0, y0 = x1, y1
    for row in range(len(rows)):
        crossings[starts[row] : starts[row + 1]].sort()


@njit(cache=True, nogil=True)
def mark_inside(x, row, starts, crossings, inside):
    """
    Mark the points with an odd number of crossings beyond them.

    x          (N,) float64
    row        (N,) int64
    starts     (R + 1,) int64, where the crossings of each row start
    crossings  (starts[R],) float64, sorted in each row
    inside     (N,) bool, out
    """
    for i in range(len(x)):
        edges = crossings[starts[row[i]] : starts[row[i] + 1]]
        inside[i] = (len(edges) - np.searchsorted(edges, x[i], 'right')) & 1
