# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Comparison of places with the points of a scan around their directions.

The nearest point of each direction is kept in grids of several steps of azimuth and elevation, so
no model of the sensor is needed: motion-compensated clouds, solid-state lidars and cameras are
alike. A grid whose step is finer than the beams says nothing.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.ndimage import minimum_filter, uniform_filter

Float32 = npt.NDArray[np.float32]

SEEN, UNKNOWN, THROUGH = -1, 0, 1

FINEST_DEG, NUM_GRIDS = 0.5, 3
"""Step of the finest grid, and number of grids, each of twice the step of the one before: lidars
of 16 beams have 2 deg between them."""

LEAST_CELLS = 5
"""Directions with a point that are needed among the nine around a place."""


def look_through(
    points: npt.NDArray[np.floating], centers: npt.NDArray[np.floating], margin_m: float
) -> npt.NDArray[np.int8]:
    """
    Return the verdict of points on places, (K,).

    Parameters
    ----------
    points : (N, 3) float, m
        About the sensor, z up, finite.
    centers : (K, 3) float, m
        In the same frame.
    margin_m : float
        Half of the depth of a place.

    Returns
    -------
    (K,) int8
        THROUGH if the points of the directions around a place, five rows of three, end behind it
        by more than the margin. They all must: at a grazing angle neighbouring rows differ by more
        than any margin, and the place is between them. SEEN if the one of its own direction ends
        within the margin. Else UNKNOWN.

    """
    range_m, *cells = direction_cells(points)
    distance_m, row, column = direction_cells(centers)
    nearest: Float32 = np.full((round(180 / FINEST_DEG), round(360 / FINEST_DEG)), np.inf)
    np.minimum.at(nearest, tuple(cells), range_m)
    through, is_hit = np.zeros((2, len(centers)), bool)
    for _ in range(NUM_GRIDS):
        modes = ('constant', 'wrap')
        lowest = minimum_filter(nearest, (5, 3), mode=modes, cval=np.inf)
        share = uniform_filter((nearest < np.inf).astype(np.float32), 3, mode=modes)
        enough = share[row, column] > (LEAST_CELLS - 0.5) / 9.0
        through |= enough & (lowest[row, column] > distance_m + margin_m)
        is_hit |= np.abs(nearest[row, column] - distance_m) <= margin_m
        rows, columns = nearest.shape
        nearest = nearest.reshape(rows // 2, 2, columns // 2, 2).min(axis=(1, 3))
        row, column = row // 2, column // 2
    return np.where(through, THROUGH, np.where(is_hit, SEEN, UNKNOWN)).astype(np.int8)


def direction_cells(
    xyz: npt.NDArray[np.floating],
) -> tuple[npt.NDArray[np.floating], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the range of points, m, and row and column of their directions in the finest grid."""
    x, y, z = xyz.T
    across = np.hypot(x, y)
    row = (90.0 - np.degrees(np.arctan2(z, across))) / FINEST_DEG
    column = (180.0 - np.degrees(np.arctan2(y, x))) / FINEST_DEG
    rows, columns = round(180 / FINEST_DEG), round(360 / FINEST_DEG)
    row = np.minimum(row.astype(np.int64), rows - 1)
    return np.hypot(across, z), row, column.astype(np.int64) % columns
