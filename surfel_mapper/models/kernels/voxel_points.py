# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The points of a cloud by voxel: neighbours, sensor noise, and means by voxel and owner.

Voxels are sorted by key: x in the lowest bits, y from bit ``to_y``, z from bit ``to_z``. The
neighbours of a voxel are in nine rows along x. One pass with a place in the sorted keys for each
row finds all without a hash table, in 8 ns a voxel and row.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.symmetric3 import eigen_frame
from surfel_mapper.models.kernels.patches import fit_quadric
from surfel_mapper.models.kernels.voxel_means import CHUNK, LENGTH_BITS

LEAST_BLOCK = 20
"""Fewer points do not determine the noise of a block."""

WIDER_ROUNDS = 2
"""Outliers without points around them are compared with voxels one farther away in each round."""

TRIMMING_ROUNDS = 2
"""Fits of a block without its outliers; one leaves a tenth of outliers half of their effect."""

MEDIAN_TO_SIGMA = 1.4826
"""Sigma of normally distributed values by the median of their absolute values."""

LEAST_COSINE = 0.5
"""Noise is along the ray; at grazing incidence other errors dominate."""

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
def neighbour_table(keys, to_y, to_z, starts, rows):
    """
    List the occupied ones of the 26 neighbours of every voxel.

    keys        (V,) int64, ascending
    to_y, to_z  see above
    starts  (V + 1,) int64, out: first neighbour of each voxel in rows
    rows    (26 V,) int32, out: the neighbours; see starts for how many there are
    """
    mask_y, num = (np.int64(1) << (to_z - to_y)) - 1, 0
    shifts, first = np.empty(9, np.int64), np.zeros(9, np.int64)
    for row in range(9):
        shifts[row] = ((row % 3 - 1) << to_y) + ((row // 3 - 1) << to_z)
    for i in range(len(keys)):
        starts[i] = num
        key, y = keys[i], keys[i] >> to_y & mask_y
        for row in range(9):
            middle, j = key + shifts[row], first[row]
            while j < len(keys) and keys[j] < middle - 1:
                j += 1
            first[row] = j
            # rows at the end of a grid continue in the next one, and its layers, too
            inside = 0 <= y + row % 3 - 1 <= mask_y
            while inside and j < len(keys) and keys[j] <= middle + 1:
                if keys[j] >> to_y == middle >> to_y and j != i:
                    rows[num] = j
                    num += 1
                j += 1
    starts[len(keys)] = num


@njit(cache=True, nogil=True)
def find_core(starts, adjacent, share, least, core):
    """
    Find voxels that are not sparse compared with the densest voxel near them.

    starts    (V + 1,) int64, first point of each voxel
    adjacent  starts and rows of neighbour_table
    share   of the points of the densest neighbour
    least   neighbourhoods with fewer points in every voxel are widened to three voxels, and if
            these have no more, their voxels are core voxels
    core    (V,) bool, out
    """
    first, rows = adjacent
    most = np.empty(len(core), np.int64)
    for v in range(len(core)):
        most[v] = starts[v + 1] - starts[v]
        for k in range(first[v], first[v + 1]):
            most[v] = max(most[v], starts[rows[k] + 1] - starts[rows[k]])
    for _ in range(WIDER_ROUNDS):
        before = most.copy()
        for v in range(len(core)):
            if before[v] < least:  # few points anywhere near: is it an outlier or far away?
                for k in range(first[v], first[v + 1]):
                    most[v] = max(most[v], before[rows[k]])
    for v in range(len(core)):
        core[v] = most[v] < least or starts[v + 1] - starts[v] >= share * most[v]


@njit(cache=True, nogil=True, error_model='numpy')
def block_noise(points, starts, adjacent, seeds, alone, most, view, sigma):
    """
    Estimate the noise of the points in blocks of 3 x 3 x 3 voxels or in voxels, about a quadric.

    points (P, 3), starts (V + 1,)  of gather_voxels
    adjacent  starts and rows of neighbour_table
    seeds   (B,) int64, voxel in the middle of each block
    alone   whether only the points of this voxel are used
    most    points used in a block, at most
    view    (3,) float64, m, position of the sensor
    sigma   (B,) float64, out, m, along the ray; -1 for too few points and for lines

    The quadric removes curvature, so that only noise remains.
    """
    first, rows = adjacent
    near, cells, terms = np.empty(27, np.int64), np.ones((most, 4)), np.empty(6)
    mean, value = np.empty(3), np.empty(3)
    scatter, axes = np.empty((3, 3)), np.empty((3, 3))
    for b in range(len(seeds)):
        low, high = first[seeds[b]], first[seeds[b] + 1]
        num_near = 0 if alone else high - low
        near[:num_near] = rows[low : low + num_near]
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
        cosine = incidence_cosine(mean, view, axes[0])
        sigma[b] = scale * trimmed_sigma(cells[:num], terms) / cosine


@njit(cache=True, nogil=True, error_model='numpy')
def incidence_cosine(mean, view, normal):
    """Return the cosine of the angle between the ray to a point and a normal, LEAST_COSINE up."""
    along, squares = 0.0, 0.0
    for j in range(3):
        away = mean[j] - view[j]
        along += away * normal[j]
        squares += away * away
    return max(abs(along) / math.sqrt(max(squares, 1e-24)), LEAST_COSINE)


@njit(cache=True, nogil=True, error_model='numpy')
def trimmed_sigma(cells, terms):
    """
    Return the residual of a quadric without the points beyond three sigma; their weight is 0.

    cells  (n, 4) float64: x, y, z, weight, all 1
    terms  (6,) float64, out
    """
    num, away = len(cells), np.empty(len(cells))
    cells[:, 3] = 1.0
    error, used = fit_quadric(cells, 6, terms), num
    for _ in range(TRIMMING_ROUNDS):
        for i in range(num):
            x, y = cells[i, 0], cells[i, 1]
            height = terms[0] + terms[1] * x + terms[2] * y
            height += terms[3] * x * x + terms[4] * x * y + terms[5] * y * y
            away[i] = abs(cells[i, 2] - height)
        limit = 3.0 * MEDIAN_TO_SIGMA * np.median(away)
        inside = np.int64((away <= limit).sum())
        if inside < LEAST_BLOCK or inside == used:
            break
        for i in range(num):
            cells[i, 3] = 1.0 if away[i] <= limit else 0.0
        error, used = fit_quadric(cells, 6, terms), inside
    return math.sqrt(error / (used - 6))


@njit(cache=True, nogil=True)
def sample_block(points, starts, voxels, cells):
    """Copy evenly chosen points of voxels into cells (most, 4); return their number."""
    total = num = skip = 0
    for voxel in voxels:
        total += starts[voxel + 1] - starts[voxel]
    stride = 1 + (total - 1) // len(cells)
    for voxel in voxels:
        i, end = starts[voxel] + skip, starts[voxel + 1]
        while i < end:
            for j in range(3):
                cells[num, j] = points[i, j]
            num += 1
            i += stride
        skip = i - end
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def owner_means(points, starts, owner, owners, means, counts, first):
    """
    Average the points of each voxel that have the same owner; return how many means there are.

    points  (P, 3), starts (V + 1,): see gather_voxels
    owner   (P,) int32
    owners  (P,) int32, out
    means   (P, 3) float64, out
    counts  (P,) float64, out: points of each mean
    first   (V + 1,) int64, out: first mean of each voxel
    """
    num = 0
    for v in range(len(starts) - 1):
        begin = first[v] = num
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
    first[len(starts) - 1] = num
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def merge_owners(owners, means, counts, first):
    """
    Merge the means of a voxel that have the same owner, in place; return how many are left.

    owners, means, counts, first  of owner_means, with new owners
    """
    num = 0
    for v in range(len(first) - 1):
        low, high, begin = first[v], first[v + 1], num
        first[v] = begin
        for i in range(low, high):
            k = begin
            while k < num and owners[k] != owners[i]:
                k += 1
            if k == num:
                owners[k], counts[k] = owners[i], counts[i]
                for j in range(3):
                    means[k, j] = means[i, j]
                num += 1
                continue
            share = counts[i] / (counts[i] + counts[k])
            for j in range(3):
                means[k, j] += share * (means[i, j] - means[k, j])
            counts[k] += counts[i]
    first[len(first) - 1] = num
    return num
