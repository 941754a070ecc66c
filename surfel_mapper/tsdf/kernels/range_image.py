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

from surfel_mapper.kernels.projection import project

LEAST_COSINE = np.float32(0.35)
"""Smallest cosine: angles of incidence beyond 70 deg count as 70 deg."""

GENTLE = 0.4
"""Slopes up to this need one neighbour only."""

STRAIGHT = 0.1
"""Steeper slopes need a second neighbour within this share of the rise from the line."""

MOST_PIXELS = 16.0
"""Largest step between the pixels of a slope."""

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
    Turn depths into ranges; return (largest, used).

    depth       (rows, columns) float32, float64 or uint16; scale float32, metres of one unit
    unknown     float64, a depth that means unknown; nan if there is none
    ray_length  (rows, columns) float32, range at depth 1
    image       (rows, columns or more) float32 m, out

    largest is the largest range, max_range if a pixel clears; used counts the pixels that are not
    unknown.
    """
    rows, columns = depth.shape
    largest, used = np.float32(0.0), 0
    for row in range(rows):
        for column in range(columns):
            measured = np.float32(depth[row, column]) * scale * ray_length[row, column]
            value = range_value(measured, limits)
            if depth[row, column] == unknown:
                value = np.float32(0.0)
            image[row, column] = value
            used += value > np.float32(0.0)
            largest = value if value > largest else largest
    return min(largest, limits[1]), used


@njit(cache=True, nogil=True, error_model='numpy')
def from_points(points, sensor, limits, image, index):
    """
    Project points to their nearest pixels, which keep the closest; return (largest, used).

    points  (N, 3) float32 or float64 m, in the frame of the sensor; non-finite points are skipped
    sensor  (kind, parameters, elevations), see kernels/projection.py
    image   (rows, columns or one more) float32 m, in: 0; out: ranges, with the first column
            repeated at the end if there is one more
    index   (rows, columns) int32, out: number of the point of each filled pixel

    largest is the largest range, max_range if a pixel clears; used counts the points in view.
    """
    rows, columns = np.int64(index.shape[0]), np.int64(index.shape[1])
    kind, parameters, elevations = sensor
    all_around = image.shape[1] > columns
    scratch = np.empty((6, CHUNK), np.float32)
    x, y, z = scratch[0], scratch[1], scratch[2]
    distance, u, v = scratch[3], scratch[4], scratch[5]
    largest, used = np.float32(0.0), 0
    for start in range(0, len(points), CHUNK):
        count = min(CHUNK, len(points) - start)
        for n in range(count):
            x[n] = points[start + n, 0]
            y[n] = points[start + n, 1]
            z[n] = points[start + n, 2]
        project(x, y, z, kind, parameters, elevations, distance, u, v)
        for n in range(count):
            value = range_value(distance[n], limits)
            # False for nan and inf, whose column is arbitrary.
            if value == 0.0 or not (u[n] >= np.float32(-0.5) and distance[n] < np.inf):
                continue
            row = np.int64(np.floor(v[n] + np.float32(0.5)))
            column = np.int64(np.floor(u[n] + np.float32(0.5)))
            if column == columns and all_around:
                column = 0
            if row < 0 or row >= rows or column < 0 or column >= columns:
                continue
            used += 1
            largest = value if value > largest else largest
            if image[row, column] == 0.0 or value < image[row, column]:
                image[row, column] = value
                index[row, column] = start + n
    if all_around:
        for row in range(rows):
            image[row, columns] = image[row, 0]
    return min(largest, limits[1]), used


@njit(cache=True, nogil=True, error_model='numpy')
def cosines(image, directions, pitch, reach_m, max_range, cosine):
    """
    Estimate the cosine of the angle of incidence of each ray.

    image       (rows, columns or one more) float32 m; one more for a full circle
    directions  (rows, columns, 3) float32
    pitch       (row, column) float64 rad, between neighbours
    reach_m     float64, distance between the points of a slope
    max_range   float32 m, of the sensor
    cosine      (rows, columns or one more) float32, out: in [LEAST_COSINE, 1]; 1 if unknown
    """
    rows, columns = np.int64(directions.shape[0]), np.int64(directions.shape[1])
    around = image.shape[1] > columns
    farthest_row, farthest_column = reach_m / pitch[0], reach_m / pitch[1]
    for row in range(rows):
        for column in range(columns):
            cosine[row, column] = np.float32(1.0)
            range_m = np.float64(image[row, column])
            if range_m <= 0.0 or range_m > max_range:
                continue
            inverse = 1.0 / range_m
            across, down = steps(farthest_column * inverse), steps(farthest_row * inverse)
            left_column, right_column = column - across, column + across
            if around:
                left_column = left_column + columns if left_column < 0 else left_column
                right_column = right_column - columns if right_column >= columns else right_column
            gap_m = across * pitch[1] * range_m
            first = valid_range(image, row, left_column, columns, max_range)
            second = valid_range(image, row, right_column, columns, max_range)
            beside = slope(first, range_m, second, gap_m)
            gap_m = down * pitch[0] * range_m
            first = valid_range(image, row - down, column, columns, max_range)
            second = valid_range(image, row + down, column, columns, max_range)
            above = slope(first, range_m, second, gap_m)
            if beside == 0 or above == 0:
                continue
            column1, row1 = left_column if beside < 0 else right_column, row + above * down
            ux, uy, uz = unit(directions, row, column)
            ax, ay, az = unit(directions, row, column1)
            bx, by, bz = unit(directions, row1, column)
            # To the two neighbours, in units of the range.
            ra, rb = image[row, column1] * inverse, image[row1, column] * inverse
            ax, ay, az = ra * ax - ux, ra * ay - uy, ra * az - uz
            bx, by, bz = rb * bx - ux, rb * by - uy, rb * bz - uz
            x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            length_sq = x * x + y * y + z * z
            if length_sq > 0.0:
                along = abs(x * ux + y * uy + z * uz) / np.sqrt(length_sq)
                cosine[row, column] = max(np.float32(along), LEAST_COSINE)
        if around:
            cosine[row, columns] = cosine[row, 0]


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def steps(pixels):
    """Return a step in pixels, rounded and within bounds."""
    return np.int64(min(max(pixels + 0.5, 1.0), MOST_PIXELS))


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def unit(directions, row, column):
    """Return the unit vector of a pixel."""
    return (
        np.float64(directions[row, column, 0]),
        np.float64(directions[row, column, 1]),
        np.float64(directions[row, column, 2]),
    )


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def valid_range(image, row, column, columns, max_range):
    """Return the range of a pixel, 0 if unknown or outside of the image."""
    if row < 0 or column < 0 or row >= image.shape[0] or column >= columns:
        return 0.0
    range_m = np.float64(image[row, column])
    return range_m if range_m <= max_range else 0.0


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def slope(first, middle, second, gap_m):
    """
    Return which of two neighbours lies on a plane with the pixel, -1 or 1; 0 for neither.

    first, middle, second  float64 m, ranges; 0 for unknown
    gap_m                  float64, distance between them across the ray

    The neighbour of more similar range is taken, so that the edge of an object is not mistaken for
    a slope; a steep slope must continue on the other side. Along a plane the inverse of the range
    is linear.
    """
    first_gap = abs(first - middle) if first > 0.0 else np.inf
    second_gap = abs(second - middle) if second > 0.0 else np.inf
    side = -1 if first_gap <= second_gap else 1
    if min(first_gap, second_gap) <= GENTLE * gap_m:
        return side
    if first <= 0.0 or second <= 0.0:
        return 0
    bend = abs(1.0 / first + 1.0 / second - 2.0 / middle)
    return side if bend <= STRAIGHT * abs(1.0 / first - 1.0 / second) else 0


@njit(cache=True, nogil=True, error_model='numpy')
def find_thin(image, level, step_m, widest_m, max_range, thin):
    """
    Flag the pixels of objects that are narrower than a width: runs along a row with more behind.

    image      (rows, columns or one more) float32 m; one more for a full circle
    level      (rows,) float64 rad, angle between neighbouring columns of each row
    step_m     pixels of a run differ by at most this from one to the next
    widest_m   width of an object that is flagged, at most
    max_range  float32 m, of the sensor
    thin       (rows, columns) bool, in: False; out

    Both neighbours of the run must be farther or unknown. Runs at the ends of a row count only if
    it is a full circle.
    """
    rows, columns = np.int64(thin.shape[0]), np.int64(thin.shape[1])
    around = image.shape[1] > columns
    for row in range(rows):
        first = 0
        if around:
            while first < columns and joined(image, row, first, columns, step_m, max_range):
                first += 1
        start, end = first, first + columns if around else columns
        for column in range(start + 1, end + 1):
            if column < end and joined(image, row, column, columns, step_m, max_range):
                continue
            begin, last = first % columns, (column - 1) % columns
            width = (column - first) * level[row] * image[row, begin]
            if 0.0 < width <= widest_m and image[row, begin] <= max_range:
                left_m, right_m = image[row, (begin - 1) % columns], image[row, column % columns]
                is_inside = around or (first > 0 and column < columns)
                behind = (left_m <= 0.0 or left_m > image[row, begin]) and (
                    right_m <= 0.0 or right_m > image[row, last]
                )
                if is_inside and behind:
                    for inside in range(first, column):
                        thin[row, inside % columns] = True
            first = column


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def joined(image, row, column, columns, step_m, max_range):
    """Return whether a pixel and the one before it in its row are of one run."""
    previous, current = image[row, (column - 1) % columns], image[row, column % columns]
    valid = previous > 0.0 and current > 0.0 and max(previous, current) <= max_range
    return valid and abs(current - previous) <= step_m
