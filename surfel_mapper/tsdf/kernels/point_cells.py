# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Merge the points of a scan by voxel, and fit planes to their surroundings.

A cell is the set of points in one voxel. All rays of a cell are fused as one ray to the mean of
its points, as in the merged integrator of voxblox. Normals are those of larger cells, of
some voxels a side, with the 26 cells around: the mean of a few points in a voxel is as good as a
range reading, but their plane is not.

Tables are open addressed: (T, 2) int64 of key and number, T a power of two, EMPTY keys are free.
Points are float64 in voxels from a corner near the sensor, so that indices are small.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.layout import INDEX_BITS
from surfel_mapper.kernels.quantisation import pack, unpack
from surfel_mapper.kernels.symmetric3 import decompose_one

EMPTY = -1
"""Key of a free entry of a table."""

MOMENTS = 10
"""Columns of sums: count, sums of x y z, and of xx xy xz yy yz zz, about the centre of a cell."""

LEAST_SPREAD = 0.3
"""Least variance along the second axis of a plane, voxels^2: two rows of a lidar, not one."""

FLATTEST = 0.25
"""Largest ratio of the two smallest variances of a plane."""

LEAST_COSINE = 0.1
"""Planes at a smaller cosine of the angle of incidence are not trusted."""

NO_PLANE = 0.3
"""Weight of a cell without a plane: its distances are along the ray."""

# Columns of cells, (K, CELL) float64, positions in voxels.
X, NORMAL_X = 0, 3
WEIGHT = 6
COSINE = 7
"""Cosine of the angle of incidence, less than 1; 1 without a plane."""
RANGE = 8
"""Distance of the mean from the sensor, voxels."""
CELL = 9


@njit(cache=True, nogil=True, inline='always')
def entry_of(key, table):
    """Return the entry of a key in a table, or the free entry in which it belongs."""
    mask = len(table) - 1
    entry = np.int64(np.uint64(key) * np.uint64(0x9E3779B97F4A7C15) >> np.uint64(20)) & mask
    while table[entry, 0] != EMPTY and table[entry, 0] != key:
        entry = (entry + 1) & mask
    return entry


@njit(cache=True, nogil=True, inline='always')
def number_of(key, table, keys, number):
    """Return the number of a key in a table, and how many there are; a new key gets the next."""
    entry = entry_of(key, table)
    if table[entry, 0] == EMPTY:
        table[entry, 0], table[entry, 1] = key, number
        keys[number] = key
        number += 1
    return table[entry, 1], number


@njit(cache=True, nogil=True, inline='always')
def add_moments(row, x, y, z, moved):
    """Add moments to others, whose centre is at -x, -y, -z from theirs."""
    count = row[0]
    moved[0] += count
    moved[1] += row[1] + count * x
    moved[2] += row[2] + count * y
    moved[3] += row[3] + count * z
    moved[4] += row[4] + 2.0 * x * row[1] + count * x * x
    moved[5] += row[5] + x * row[2] + y * row[1] + count * x * y
    moved[6] += row[6] + x * row[3] + z * row[1] + count * x * z
    moved[7] += row[7] + 2.0 * y * row[2] + count * y * y
    moved[8] += row[8] + y * row[3] + z * row[2] + count * y * z
    moved[9] += row[9] + 2.0 * z * row[3] + count * z * z


@njit(cache=True, nogil=True)
def merge_points(points, pose, limits, table, keys, sums):
    """
    Sum the moments of points by voxel.

    points  (N, 3) float64, m in the frame of the sensor
    pose    (3, 4) float64, from there to voxels
    limits  smallest and largest range of points that count, m; others and nan do not
    table   (T, 2) int64, in and out: number of each cell; T more than N
    keys    (N,) int64, out: index of each cell
    sums    (N, MOMENTS) float64, out

    Returns the number of cells.
    """
    number, last_key, cell = 0, np.int64(EMPTY), np.int64(0)
    for p in range(len(points)):
        u, v, w = points[p, 0], points[p, 1], points[p, 2]
        if not limits[0] <= math.sqrt(u * u + v * v + w * w) <= limits[1]:
            continue
        x = pose[0, 0] * u + pose[0, 1] * v + pose[0, 2] * w + pose[0, 3]
        y = pose[1, 0] * u + pose[1, 1] * v + pose[1, 2] * w + pose[1, 3]
        z = pose[2, 0] * u + pose[2, 1] * v + pose[2, 2] * w + pose[2, 3]
        i, j, k = math.floor(x), math.floor(y), math.floor(z)
        key, last = pack(np.int64(i), np.int64(j), np.int64(k)), number
        if key != last_key:
            last_key = key
            cell, number = number_of(key, table, keys, last)
        row = sums[cell]
        if number > last:
            row[:] = 0.0
        x, y, z = x - i - 0.5, y - j - 0.5, z - k - 0.5
        row[0] += 1.0
        row[1] += x
        row[2] += y
        row[3] += z
        row[4] += x * x
        row[5] += x * y
        row[6] += x * z
        row[7] += y * y
        row[8] += y * z
        row[9] += z * z
    return number


@njit(cache=True, nogil=True)
def merge_cells(keys, sums, edge, table, planes, plane_keys, plane_sums):
    """
    Sum the moments of cells by the larger cell that they lie in.

    keys, sums              of K cells of a voxel
    edge                    of a larger cell, voxels
    table                   (T, 2) int64, in and out; T more than K
    planes                  (K,) int64, out: number of the larger cell of each
    plane_keys, plane_sums  (K,) and (K, MOMENTS), out

    Returns the number of larger cells.
    """
    number = 0
    for cell in range(len(keys)):
        i, j, k = unpack(keys[cell])
        a, b, c = i // edge, j // edge, k // edge
        last = number
        into, number = number_of(pack(a, b, c), table, plane_keys, last)
        planes[cell] = into
        if number > last:
            plane_sums[into] = 0.0
        centre = 0.5 * (edge - 1)
        x, y, z = i - a * edge - centre, j - b * edge - centre, k - c * edge - centre
        add_moments(sums[cell], x, y, z, plane_sums[into])
    return number


@njit(cache=True, nogil=True)
def fit_planes(keys, sums, edge, normals):
    """
    Fit a plane to each cell and its neighbours.

    keys, sums  of M cells, ascending
    edge        of a cell, voxels
    normals     (M, 3) float64, out: either sign; 0 if the points are no plane
    """
    near, first = np.empty(MOMENTS), np.zeros(9, np.int64)
    for cell in range(len(keys)):
        near[:] = 0.0
        for column in range(9):
            a, b = column % 3 - 1, column // 3 - 1
            centre = keys[cell] + (a << 2 * INDEX_BITS) + (b << INDEX_BITS)
            while first[column] < len(keys) and keys[first[column]] < centre - 1:
                first[column] += 1
            n = first[column]
            while n < len(keys) and keys[n] <= centre + 1:
                add_moments(sums[n], a * edge, b * edge, (keys[n] - centre) * edge, near)
                n += 1
        normals[cell] = 0.0
        count = near[0]
        if count < 4.0:
            continue
        x, y, z = near[1] / count, near[2] / count, near[3] / count
        values, normal = decompose_one(
            near[4] / count - x * x,
            near[5] / count - x * y,
            near[6] / count - x * z,
            near[7] / count - y * y,
            near[8] / count - y * z,
            near[9] / count - z * z,
        )
        if values[1] > LEAST_SPREAD and values[0] < FLATTEST * values[1]:
            for axis in range(3):
                normals[cell, axis] = normal[axis]


@njit(cache=True, nogil=True, error_model='numpy')
def describe_cells(origin, voxel_m, keys, sums, planes, normals, cells):
    """
    Find mean, normal and weight of each cell.

    origin      (3,) float64, the sensor
    voxel_m     edge of a voxel, m
    keys, sums  of K cells of a voxel
    planes      (K,) int64, number of the plane of each
    normals     (L, 3) float64, of the planes
    cells       (K, CELL) float64, out; normals point to the sensor
    """
    for cell in range(len(keys)):
        i, j, k = unpack(keys[cell])
        count, row = sums[cell, 0], cells[cell]
        x, y, z = sums[cell, 1] / count, sums[cell, 2] / count, sums[cell, 3] / count
        x, y, z = x + i + 0.5, y + j + 0.5, z + k + 0.5
        row[0], row[1], row[2] = x, y, z
        x, y, z = x - origin[0], y - origin[1], z - origin[2]
        measured = math.sqrt(x * x + y * y + z * z)
        x, y, z = x / measured, y / measured, z / measured
        weight, normal = 1.0, normals[planes[cell]]
        cosine = x * normal[0] + y * normal[1] + z * normal[2]
        sign = -1.0 if cosine > 0.0 else 1.0
        cosine = min(abs(cosine), 1.0 - 1e-9)
        row[3], row[4], row[5] = sign * normal[0], sign * normal[1], sign * normal[2]
        if cosine < LEAST_COSINE:
            row[3], row[4], row[5] = -x, -y, -z
            cosine, weight = 1.0, NO_PLANE
        row[WEIGHT] = weight / (measured * voxel_m) ** 2
        row[COSINE], row[RANGE] = cosine, measured
