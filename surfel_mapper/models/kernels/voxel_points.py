# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The points of a cloud by voxel: neighbours, sensor noise, and means by voxel and owner.

Voxels are sorted by key: x in the lowest bits, y from bit ``to_y``, z from bit ``to_z``. The
neighbours of a voxel are in nine rows along x. The first neighbour in each row is found for all
voxels in one merge of the sorted keys, which needs no hash table: 3 ns a voxel and row.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.symmetric3 import eigen_frame
from surfel_mapper.models.kernels.patches import fit_quadric
from surfel_mapper.models.kernels.voxel_means import CHUNK, LENGTH_BITS

LEAST_BLOCK = 20
"""Fewer points do not determine the noise of a block."""

LEAST_WIDTH = 0.1
"""A block with a smaller ratio of the tangential variances is a line."""


@njit(cache=True, nogil=True)
def gather_voxels(points, runs, to_key, gathered, rows, starts, keys):
    """
    Copy points voxel by voxel; return how many points there are.

    points    (N, 3) float32 or float64, m
    runs      (R,) int64, sorted; to_key: bits of row and length, see voxel_means.py
    gathered  (N, 3), dtype of points, out
    rows      (N,) int32, out: row of each in points
    starts    (V + 1,) int64, out: first point of each voxel
    keys      (V,) int64, out
    """
    row_mask = (np.int64(1) << to_key) - 1
    previous, voxel, place = np.int64(-1), -1, 0
    for run in runs:
        key = run >> to_key
        if key != previous:
            voxel += 1
            starts[voxel], keys[voxel] = place, key
            previous = key
        first = (run & row_mask) >> LENGTH_BITS
        for i in range(first, first + (run & (CHUNK - 1)) + 1):
            for j in range(3):
                gathered[place, j] = points[i, j]
            rows[place] = i
            place += 1
    starts[voxel + 1] = place
    return place


@njit(cache=True, nogil=True)
def neighbour_rows(keys, to_y, to_z, first):
    """
    Find the first voxel of each of the nine rows around every voxel, from x - 1 on.

    keys        (V,) int64, ascending
    to_y, to_z  see above
    first       (V, 9) int64, out
    """
    for row in range(9):
        shift = ((row % 3 - 1) << to_y) + ((row // 3 - 1) << to_z) - 1
        j = 0
        for i in range(len(keys)):
            while j < len(keys) and keys[j] < keys[i] + shift:
                j += 1
            first[i, row] = j


@njit(cache=True, nogil=True)
def neighbours_of(i, keys, to_y, to_z, first, found):
    """Write the occupied ones of the 26 neighbours (26,) int64 of a voxel; return their number."""
    mask_x, mask_y = (np.int64(1) << to_y) - 1, (np.int64(1) << (to_z - to_y)) - 1
    x, y, num = keys[i] & mask_x, keys[i] >> to_y & mask_y, 0
    for row in range(9):
        j = first[i, row]
        last = keys[i] + ((row % 3 - 1) << to_y) + ((row // 3 - 1) << to_z) + 1
        while j < len(keys) and keys[j] <= last:
            # rows at the end of the grid continue in the next one
            near = abs((keys[j] & mask_x) - x) <= 1 and abs((keys[j] >> to_y & mask_y) - y) <= 1
            if near and j != i:
                found[num] = j
                num += 1
            j += 1
    return num


@njit(cache=True, nogil=True)
def find_core(starts, keys, to_y, to_z, first, share, least, core):
    """
    Find voxels that are not sparse compared with their densest neighbour.

    starts, keys, to_y, to_z, first  see above
    share   of the points of the densest neighbour
    least   neighbourhoods with fewer points in every voxel have core voxels only
    core    (V,) bool, out
    """
    near = np.empty(26, np.int64)
    for v in range(len(keys)):
        own = most = starts[v + 1] - starts[v]
        for k in range(neighbours_of(v, keys, to_y, to_z, first, near)):
            most = max(most, starts[near[k] + 1] - starts[near[k]])
        core[v] = most < least or own >= share * most


@njit(cache=True, nogil=True, error_model='numpy')
def block_noise(points, starts, keys, to_y, to_z, first, seeds, most, sigma):
    """
    Estimate the noise of the points in blocks of 3 x 3 x 3 voxels, about a quadric.

    points, starts, keys, to_y, to_z, first  see above
    seeds   (B,) int64, voxel in the middle of each block
    most    points used in a block, at most
    sigma   (B,) float64, out, m; -1 for too few points and for lines

    The quadric removes curvature, so that only noise remains.
    """
    near, cells, terms = np.empty(27, np.int64), np.ones((most, 4)), np.empty(6)
    mean, value = np.empty(3), np.empty(3)
    scatter, axes = np.empty((3, 3)), np.empty((3, 3))
    for b in range(len(seeds)):
        num_near = neighbours_of(seeds[b], keys, to_y, to_z, first, near)
        near[num_near] = seeds[b]
        sigma[b] = -1.0
        num = sample_block(points, starts, near[: num_near + 1], cells)
        if num < LEAST_BLOCK:
            continue
        mean[:], scatter[:] = 0.0, 0.0
        for i in range(num):
            for j in range(3):
                mean[j] += cells[i, j] / num
        for i in range(num):
            for j in range(3):
                cells[i, j] -= mean[j]
            for j in range(3):
                for k in range(3):
                    scatter[j, k] += cells[i, j] * cells[i, k]
        eigen_frame(scatter, value, axes)
        scale = math.sqrt(value[2] / num)
        if not (scale > 0.0 and value[1] > LEAST_WIDTH * value[2]):
            continue
        for i in range(num):
            x, y, z = cells[i, 0] / scale, cells[i, 1] / scale, cells[i, 2] / scale
            for j in range(3):
                cells[i, j] = axes[2 - j, 0] * x + axes[2 - j, 1] * y + axes[2 - j, 2] * z
        error = fit_quadric(cells[:num], 6, terms)
        sigma[b] = scale * math.sqrt(error / (num - 6))


@njit(cache=True, nogil=True)
def sample_block(points, starts, voxels, cells):
    """Copy evenly chosen points of voxels into cells (most, 4); return their number."""
    total = num = skip = 0
    for voxel in voxels:
        total += starts[voxel + 1] - starts[voxel]
    stride = 1 + (total - 1) // len(cells)
    for voxel in voxels:
        for i in range(starts[voxel], starts[voxel + 1]):
            if skip == 0:
                for j in range(3):
                    cells[num, j] = points[i, j]
                num += 1
            skip = (skip + 1) % stride
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def owner_means(points, starts, owner, owners, means):
    """
    Average the points of each voxel that have the same owner; return how many means there are.

    points  (P, 3), starts (V + 1,): see gather_voxels
    owner   (P,) int32
    owners  (P,) int32, out
    means   (P, 3) float64, out
    """
    num, counts = 0, np.empty(len(points))
    for v in range(len(starts) - 1):
        begin = num
        for i in range(starts[v], starts[v + 1]):
            k = begin
            while k < num and owners[k] != owner[i]:
                k += 1
            if k == num:
                owners[k], counts[k] = owner[i], 0.0
                means[k, 0] = means[k, 1] = means[k, 2] = 0.0
                num += 1
            for j in range(3):
                means[k, j] += points[i, j]
            counts[k] += 1.0
        for k in range(begin, num):
            for j in range(3):
                means[k, j] /= counts[k]
    return num
