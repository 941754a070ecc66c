# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Find the blocks in which a range image shows no surface, without a look at their voxels.

Along a ray voxels are free up to the truncation before the measured range, and unknown from the
truncation behind it on. For runs of pixels both ends are found once an image. If all runs that the
eight corners of a block span end behind it, or begin before it, no surface is in it. That takes a
fiftieth of the time of the fusion of the block, and errs on the side of fusion.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.projection import CAMERA, OUTSIDE, project

RUN = 8
"""Pixels of a run along a row; rows are not joined, since those of a lidar are far apart."""


@njit(cache=True, nogil=True, error_model='numpy')
def find_ends(image, cosine, tau, behind, runs):
    """
    Find the least end of free space and the farthest end of surfaces in every run of pixels.

    image   (rows, columns) float32 m, 0 where unknown: such pixels do not count
    cosine  same shape, or no rows; lengths along the ray are divided by it
    tau     truncation, m
    behind  distance behind a surface up to which voxels change, m
    runs    (rows, columns / RUN rounded up, 2) float32 m, out
    """
    for row in range(image.shape[0]):
        for run in range(runs.shape[1]):
            least, most = np.float32(np.inf), np.float32(0.0)
            for column in range(run * RUN, min((run + 1) * RUN, image.shape[1])):
                range_m = image[row, column]
                if range_m > 0.0:
                    longer = 1.0 / cosine[row, column] if cosine.shape[0] > 0 else 1.0
                    least = min(least, range_m - tau * longer)
                    most = max(most, range_m + behind * longer)
            runs[row, run, 0], runs[row, run, 1] = least, most


@njit(cache=True, nogil=True, error_model='numpy')
def find_free(corners, size_m, sensor, shape, runs, free):
    """
    Flag the blocks without a surface in the image; those partly out of view are not flagged.

    corners  (3, 8 K) float32 m, corners of each block in the frame of the sensor
    size_m   edge of a block, m
    sensor   (kind, parameters, elevations), see kernels/projection.py
    shape    (rows, columns, whether the last column neighbours the first)
    runs     see find_ends
    free     (K,) bool, out
    """
    kind, parameters, elevations = sensor
    num, columns = corners.shape[1], shape[1]
    x, y, z = corners[0], corners[1], corners[2]
    projected = np.empty((3, num), np.float32)
    distance, u, v = projected[0], projected[1], projected[2]
    project(x, y, z, kind, parameters, elevations, distance, u, v)
    row_rad = np.float64(parameters[3])
    for row in range(len(elevations) - 1):
        row_rad = min(row_rad, np.float64(elevations[row] - elevations[row + 1]))
    for block in range(len(free)):
        at = 8 * block
        first = last = np.float64(u[at])
        top = bottom = np.float64(v[at])
        near, far, steep, nearest, seen = np.inf, 0.0, 0.0, np.inf, True
        for n in range(at, at + 8):
            seen = seen and u[n] != OUTSIDE
            column = np.float64(u[n])
            if shape[2]:
                column -= columns * np.rint((column - u[at]) / columns)
            first, last = min(first, column), max(last, column)
            top, bottom = min(top, np.float64(v[n])), max(bottom, np.float64(v[n]))
            far, near = max(far, np.float64(distance[n])), min(near, np.float64(distance[n]))
            beside = np.hypot(x[n], y[n])
            steep, nearest = max(steep, abs(z[n]) / beside), min(nearest, beside)
        if kind != CAMERA:  # faces bulge beyond their corners, in angles
            seen = seen and nearest > 3.0 * size_m
            bulge = steep * (size_m / nearest) ** 2 / row_rad
            top, bottom = top - bulge, bottom + bulge
        near -= size_m * size_m / near  # a face is nearer than its corners
        low = np.int64(np.floor(first)), np.int64(np.floor(top))
        high = np.int64(np.floor(last)) + 1, np.int64(np.floor(bottom)) + 1
        free[block] = seen and none_between(low, high, shape, runs, near, far)


@njit(cache=True, nogil=True)
def none_between(low, high, shape, runs, near, far):
    """Return whether no surface is between two ranges, from pixel low to high (column, row)."""
    rows, columns, wraps = shape
    first, last = low[0], high[0]
    if not wraps:
        first, last = max(first, 0), min(last, columns - 1)
    column = first
    while column <= last:
        inside = column % columns if wraps else column
        run = inside // RUN
        for row in range(max(low[1], 0), min(high[1], rows - 1) + 1):
            if runs[row, run, 0] < far and runs[row, run, 1] > near:
                return False
        column += min((run + 1) * RUN, columns) - inside
    return True
