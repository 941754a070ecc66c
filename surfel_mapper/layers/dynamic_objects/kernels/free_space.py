# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of places with a range image: seen through, seen, or unknown."""

from numba import njit
import numpy as np

from surfel_mapper.kernels.projection import project

SEEN = -1
UNKNOWN = 0
THROUGH = 1

LEAST_PIXELS = 5
"""Pixels with a known range that are needed among the nine around a place."""


@njit(cache=True, nogil=True, error_model='numpy')
def look_through(x, y, z, sensor, image, columns, margin, verdict):
    """
    Compare the distance of positions with the ranges around them.

    x, y, z  (K,) float32 m, in the frame of the sensor
    sensor   kind, parameters, elevations; see kernels/projection.py
    image    (rows, columns or one more) float32 m; 0 unknown; all around with one more
    margin   float32, m
    verdict  (K,) int8, out: THROUGH where all ranges of the nine nearest pixels that are known
             end behind the position by more than the margin; SEEN if the nearest ends within
             it; else UNKNOWN

    All nine must end behind: at a grazing angle neighbouring pixels differ by more than any
    margin, and the position is between them.
    """
    kind, parameters, elevations = sensor
    distance = np.empty(len(x), np.float32)
    u, v = np.empty(len(x), np.float32), np.empty(len(x), np.float32)
    project(x, y, z, kind, parameters, elevations, distance, u, v)
    rows = np.int64(image.shape[0])
    around = image.shape[1] > columns
    for i in range(len(x)):
        verdict[i] = UNKNOWN
        if not (u[i] >= np.float32(-0.5) and distance[i] < np.inf):
            continue
        row = np.int64(np.floor(v[i] + np.float32(0.5)))
        column = np.int64(np.floor(u[i] + np.float32(0.5)))
        num_ranges, nearest = 0, np.float32(np.inf)
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(column - 1, column + 2):
                if around:
                    c = c % columns
                elif c < 0 or c >= columns:
                    continue
                if image[r, c] > 0.0:
                    num_ranges += 1
                    nearest = min(nearest, image[r, c])
        if num_ranges >= LEAST_PIXELS and nearest > distance[i] + margin:
            verdict[i] = THROUGH
        elif 0 <= row < rows and 0 <= column < image.shape[1]:
            central = image[row, column]
            if central > 0.0 and abs(central - distance[i]) <= margin:
                verdict[i] = SEEN
