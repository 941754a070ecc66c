# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Find surfels by place: the one at a point, the best few around it.

Surfels are found by the hash of their voxel. Around a point all voxels that a ball touches are
looked up, (2 r / voxel_size + 1)^3 of them, so the cost grows with the radius and not with the
map; for radii up to two voxels that beats a k-d tree, and no tree has to be built.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.layout import COUNT, INDEX_BITS, INDEX_MASK, INDEX_OFFSET, KEY
from surfel_mapper.kernels.moments import hash_shift, home


@njit(cache=True, nogil=True)
def build_table(keys, table):
    """
    Enter voxel keys, each there once, into a hash table.

    keys   (M,) int64
    table  (B,) int32, out: row of each key, -1 elsewhere; B a power of two, at least 2 M
    """
    table[:] = -1
    shift = hash_shift(len(table))
    mask = len(table) - 1
    for row in range(len(keys)):
        place = home(keys[row], shift)
        while table[place] >= 0:
            place = (place + 1) & mask
        table[place] = row


@njit(cache=True, nogil=True)
def find_key(key, keys, table, shift):
    """Return the row of a voxel key, -1 where there is none."""
    mask = len(table) - 1
    place = home(key, shift)
    row = np.int64(table[place])
    while row >= 0 and keys[row] != key:
        place = (place + 1) & mask
        row = np.int64(table[place])
    return row


@njit(cache=True, nogil=True)
def rows_at(points, scale, bits, keys, table, rows):
    """
    Find the voxel that each point lies in.

    points  (N, 3) float64, m
    scale   float64, lattice units a metre
    bits    a voxel is 2^bits lattice units wide
    rows    (N,) int64, out: row, -1 where there is none
    """
    shift = hash_shift(len(table))
    voxel = float(1 << bits)
    for i in range(len(points)):
        kx = np.floor(np.floor(points[i, 0] * scale) / voxel)
        ky = np.floor(np.floor(points[i, 1] * scale) / voxel)
        kz = np.floor(np.floor(points[i, 2] * scale) / voxel)
        if in_range(kx) and in_range(ky) and in_range(kz):
            key = pack(np.int64(kx), np.int64(ky), np.int64(kz))
            rows[i] = find_key(key, keys, table, shift)
        else:
            rows[i] = -1


@njit(cache=True, nogil=True)
def best_around(points, radius, voxel_size, positions, ranks, keys, table, rows):
    """
    Find the surfels around each point that rank first.

    points     (N, 3) float64, m
    radius     float64, m: only surfels whose position is at most so far count
    positions  (M, 3) float64, m
    ranks      (M,) float64, smaller is better, nan is left out; of length 0: rank by distance
    rows       (N, k) int64, out: best first, -1 where there are fewer; ties by row
    """
    shift = hash_shift(len(table))
    by_distance = len(ranks) == 0
    best = np.empty(rows.shape[1])
    for i in range(len(points)):
        rows[i, :] = -1
        best[:] = math.inf
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            continue
        first_x, last_x = reach(x, radius, voxel_size)
        first_y, last_y = reach(y, radius, voxel_size)
        first_z, last_z = reach(z, radius, voxel_size)
        for kx in range(first_x, last_x + 1):
            for ky in range(first_y, last_y + 1):
                for kz in range(first_z, last_z + 1):
                    row = find_key(pack(kx, ky, kz), keys, table, shift)
                    if row < 0:
                        continue
                    dx, dy = positions[row, 0] - x, positions[row, 1] - y
                    dz = positions[row, 2] - z
                    distance_sq = (dx * dx + dy * dy) + dz * dz
                    if distance_sq <= radius * radius:
                        rank = distance_sq if by_distance else ranks[row]
                        enter(rank, row, best, rows, i)


@njit(cache=True, nogil=True)
def enter(rank, row, best, rows, i):
    """Put a row where its rank belongs among the best of point i; nan belongs nowhere."""
    place = len(best)
    while place > 0 and (
        rank < best[place - 1] or (rank == best[place - 1] and row < rows[i, place - 1])
    ):
        place -= 1
    if place == len(best) or not rank < math.inf:
        return
    for later in range(len(best) - 1, place, -1):
        best[later] = best[later - 1]
        rows[i, later] = rows[i, later - 1]
    best[place] = rank
    rows[i, place] = row


@njit(cache=True, nogil=True, inline='always')
def in_range(index):
    """Return whether a voxel index is one that a key can hold; false for nan."""
    return abs(index + 0.5) < INDEX_OFFSET


@njit(cache=True, nogil=True, inline='always')
def pack(kx, ky, kz):
    """Return the key of a voxel index."""
    return (
        ((kx + INDEX_OFFSET) << (2 * INDEX_BITS))
        | ((ky + INDEX_OFFSET) << INDEX_BITS)
        | (kz + INDEX_OFFSET)
    )


@njit(cache=True, nogil=True)
def reach(coordinate, radius, voxel_size):
    """Return the first and last voxel index that a ball may touch along an axis, within range."""
    slack = radius + 1e-9 * voxel_size  # a mean may be rounded onto the face of its voxel
    first = np.floor((coordinate - slack) / voxel_size)
    last = np.floor((coordinate + slack) / voxel_size)
    return (
        np.int64(min(max(first, -float(INDEX_OFFSET)), float(INDEX_OFFSET))),
        np.int64(max(min(last, INDEX_OFFSET - 1.0), -INDEX_OFFSET - 1.0)),
    )


@njit(cache=True, nogil=True)
def keys_in_box(rows, used, low, high):
    """Return the keys of the voxels whose indices are from low to high, (3,) int64 each."""
    kept = np.empty(used, np.int64)
    num = 0
    for row in range(used):
        key = rows[row, KEY]
        kx = (key >> (2 * INDEX_BITS)) - INDEX_OFFSET
        ky = ((key >> INDEX_BITS) & INDEX_MASK) - INDEX_OFFSET
        kz = (key & INDEX_MASK) - INDEX_OFFSET
        inside = low[0] <= kx <= high[0] and low[1] <= ky <= high[1] and low[2] <= kz <= high[2]
        if inside and rows[row, COUNT] > 0:
            kept[num] = key
            num += 1
    return kept[:num].copy()
