# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Project points into the image of a camera or a spinning lidar.

Angles come from a polynomial that the compiler vectorises, eight points at a time; the error is at
most 1 microradian, 1/3000 of a pixel of a lidar of 2048 columns. All values are float32: points
are relative to the sensor, subtracted in float64.

A sensor is eight float32 numbers. Camera: fx, fy, cx, cy, columns, rows. Lidar: azimuth of column
0, angle between columns, elevation of row 0, angle between rows (all rad), columns, rows, columns
of a full turn, smallest column number (0 if the last column neighbours the first, else -0.5).
A point outside of the image has column OUTSIDE.
"""

import math

from numba import njit
import numpy as np

CAMERA = 0
LIDAR = 1
LIDAR_TABLE = 2
"""A lidar with unevenly spaced rows: their elevations are in a table."""

OUTSIDE = np.float32(-2.0)

MOST_CORRECTED = 16
"""Beams between points beyond which a search is faster than corrections."""

_PI = np.float32(math.pi)
_HALF_PI = np.float32(math.pi / 2.0)
_ZERO = np.float32(0.0)
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)
_TINY = np.float32(1e-30)
_STEPS = np.float32(2.0**20)
_LARGE = np.float32(1e30)

# atan(a) / a as a polynomial of a^2 through the Chebyshev nodes of [0, 1]: error below 1.2e-8 rad.
_A0 = np.float32(0.9999999842426361)
_A1 = np.float32(-0.3333306678069206)
_A2 = np.float32(0.1999248357850854)
_A3 = np.float32(-0.14202570511736232)
_A4 = np.float32(0.1063675409820616)
_A5 = np.float32(-0.07495445443411952)
_A6 = np.float32(0.04258760746563534)
_A7 = np.float32(-0.01600503050332723)
_A8 = np.float32(0.002834064298875728)


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def arc_tangent(y, x):
    """Return the angle of (x, y), float32 rad in [-pi, pi]; 0 for (0, 0)."""
    across, up = abs(x), abs(y)
    larger = across if across > up else up
    smaller = up if across > up else across
    a = smaller / (larger + _TINY)
    b = a * a
    p = _A5 + b * (_A6 + b * (_A7 + b * _A8))
    angle = a * (_A0 + b * (_A1 + b * (_A2 + b * (_A3 + b * (_A4 + b * p)))))
    angle = _HALF_PI - angle if up > across else angle
    angle = _PI - angle if x < _ZERO else angle
    return -angle if y < _ZERO else angle


@njit(cache=True, nogil=True, error_model='numpy')
def project(x, y, z, kind, sensor, elevations, distance, u, v):
    """
    Compute range, column and row of points.

    x, y, z         (N,) float32 m, in the frame of the sensor
    elevations      (rows,) float32 rad, descending; used by LIDAR_TABLE only
    distance, u, v  (N,) float32, out

    Every loop writes one array and reads few: with more, the compiler cannot prove that arrays do
    not overlap, and does not vectorise.
    """
    for n in range(len(x)):
        distance[n] = np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n])
    if kind == CAMERA:
        perspective(x, z, sensor[0], sensor[2], u)
        perspective(y, z, sensor[1], sensor[3], v)
        keep_within(v, _ZERO, sensor[5], u)
        keep_within(u, _ZERO, sensor[4], u)
        keep_within(z, _TINY, _LARGE, u)
        return
    columns_of(x, y, sensor, u)
    elevations_of(x, y, z, v)
    if kind == LIDAR_TABLE:
        rows_of_table(elevations, v)
    else:
        top, per_row = sensor[2], _ONE / sensor[3]
        for n in range(len(v)):
            v[n] = (top - v[n]) * per_row
    keep_within(v, -_HALF, sensor[5] - _HALF, u)


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


@njit(cache=True, nogil=True, error_model='numpy')
def columns_of(x, y, sensor, u):
    """Compute the column of points; OUTSIDE beyond the last, unless columns are a full turn."""
    first, per_column, turn, lowest = sensor[0], _ONE / sensor[1], sensor[6], sensor[7]
    beyond = turn + lowest
    end = beyond if lowest == _ZERO else sensor[4] - _HALF
    for n in range(len(x)):
        column = (first - arc_tangent(y[n], x[n])) * per_column
        column = column + turn if column < lowest else column
        column = column - turn if column >= beyond else column
        u[n] = column if column < end else OUTSIDE


@njit(cache=True, nogil=True, error_model='numpy')
def elevations_of(x, y, z, elevation):
    """Compute the angle of points above the horizon."""
    for n in range(len(x)):
        elevation[n] = arc_tangent(z[n], np.sqrt(x[n] * x[n] + y[n] * y[n]))


@njit(cache=True, nogil=True, error_model='numpy')
def rows_of_table(elevations, v):
    """
    Convert elevations to rows of unevenly spaced beams, in place.

    If the points are between few beams, as those of a block far from the sensor, the rows are
    first computed as if the gap below the highest were that of all, and then corrected beam by
    beam in loops that are vectorised; that is faster than a search.
    """
    low, high = np.int32(2**31 - 1), np.int32(-(2**31))
    for n in range(len(v)):
        elevation = v[n] if abs(v[n]) < _HALF_PI else _ZERO  # nan too
        number = np.int32(elevation * _STEPS)
        low = min(low, number)
        high = max(high, number)
    first = row_above(elevations, np.float32(high + 1) / _STEPS)
    last = row_above(elevations, np.float32(low - 1) / _STEPS)
    if last - first > MOST_CORRECTED:
        search_rows(elevations, v)
        return
    top, gap = elevations[first], elevations[first] - elevations[first + 1]
    per_rad = _ONE / gap
    for n in range(len(v)):
        v[n] = (top - v[n]) * per_rad
    for row in range(first + 1, last + 1):
        below = elevations[row] - elevations[row + 1]
        change, at = gap / below - _ONE, np.float32(row - first)
        gap = below
        for n in range(len(v)):
            v[n] = v[n] + max(v[n] - at, _ZERO) * change
    start = np.float32(first)
    for n in range(len(v)):
        v[n] = v[n] + start


@njit(cache=True, nogil=True)
def row_above(elevations, elevation):
    """Return the last row but one at most whose elevation is not below the given one, else 0."""
    low, high = 0, len(elevations) - 2
    while low < high:
        middle = (low + high + 1) // 2
        if elevations[middle] >= elevation:
            low = middle
        else:
            high = middle - 1
    return low


@njit(cache=True, nogil=True, error_model='numpy')
def search_rows(elevations, v):
    """
    Convert elevations to rows by search, in place; from the row of the point before.

    Neighbours in a block differ by few rows, so it takes a third of the time of a binary search.
    """
    last, low = len(elevations) - 2, 0
    for n in range(len(v)):
        elevation = v[n]
        while low < last and elevations[low + 1] >= elevation:
            low += 1
        while low > 0 and elevations[low] < elevation:
            low -= 1
        gap = elevations[low] - elevations[low + 1]
        v[n] = np.float32(low) + (elevations[low] - elevation) / gap
