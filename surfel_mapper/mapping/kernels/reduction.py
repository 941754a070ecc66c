# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reduce the points of one scan to exact moments by voxel.

A point is quantised once (kernels/quantisation.py); everything after is sums of integers. Each
chunk of points is quantised with vector instructions, cut into runs of one voxel
(kernels/grouping.py), and summed in vector registers (lanes.py).
Intensity and colour are summed by a second pass over the same runs, which only maps with such
columns pay for.

Source: exactness by integer arithmetic is our own.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel, U
from surfel_mapper.kernels.grouping import (
    CHUNK,
    find_key,
    find_runs,
    hash_shift,
    home,
    number_runs,
)
from surfel_mapper.kernels.lanes import (
    load_sums,
    plus_place,
    store_sums,
    sum_unless,
    WORDS,
)
from surfel_mapper.kernels.layout import (
    COUNT_BITS,
    HALF,
    HIGH_BITS,
    VIEW_SCALE,
)
from surfel_mapper.kernels.prefetch import LINE_BYTES, prefetch
from surfel_mapper.kernels.quantisation import quantise, unpack

LINE = LINE_BYTES // 4
"""Coordinates of 32 bits in a cache line."""

NOT_FINITE, TOO_NEAR, TOO_FAR, BEYOND = range(4)
"""Rows of ``left_out``: the reason why a point is rejected."""


@kernel(error_model='numpy')
def reduce_points(xyz, pose, scale, range_sq, scratch, left_out):
    """
    Sum the points of a scan by voxel; return the number of voxels, or -1 if they may not fit.

    xyz       (3, N) float32 or float64, sensor frame, m
    pose      (3, 4) or (4, 4) float64, takes points of the sensor frame to the map frame
    scale     float64, 65536 / voxel size
    range_sq  (2,) float64, m^2: smallest and largest squared distance from the sensor
    scratch   table (B,) int32, row of each key by hash, B a power of two, all -1 before and after;
              keys (E + 2,) int64, out: from keys[2] on voxel keys in the order of first
              appearance, E <= B / 2;
              sums (E + 2, WORDS) int64, out: from sums[1] on those of the points in the voxel,
              as lanes.py packs them; wrong for more than FULL points;
              of one chunk: chunk_keys (CHUNK + 1,) int64, packed (CHUNK,) int64,
              starts (CHUNK + AHEAD,) int32, run_rows (CHUNK,) int32; zeros before the first use
    left_out  (4,) int64, out: number of points rejected as not finite, too near, too far, beyond
              the voxel indices

    Points left out have the key -1, whose row is the first: sums[0] is of no use but for its
    count. The last row stays zero. After -1 call with larger arrays.
    """
    table, keys, sums, chunk_keys, packed, starts, run_rows = scratch
    words = sums.ravel()
    left_out[:] = 0
    keys[1] = -1
    table[home(np.int64(-1), hash_shift(len(table)))] = 0
    sums[0] = 0
    sums[-1] = 0
    num_rows = np.int64(1)
    num_left_out = 0
    all_x, all_y, all_z = xyz[0], xyz[1], xyz[2]
    for start in range(0, len(all_x), CHUNK):
        chunk = slice(start, start + CHUNK)
        x, y, z = all_x[chunk], all_y[chunk], all_z[chunk]
        quantise(x, y, z, pose, scale, range_sq, chunk_keys, packed)
        num_runs = find_runs(chunk_keys, len(x), starts)
        if num_rows + num_runs >= len(sums):
            table[:] = -1
            return -1
        first_new = num_rows
        num_rows = number_runs(chunk_keys, starts, num_runs, table, keys, num_rows, run_rows)
        sums[first_new:num_rows] = 0
        later = slice(start + CHUNK, start + 2 * CHUNK)
        points = all_x[later], all_y[later], all_z[later]
        add_packed(packed, len(x), chunk_keys, run_rows, words, points)
        if sums[0, 0] > num_left_out:
            num_left_out = sums[0, 0]
            for run in range(num_runs):
                if run_rows[run] == 0:
                    for i in range(starts[run], starts[run + 1]):
                        left_out[reason(x[i], y[i], z[i], range_sq)] += 1
    table[:] = -1  # faster than visiting the scattered entries in use
    return num_rows - 1


@kernel()
def add_packed(packed, num, chunk_keys, run_rows, words, later):
    """
    Add the packed points of a chunk to the sums of their voxels.

    packed      (CHUNK,) int64, of which num count, at least one; see quantise
    chunk_keys  (CHUNK + 1,) int64, voxel key of each point
    run_rows    (CHUNK,) int32, row of the voxel of each run
    words       (8 M,) int64, in and out: sums of the voxels; the last eight are zero
    later       x, y, z (L,) float32 or float64 of the points of the next chunk, to be prefetched

    There are no branches, which real lidars would mispredict at every third to eighth point. Sums
    stay in registers and are stored after each point. A new run drops them, by a mask, and takes
    the sums of its voxel. A point of the same run takes the zeros at the end instead, because
    reading the row that the previous point wrote would wait for that write.
    """
    x, y, z = later
    zeros = U(len(words) - WORDS)
    run, previous = U(0), chunk_keys[0]
    sums = load_sums(words, U(WORDS) * U(np.uint32(run_rows[run])))
    for line in range(U(0), U(num), U(LINE)):
        if line < U(len(x)):
            prefetch(x, line)
            prefetch(y, line)
            prefetch(z, line)
        for i in range(line, min(line + U(LINE), U(num))):
            is_new = chunk_keys[i] != previous
            previous = chunk_keys[i]
            run += U(is_new)
            at = U(WORDS) * U(np.uint32(run_rows[run]))
            stored = load_sums(words, at if is_new else zeros)
            stored = plus_place(stored, packed[i])
            sums = sum_unless(is_new, sums, stored)
            store_sums(words, at, sums)


@inlined()
def reason(x, y, z, range_sq):
    """Return the reason why a point is rejected, a row of ``left_out``."""
    px, py, pz = np.float64(x), np.float64(y), np.float64(z)
    distance_sq = (px * px + py * py) + pz * pz
    if not (math.isfinite(px) and math.isfinite(py) and math.isfinite(pz)):
        return NOT_FINITE
    if distance_sq < range_sq[0]:
        return TOO_NEAR
    return TOO_FAR if distance_sq > range_sq[1] else BEYOND


@kernel(error_model='numpy')
def pack_moments(keys, sums, origin, voxel_size, moments):
    """
    Write the moments of a scan; return the largest count.

    keys        (K,) int64, as reduce_points leaves them
    sums        (K, WORDS) int64
    origin      (3,) float64, the sensor in the map frame, m; nan if unknown
    voxel_size  float64, m
    moments     key (K,) int64, count (K,) int32, total (K, 3) int32, product (K, 6) int64,
                view (K, 3) int16, out
    """
    key, count, total, product, view = moments
    for row in range(U(len(keys))):
        key[row] = keys[row]
    look_back(key, origin, voxel_size, view)
    return unpack_sums(sums, count, total, product)


@inlined()
def unpack_sums(sums, count, total, product):
    """
    Unpack the sums of a scan, about the centres of the voxels; return the largest count.

    sums     (K, WORDS) int64, as reduce_points leaves them
    count    (K,) int32, out
    total    (K, 3) int32, out
    product  (K, 6) int64, out
    """
    largest = np.int64(0)
    for row in range(U(len(sums))):
        num = sums[row, 0] >> COUNT_BITS
        half = HALF * num
        x = sums[row, 0] & ((1 << COUNT_BITS) - 1)
        y = sums[row, 1] & ((1 << HIGH_BITS) - 1)
        z = (sums[row, 1] >> HIGH_BITS) & ((1 << HIGH_BITS) - 1)
        largest = max(largest, num)
        count[row] = num
        total[row, 0] = x - half
        total[row, 1] = y - half
        total[row, 2] = z - half
        # (x - h)(y - h) = xy - h (x + y - h), summed
        product[row, 0] = sums[row, 2] - HALF * (x + x - half)
        product[row, 1] = sums[row, 3] - HALF * (x + y - half)
        product[row, 2] = sums[row, 4] - HALF * (x + z - half)
        product[row, 3] = sums[row, 5] - HALF * (y + y - half)
        product[row, 4] = sums[row, 6] - HALF * (y + z - half)
        product[row, 5] = sums[row, 7] - HALF * (z + z - half)
    return largest


@inlined(error_model='numpy')
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
    directions = np.empty((3, CHUNK))
    for start in range(0, len(keys), CHUNK):
        num = min(CHUNK, len(keys) - start)
        for i in range(num):
            key = keys[start + i]
            kx, ky, kz = unpack(key)
            dx = ox - (np.int32(kx) + 0.5) * voxel_size
            dy = oy - (np.int32(ky) + 0.5) * voxel_size
            dz = oz - (np.int32(kz) + 0.5) * voxel_size
            length = math.sqrt((dx * dx + dy * dy) + dz * dz)
            defined = length > 0.0  # false for nan
            directions[0, i] = np.rint(VIEW_SCALE * (dx / length)) if defined else 0.0
            directions[1, i] = np.rint(VIEW_SCALE * (dy / length)) if defined else 0.0
            directions[2, i] = np.rint(VIEW_SCALE * (dz / length)) if defined else 0.0
        for i in range(num):
            for axis in range(3):
                view[start + i, axis] = np.int16(directions[axis, i])


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
    packed = np.empty(CHUNK, np.int64)
    starts = np.empty(CHUNK + 1, np.int32)
    shift = hash_shift(len(table))
    sums[:, :] = 0
    all_x, all_y, all_z = xyz[0], xyz[1], xyz[2]
    for start in range(0, len(all_x), CHUNK):
        chunk = slice(start, start + CHUNK)
        x, y, z = all_x[chunk], all_y[chunk], all_z[chunk]
        quantise(x, y, z, pose, scale, range_sq, chunk_keys, packed)
        num_runs = find_runs(chunk_keys, len(x), starts)
        for run in range(num_runs):
            key = chunk_keys[starts[run]]
            if key < 0:
                continue
            row = find_key(key, keys, table, shift)
            for i in range(start + starts[run], start + starts[run + 1]):
                for channel in range(values.shape[1]):
                    sums[row, channel] += values[i, channel]
