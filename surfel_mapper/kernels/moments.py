# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reduce the points of one scan to exact moments by voxel.

A point is quantised once, to the lattice of unit voxel_size / 65536; everything after is sums
of integers. They are formed in float64, which holds them exactly up to 2^23 points a voxel and
is faster than int64 (0.79 against 1.17 ms for 131,072 points), in one pass: consecutive points
of one voxel are summed in registers, and only the end of such a run touches memory.

Source: exactness by integer arithmetic is our own; the hash is Fibonacci hashing (Knuth, The
Art of Computer Programming, vol. 3, 6.4) with linear probing.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.layout import (
    BITS,
    HALF,
    INDEX_BITS,
    INDEX_MASK,
    INDEX_OFFSET,
    LATTICE_LIMIT,
    VIEW_SCALE,
)

NOT_FINITE, TOO_NEAR, TOO_FAR, BEYOND = range(4)
"""Rows of ``left_out``: why points do not enter."""

_MIX = np.uint64(0x9E3779B97F4A7C15)


@njit(cache=True, nogil=True, inline='always')
def hash_shift(size):
    """Return by how much to shift a 64-bit product for a table of size rows, a power of two."""
    shift = np.uint64(64)
    while size > 1:
        size >>= 1
        shift -= np.uint64(1)
    return shift


@njit(cache=True, nogil=True, error_model='numpy')
def reduce_points(points, pose, scale, range_sq, table, keys, sums, left_out):
    """
    Sum the points of a scan by voxel; return how many voxels, or -1 if they do not fit.

    points    (N, 3) float32 or float64, sensor frame, m
    pose      (3, 4) float64, takes points of the sensor frame to the map frame
    scale     float64, 65536 / voxel size
    range_sq  (2,) float64, m^2: smallest and largest squared distance from the sensor
    table     (B,) int32, B a power of two, all -1; row of each voxel by hash; -1 again at the end
    keys      (E,) int64, out: voxel keys in the order of first appearance, E <= B / 2
    sums      (E, 10) float64, out: count, sum (3), products (6: xx xy xz yy yz zz) of the
              places in the voxel, in lattice units about its centre
    left_out  (4,) int64, out: points not finite, too near, too far, beyond the voxel indices

    If it returns -1, more than E voxels are hit: call again with larger arrays.
    """
    r00, r01, r02, t0 = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    r10, r11, r12, t1 = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    r20, r21, r22, t2 = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    near_sq, far_sq = range_sq[0], range_sq[1]
    left_out[:] = 0
    shift = hash_shift(len(table))
    mask = len(table) - 1
    num_rows = 0
    run_key = np.int64(-1)
    n = sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
    for i in range(len(points) + 1):
        key = np.int64(-2)
        qx = qy = qz = 0.0
        if i < len(points):
            x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
            distance_sq = x * x + y * y + z * z
            fx = np.floor((((r00 * x + r01 * y) + r02 * z) + t0) * scale)
            fy = np.floor((((r10 * x + r11 * y) + r12 * z) + t1) * scale)
            fz = np.floor((((r20 * x + r21 * y) + r22 * z) + t2) * scale)
            if not (  # false for nan and inf too
                near_sq <= distance_sq <= far_sq
                and abs(fx + 0.5) < LATTICE_LIMIT
                and abs(fy + 0.5) < LATTICE_LIMIT
                and abs(fz + 0.5) < LATTICE_LIMIT
            ):
                if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
                    left_out[NOT_FINITE] += 1
                elif distance_sq < near_sq:
                    left_out[TOO_NEAR] += 1
                elif distance_sq > far_sq:
                    left_out[TOO_FAR] += 1
                else:
                    left_out[BEYOND] += 1
                continue
            ix, iy, iz = np.int64(fx), np.int64(fy), np.int64(fz)
            key = (
                (((ix >> BITS) + INDEX_OFFSET) << (2 * INDEX_BITS))
                | (((iy >> BITS) + INDEX_OFFSET) << INDEX_BITS)
                | ((iz >> BITS) + INDEX_OFFSET)
            )
            low = (1 << BITS) - 1
            qx = np.float64((ix & low) - HALF)
            qy = np.float64((iy & low) - HALF)
            qz = np.float64((iz & low) - HALF)
        if key != run_key:
            if n > 0.0:
                place = np.int64((np.uint64(run_key) * _MIX) >> shift)
                row = table[place]
                while row >= 0 and keys[row] != run_key:
                    place = (place + 1) & mask
                    row = table[place]
                if row < 0:
                    if num_rows == len(keys):
                        clear_table(table, keys, num_rows)
                        return -1
                    row = num_rows
                    num_rows += 1
                    table[place] = row
                    keys[row] = run_key
                    for column in range(10):
                        sums[row, column] = 0.0
                sums[row, 0] += n
                sums[row, 1] += sx
                sums[row, 2] += sy
                sums[row, 3] += sz
                sums[row, 4] += xx
                sums[row, 5] += xy
                sums[row, 6] += xz
                sums[row, 7] += yy
                sums[row, 8] += yz
                sums[row, 9] += zz
            run_key = key
            n = sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
        n += 1.0
        sx += qx
        sy += qy
        sz += qz
        xx += qx * qx
        xy += qx * qy
        xz += qx * qz
        yy += qy * qy
        yz += qy * qz
        zz += qz * qz
    clear_table(table, keys, num_rows)
    return num_rows


@njit(cache=True, nogil=True)
def clear_table(table, keys, num_rows):
    """
    Set back to -1 what reduce_points wrote into its table, by walking the table's own entries.

    table     (B,) int32
    keys      (E,) int64
    num_rows  voxels in the table
    """
    shift = hash_shift(len(table))
    mask = len(table) - 1
    for row in range(num_rows):
        place = np.int64((np.uint64(keys[row]) * _MIX) >> shift)
        while table[place] >= 0:
            table[place] = -1
            place = (place + 1) & mask


@njit(cache=True, nogil=True, error_model='numpy')
def pack_moments(keys, sums, origin, voxel_size, count, total, product, view):
    """
    Write the sums of a scan as the integers they are, and from where each voxel was seen.

    keys        (K,) int64, voxel keys
    sums        (K, 10) float64, as reduce_points leaves them
    origin      (3,) float64, the sensor in the map frame, m; nan: unknown
    voxel_size  float64, m
    count       (K,) int32, out
    total       (K, 3) int32 or int64, out
    product     (K, 6) int64, out
    view        (K, 3) int16, out: rint(2^14 unit(origin - voxel centre)); 0 where undefined
    """
    ox, oy, oz = origin[0], origin[1], origin[2]
    for row in range(len(keys)):
        count[row] = np.int32(sums[row, 0])
        for axis in range(3):
            total[row, axis] = np.int64(sums[row, 1 + axis])
        for pair in range(6):
            product[row, pair] = np.int64(sums[row, 4 + pair])
        key = keys[row]
        dx = ox - ((key >> (2 * INDEX_BITS)) - INDEX_OFFSET + 0.5) * voxel_size
        dy = oy - (((key >> INDEX_BITS) & INDEX_MASK) - INDEX_OFFSET + 0.5) * voxel_size
        dz = oz - ((key & INDEX_MASK) - INDEX_OFFSET + 0.5) * voxel_size
        length = math.sqrt((dx * dx + dy * dy) + dz * dz)
        if length > 0.0:  # false for nan
            view[row, 0] = np.int16(np.rint(VIEW_SCALE * (dx / length)))
            view[row, 1] = np.int16(np.rint(VIEW_SCALE * (dy / length)))
            view[row, 2] = np.int16(np.rint(VIEW_SCALE * (dz / length)))
        else:
            view[row, 0] = view[row, 1] = view[row, 2] = 0
