# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Project points into the image of a camera.

All values are float32: points are relative to the sensor, subtracted in float64. A point outside
of the image has column OUTSIDE.
"""

from numba import njit
import numpy as np

OUTSIDE = np.float32(-2.0)

_ZERO = np.float32(0.0)
_TINY = np.float32(1e-30)
_LARGE = np.float32(1e30)


@njit(cache=True, nogil=True, error_model='numpy')
def project(x, y, z, camera, distance, u, v):
    """
    Compute range, column and row of points.

    x, y, z         (N,) float32 m, in the frame of the camera
    camera          (6,) float32: fx, fy, cx, cy, columns, rows
    distance, u, v  (N,) float32, out

    Every loop writes one array and reads few: with more, the compiler cannot prove that arrays do
    not overlap, and does not vectorise.
    """
    for n in range(len(x)):
        distance[n] = np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n])
    perspective(x, z, camera[0], camera[2], u)
    perspective(y, z, camera[1], camera[3], v)
    keep_within(v, _ZERO, camera[5], u)
    keep_within(u, _ZERO, camera[4], u)
    keep_within(z, _TINY, _LARGE, u)


@njit(cache=True, nogil=True, error_model='numpy')
def perspective(across, depth, focal, centre, pixel):
    """Project one coordinate of points to a column or row."""
    for n in range(len(across)):
        pixel[n] = focal * (across[n] / depth[n]) + centre


@njit(cache=True, nogil=True, error_model='numpy')
def keep_within(values, low, high, u):
    """Set u to OUTSIDE for points whose value is not within bounds."""
    for n in range(len(u)):
        u[n] = u[n] if (values[n] >= low) & (values[n] <= high) else OUTSIDE
