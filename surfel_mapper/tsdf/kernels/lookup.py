# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Look voxels up in a range image.

The four pixels about a voxel are gathered one by one; all else is plain loops that compile to
vector instructions: each writes one array and selects without branches. A border of zeros, which
mean unknown, replaces tests of bounds.
"""

from numba import njit
import numpy as np

# Settings of an integration, float32.
TAU = 0
MIN_RANGE = 1
MAX_RANGE = 2
LIMIT = 3
"""Largest distance of an observed voxel from the sensor, m."""
MAX_DIFFERENCE = 4
"""Pixels that differ by more are not interpolated, m."""
DROPOFF = 5
"""Distance behind the surface at which weights begin to fall, m; less than TAU."""
MIN_WEIGHT = 6
"""Least weight of a measurement, and of a voxel in the mesh; positive."""
MAX_WEIGHT = 7
CONTRADICTS = 8
"""Difference from which a measurement contradicts a voxel, m."""
NUM_SETTINGS = 9

BORDER = ((2, 2), (1, 2))
"""Rows above and below the image, and columns left and right of it, that hold 0."""

_ZERO = np.float32(0.0)
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)
_TWO = np.float32(2.0)


@njit(cache=True, nogil=True, error_model='numpy')
def locate(distance, u, v, stride, settings, pixel):
    """
    Find the pixel above and left of every voxel in the image with its border.

    u, v    (N,) float32, from -1 on, or u is OUTSIDE
    stride  columns of the image, border included
    pixel   (N,) int32, out: number of the pixel; 0, in the border, for voxels out of view
    """
    near, limit = settings[MIN_RANGE], settings[LIMIT]
    stride = np.int32(stride)
    for n in range(len(pixel)):
        number = np.int32(v[n] + _TWO) * stride + np.int32(u[n] + _ONE)
        in_view = (u[n] >= -_ONE) & (distance[n] >= near) & (distance[n] <= limit)
        pixel[n] = number if in_view else np.int32(0)


@njit(cache=True, nogil=True, error_model='numpy')
def gather(pairs, stride, pixel, upper, lower):
    """
    Fetch the four pixels about every voxel, two at a time.

    pairs         (P,) int64: each pixel and its right neighbour, two float32
    upper, lower  (N,) int64, out: pairs
    """
    for n in range(len(pixel)):
        first = np.int64(pixel[n])
        upper[n], lower[n] = pairs[first], pairs[first + stride]


@njit(cache=True, nogil=True, error_model='numpy')
def mix(above, under, u, v, settings, value):
    """
    Find the range at every voxel: interpolated, or that of the nearest pixel.

    above, under  (2 N,) float32, left and right pixel of every voxel in turn
    value         (N,) float32, out: range if interpolated; -range if of the nearest pixel; 0 if
                  unknown
    """
    reach, allowed = settings[MAX_RANGE], settings[MAX_DIFFERENCE]
    for n in range(len(value)):
        right, below = u[n] + _ONE, v[n] + _ONE
        du, dv = right - np.float32(np.int32(right)), below - np.float32(np.int32(below))
        q00, q10, q01, q11 = above[2 * n], above[2 * n + 1], under[2 * n], under[2 * n + 1]
        low = min(min(q00, q10), min(q01, q11))
        high = max(max(q00, q10), max(q01, q11))
        upper = q00 + du * (q10 - q00)
        lower = q01 + du * (q11 - q01)
        upper_near = q00 if du < _HALF else q10
        lower_near = q01 if du < _HALF else q11
        nearest = upper_near if dv < _HALF else lower_near
        # Clearing pixels are not interpolated with measurements.
        alike = (high - low <= allowed) & (low > _ZERO) & ((high <= reach) | (low > reach))
        value[n] = upper + dv * (lower - upper) if alike else -nearest
