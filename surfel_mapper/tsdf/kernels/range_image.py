# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Range images from depth images and from points.

A range image holds the length of each ray in metres, float32; 0 means unknown. Returns beyond the
range of the sensor mean free space up to there: such pixels hold `clearing`, a finite value beyond
max_range, which avoids differences of infinities.
"""

from numba import njit
import numpy as np

from surfel_mapper.tsdf.kernels.projection import project

CHUNK = 1024
"""Points projected at once: the scratch arrays fit the L1 cache."""


@njit(cache=True, nogil=True, error_model='numpy')
def range_value(range_m, limits):
    """
    Return the value of a pixel for a measured range: 0, the range, or clearing.

    limits  (3,) float32 m: min_range, max_range, clearing
    """
    if not range_m >= limits[0]:
        return np.float32(0.0)
    return limits[2] if range_m > limits[1] else range_m


@njit(cache=True, nogil=True, error_model='numpy')
def from_depth(depth, scale, unknown, ray_length, limits, image):
    """
    Turn depths into ranges; return the largest range.

    depth       (rows, columns) float32, float64 or uint16; scale float32, metres of one unit
    unknown     float64, a depth that means unknown; nan if there is none
    ray_length  (rows, columns) float32, range at depth 1
    image       (rows, columns) float32 m, out

    The largest range is max_range if a pixel clears.
    """
    rows, columns = depth.shape
    largest = np.float32(0.0)
    for row in range(rows):
        for column in range(columns):
            measured = np.float32(depth[row, column]) * scale * ray_length[row, column]
            value = range_value(measured, limits)
            if depth[row, column] == unknown:
                value = np.float32(0.0)
            image[row, column] = value
            largest = value if value > largest else largest
    return min(largest, limits[1])


@njit(cache=True, nogil=True, error_model='numpy')
def from_points(points, sensor, limits, image, index):
    """
    Project points to their nearest pixels, which keep the closest; return the largest range.

    points  (N, 3) float32 or float64 m, in the frame of the sensor; non-finite points are skipped
    sensor  (6,) float32, see tsdf/kernels/projection.py
    image   (rows, columns) float32 m, in: 0; out: ranges
    index   (rows, columns) int32, out: number of the point of each filled pixel

    The largest range is max_range if a pixel clears.
    """
    rows, columns = np.int64(index.shape[0]), np.int64(index.shape[1])
    scratch = np.empty((6, CHUNK), np.float32)
    x, y, z = scratch[0], scratch[1], scratch[2]
    distance, u, v = scratch[3], scratch[4], scratch[5]
    largest = np.float32(0.0)
    for start in range(0, len(points), CHUNK):
        count = min(CHUNK, len(points) - start)
        for n in range(count):
            x[n] = points[start + n, 0]
            y[n] = points[start + n, 1]
            z[n] = points[start + n, 2]
        project(x, y, z, sensor, distance, u, v)
        for n in range(count):
            value = range_value(distance[n], limits)
            # False for nan and inf, whose column is arbitrary.
            if value == 0.0 or not (u[n] >= np.float32(0.0) and distance[n] < np.inf):
                continue
            row = np.int64(np.floor(v[n] + np.float32(0.5)))
            column = np.int64(np.floor(u[n] + np.float32(0.5)))
            if row < 0 or row >= rows or column < 0 or column >= columns:
                continue
            largest = value if value > largest else largest
            if image[row, column] == 0.0 or value < image[row, column]:
                image[row, column] = value
                index[row, column] = start + n
    return min(largest, limits[1])
