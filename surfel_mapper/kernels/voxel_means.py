# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The means of a cloud's points by voxel, in the order of the voxels, and labels back to the points.

Runs of consecutive points in one voxel are sorted by its key, by radix and stably, and summed in
that order. Nothing is looked up in a table of hashes, which with noise misses the caches for
every point: 300,000 points in 96,000 voxels take a third of the time. The points of a voxel are
summed in the order that they have, so the means are the same to the bit.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.moments import CHUNK, find_runs
from surfel_mapper.kernels.prefetch import prefetch
from surfel_mapper.kernels.voxel_grid import find_keys

DIGIT_BITS = 11
"""Most bits that are sorted by in one pass: so many counts stay in the nearest cache."""

AHEAD = 12
"""So many runs ahead their points are asked for; the rows of these twice as far ahead."""


@njit(cache=True, nogil=True, error_model='numpy')
def finite_ends(points, ends):
    """
    Find between which corners the finite points lie; return whether there are any.

    points  (N, 3) float32 or float64
    ends    (2, 3) float64, out: least and largest x, y, z
    """
    number = 0
    low_x = low_y = low_z = np.inf
    high_x = high_y = high_z = -np.inf
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if math.isfinite(x) and math.isfinite(y) and math.isfinite(z):
            number += 1
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
            low_z, high_z = min(low_z, z), max(high_z, z)
    ends[0, 0], ends[0, 1], ends[0, 2] = low_x, low_y, low_z
    ends[1, 0], ends[1, 1], ends[1, 2] = high_x, high_y, high_z
    return number > 0


@njit(cache=True, nogil=True, error_model='numpy')
def voxel_runs(points, size, shift, base, bits, keys, runs):
    """
    Find runs of finite points in one voxel; return how many.

    points                   (N, 3) float32 or float64, m
    size, shift, base, bits  see group_points
    keys                     (N,) int64, out: key of each run
    runs                     (N, 2) int32, out: first row of each, and the one after its last
    """
    own_keys, starts = np.empty(CHUNK, np.int64), np.empty(CHUNK + 1, np.int32)
    xyz = np.empty((3, CHUNK))
    number = 0
    for start in range(0, len(points), CHUNK):
        own = points[start : start + CHUNK]
        x, y, z = xyz[0, : len(own)], xyz[1, : len(own)], xyz[2, : len(own)]
        for i in range(len(own)):
            x[i], y[i], z[i] = own[i, 0], own[i, 1], own[i, 2]
        find_keys(x, y, z, size, shift, base, bits, own_keys)
        for i in range(len(own)):
            finite = abs(x[i]) < np.inf and abs(y[i]) < np.inf and abs(z[i]) < np.inf
            own_keys[i] = own_keys[i] if finite else -1
        found = find_runs(own_keys, len(own), starts)
        for run in range(found):
            keys[number] = own_keys[starts[run]]
            runs[number, 0], runs[number, 1] = start + starts[run], start + starts[run + 1]
            number += keys[number] >= 0
    return number


@njit(cache=True, nogil=True)
def sorted_runs(keys, key_bits, run_bits):
    """
    Return runs sorted by their keys, equal ones in order: (R,) int64, key << run_bits | run.

    keys      (R,) int64, not negative; is used up
    key_bits  that the largest key needs, at most 63 together with
    run_bits  that the number of the last run needs
    """
    passes = max(-(-key_bits // DIGIT_BITS), 1)
    width = -(-key_bits // passes)
    mask = np.uint64((1 << width) - 1)
    places = np.empty((1 << width) + 1, np.uint32)
    before, after = keys, np.empty_like(keys)
    for i in range(len(keys)):
        keys[i] = keys[i] << run_bits | i
    for number in range(passes):
        shift = np.uint64(run_bits + number * width)
        places[:] = 0
        for i in range(len(keys)):
            places[(np.uint64(before[i]) >> shift & mask) + np.uint64(1)] += np.uint32(1)
        for digit in range(1, len(places)):
            places[digit] += places[digit - 1]
        for i in range(len(keys)):
            digit = np.uint64(before[i]) >> shift & mask
            place = places[digit]
            places[digit] = place + np.uint32(1)
            after[place] = before[i]
        before, after = after, before
    return before


@njit(cache=True, nogil=True, error_model='numpy')
def mean_runs(points, runs, ordered, run_bits, means, voxels):
    """
    Find the mean of the points in each voxel; return how many voxels there are.

    points    (N, 3) float32 or float64, m
    runs      (R, 2) int32, of voxel_runs
    ordered   (R,) int64, of sorted_runs, as is run_bits
    means     (R, 3) float64, out
    voxels    (R,) int32, out: voxel of each run
    """
    flat, flat_runs = points.ravel(), runs.ravel()
    mask = (np.int64(1) << run_bits) - 1
    voxel, place = 0, 0
    while place < len(ordered):
        key = ordered[place] >> run_bits
        sx = sy = sz = 0.0
        count = 0
        while place < len(ordered) and ordered[place] >> run_bits == key:
            if place + 2 * AHEAD < len(ordered):
                prefetch(flat_runs, 2 * (ordered[place + 2 * AHEAD] & mask))
                prefetch(flat, 3 * np.int64(runs[ordered[place + AHEAD] & mask, 0]))
            run = ordered[place] & mask
            begin, end = np.uint32(runs[run, 0]), np.uint32(runs[run, 1])
            for i in range(begin, end):
                sx += np.float64(points[i, 0])
                sy += np.float64(points[i, 1])
                sz += np.float64(points[i, 2])
            count += end - begin
            voxels[run] = voxel
            place += 1
        means[voxel, 0], means[voxel, 1], means[voxel, 2] = sx / count, sy / count, sz / count
        voxel += 1
    return voxel


@njit(cache=True, nogil=True)
def give_labels(runs, voxels, labels, found):
    """
    Give every point the label of its voxel.

    runs    (R, 2) int32, of voxel_runs
    voxels  (R,) int32, of mean_runs
    labels  (M,) int32, of the voxels
    found   (N,) int32, out in these runs
    """
    for run in range(len(voxels)):
        label = labels[voxels[run]]
        for i in range(runs[run, 0], runs[run, 1]):
            found[i] = label
