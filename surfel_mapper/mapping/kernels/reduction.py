# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reduce the points of one scan to exact moments by voxel.

A point is quantised once (kernels/quantisation.py); everything after is sums of integers. They
are formed in float64, which holds them exactly up to 2^23 points a voxel and is faster than int64
(0.79 against 1.17 ms for 131,072 points). Each chunk of points is quantised with vector
instructions, cut into runs of one voxel (kernels/grouping.py), and summed: long runs in registers,
short ones point by point.
Intensity and colour are summed by a second pass over the same runs, which only maps with such
columns pay for.

Source: exactness by integer arithmetic is our own.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import kernel, part
from surfel_mapper.kernels.grouping import (
    CHUNK,
    find_key,
    find_runs,
    hash_shift,
    home,
    LONG,
    number_runs,
    U,
)
from surfel_mapper.kernels.layout import INDEX_BITS, INDEX_MASK, INDEX_OFFSET, VIEW_SCALE
from surfel_mapper.kernels.quantisation import quantise

SUMS = 10
"""Sums of a voxel: count, places (3), products (6)."""

NOT_FINITE, TOO_NEAR, TOO_FAR, BEYOND = range(4)
"""Rows of ``left_out``: the reason why a point is rejected."""


@kernel(error_model='numpy')
def reduce_points(xyz, pose, scale, range_sq, scratch, left_out):
    """
    Sum the points of a scan by voxel; return the number of voxels, or -1 if they may not fit.

    xyz       (3, N) float32 or float64, sensor frame, m
    pose      (3, 4) float64, takes points of the sensor frame to the map frame
    scale     float64, 65536 / voxel size
    range_sq  (2,) float64, m^2: smallest and largest squared distance from the sensor
    scratch   table (B,) int32, B a power of two, all -1; out: row of each key by hash;
              keys (E + 2,) int64, out: from keys[2] on voxel keys in the order of first
              appearance, E <= B / 2;
              sums (E + 1, SUMS) float64, out: from sums[1] on count, sum (3), products (6: xx xy
              xz yy yz zz) of the places in the voxel, in lattice units about its centre;
              of one chunk: chunk_keys (CHUNK + 1,) int64, places (3, CHUNK) float64,
              starts (CHUNK + AHEAD,) int32, run_rows (CHUNK,) int32; zeros before the first use
    left_out  (4,) int64, out: number of points rejected as not finite, too near, too far, beyond
              the voxel indices

    Points left out have the key -1, whose row is the first: sums[0] is of no use but for its
    count. After -1 the table is clear again: call with larger arrays.
    """
    table, keys, sums, chunk_keys, places, starts, run_rows = scratch
    flat = sums.ravel()
    left_out[:] = 0
    keys[1] = -1
    table[home(np.int64(-1), hash_shift(len(table)))] = 0
    sums[0] = 0.0
    num_rows = np.int64(1)
    num_left_out = 0.0
    all_x, all_y, all_z = xyz[0], xyz[1], xyz[2]
    for start in range(0, len(all_x), CHUNK):
        chunk = slice(start, start + CHUNK)
        x, y, z = all_x[chunk], all_y[chunk], all_z[chunk]
        quantise(x, y, z, pose, scale, range_sq, chunk_keys, places)
        num_runs = find_runs(chunk_keys, len(x), starts)
        if num_rows + num_runs > len(sums):
            table[:] = -1
            return -1
        known = num_rows
        num_rows = number_runs(chunk_keys, starts, num_runs, table, keys, num_rows, run_rows)
        sums[known:num_rows] = 0.0
        if LONG * num_runs > len(x):
            add_points(places, len(x), chunk_keys, run_rows, flat)
        else:
            add_runs(places, starts, num_runs, run_rows, flat)
        if sums[0, 0] > num_left_out:
            num_left_out = sums[0, 0]
            for run in range(num_runs):
                if run_rows[run] == 0:
                    for i in range(starts[run], starts[run + 1]):
                        left_out[reason(x[i], y[i], z[i], range_sq)] += 1
    return num_rows - 1


@kernel(fastmath={'contract'})
def add_runs(places, starts, num_runs, run_rows, flat):
    """
    Add count, sums and products of the places of each run to the sums of its voxel.

    One call for all runs, with unsigned indices, takes half the time of a call for each run. All
    values are integers that float64 holds, so a fused multiply and add gives the same sums. Not a
    part of its kernel, whose other products have to be rounded.
    """
    all_x, all_y, all_z = places[0], places[1], places[2]
    for run in range(U(num_runs)):
        begin, end = U(np.uint32(starts[run])), U(np.uint32(starts[run + U(1)]))
        sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
        for i in range(begin, end):
            qx, qy, qz = all_x[i], all_y[i], all_z[i]
            sx += qx
            sy += qy
            sz += qz
            xx += qx * qx
            xy += qx * qy
            xz += qx * qz
            yy += qy * qy
            yz += qy * qz
            zz += qz * qz
        at = U(SUMS) * U(np.uint32(run_rows[run]))
        flat[at] += np.float64(end - begin)
        flat[at + U(1)] += sx
        flat[at + U(2)] += sy
        flat[at + U(3)] += sz
        flat[at + U(4)] += xx
        flat[at + U(5)] += xy
        flat[at + U(6)] += xz
        flat[at + U(7)] += yy
        flat[at + U(8)] += yz
        flat[at + U(9)] += zz


@kernel(fastmath={'contract'})
def add_points(places, num, chunk_keys, run_rows, flat):
    """Add the points of a chunk of short runs, of which branches would be mispredicted."""
    all_x, all_y, all_z = places[0], places[1], places[2]
    run, previous = U(0), chunk_keys[0]
    for i in range(U(num)):
        run += U(chunk_keys[i] != previous)
        previous = chunk_keys[i]
        at = U(SUMS) * U(np.uint32(run_rows[run]))
        qx, qy, qz = all_x[i], all_y[i], all_z[i]
        flat[at] += 1.0
        flat[at + U(1)] += qx
        flat[at + U(2)] += qy
        flat[at + U(3)] += qz
        flat[at + U(4)] += qx * qx
        flat[at + U(5)] += qx * qy
        flat[at + U(6)] += qx * qz
        flat[at + U(7)] += qy * qy
        flat[at + U(8)] += qy * qz
        flat[at + U(9)] += qz * qz


@part()
def reason(x, y, z, range_sq):
    """Return the reason why a point is rejected, a row of ``left_out``."""
    px, py, pz = np.float64(x), np.float64(y), np.float64(z)
    distance_sq = (px * px + py * py) + pz * pz
    if not (math.isfinite(px) and math.isfinite(py) and math.isfinite(pz)):
        return NOT_FINITE
    if distance_sq < range_sq[0]:
        return TOO_NEAR
    return TOO_FAR if distance_sq > range_sq[1] else BEYOND


@kernel()
def pack_sums(sums, count, total, product):
    """
    Convert the sums of a scan to integers; return the largest count.

    sums     (K, 10) float64, as reduce_points leaves them
    count    (K,) int32, out
    total    (K, 3) int32 or int64, out; int32 holds the sums of counts below 2^16
    product  (K, 6) int64, out
    """
    largest = 0.0
    for row in range(len(sums)):
        largest = max(largest, sums[row, 0])
        count[row] = np.int32(sums[row, 0])
        for axis in range(3):
            total[row, axis] = np.int64(sums[row, 1 + axis])
        for pair in range(6):
            product[row, pair] = np.int64(sums[row, 4 + pair])
    return largest


@kernel(error_model='numpy')
def look_back(keys, origin, voxel_size, view):
    """
    Compute the direction from each voxel to the sensor.

    keys        (K,) int64, voxel keys
    origin      (3,) float64, the sensor in the map frame, m; nan if unknown
    voxel_size  float64, m
    view        (K, 3) int16, out: rint(2^14 unit(origin - voxel centre)); 0 if undefined

    Chunks without branches, so that the compiler vectorises the loop.
    """
    ox, oy, oz = origin[0], origin[1], origin[2]
    towards = np.empty((3, CHUNK))
    for start in range(0, len(keys), CHUNK):
        num = min(CHUNK, len(keys) - start)
        for i in range(num):
            key = keys[start + i]
            ix = np.int32((key >> (2 * INDEX_BITS)) - INDEX_OFFSET)
            iy = np.int32(((key >> INDEX_BITS) & INDEX_MASK) - INDEX_OFFSET)
            iz = np.int32((key & INDEX_MASK) - INDEX_OFFSET)
            dx = ox - (ix + 0.5) * voxel_size
            dy = oy - (iy + 0.5) * voxel_size
            dz = oz - (iz + 0.5) * voxel_size
            length = math.sqrt((dx * dx + dy * dy) + dz * dz)
            known = length > 0.0  # false for nan
            towards[0, i] = np.rint(VIEW_SCALE * (dx / length)) if known else 0.0
            towards[1, i] = np.rint(VIEW_SCALE * (dy / length)) if known else 0.0
            towards[2, i] = np.rint(VIEW_SCALE * (dz / length)) if known else 0.0
        for i in range(num):
            for axis in range(3):
                view[start + i, axis] = np.int16(towards[axis, i])


@kernel(error_model='numpy')
def sum_channels(xyz, pose, scale, range_sq, keys, table, values, sums):
    """
    Sum the values of the points of each voxel.

    xyz, pose, scale, range_sq  as for reduce_points
    keys    (K,) int64, voxel keys of the scan
    table   (B,) int32, their hash table as build_table makes it
    values  (N, C) int32, a row a point
    sums    (K, C) int64, out
    """
    chunk_keys = np.empty(CHUNK, np.int64)
    places = np.empty((3, CHUNK))
    starts = np.empty(CHUNK + 1, np.int32)
    shift = hash_shift(len(table))
    sums[:, :] = 0
    all_x, all_y, all_z = xyz[0], xyz[1], xyz[2]
    for start in range(0, len(all_x), CHUNK):
        chunk = slice(start, start + CHUNK)
        x, y, z = all_x[chunk], all_y[chunk], all_z[chunk]
        quantise(x, y, z, pose, scale, range_sq, chunk_keys, places)
        num_runs = find_runs(chunk_keys, len(x), starts)
        for run in range(num_runs):
            key = chunk_keys[starts[run]]
            if key < 0:
                continue
            row = find_key(key, keys, table, shift)
            for i in range(start + starts[run], start + starts[run + 1]):
                for channel in range(values.shape[1]):
                    sums[row, channel] += values[i, channel]
