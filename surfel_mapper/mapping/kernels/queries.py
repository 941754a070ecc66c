# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Select surfels and rows of the slab: by place, by box, by the hash of the voxel key.

By place: surfels are found by the hash of their voxel. Around a point all voxels that a ball
touches are looked up, (2 r / voxel_size + 1)^3 of them, so the cost grows with the radius and not
with the map; for radii up to two voxels that is faster than a k-d tree, and no tree is built.

By hash: a thinned selection holds the voxels whose mixed keys are below a limit, and no others. So
the key alone tells whether a voxel may be selected, without a look-up.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.compiling import kernel, U
from surfel_mapper.kernels.grouping import find_key, hash_shift
from surfel_mapper.kernels.layout import INDEX_OFFSET, KEY
from surfel_mapper.kernels.quantisation import in_range, pack, unpack
from surfel_mapper.mapping.kernels.rows import count_of, first_word

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio, odd."""


@kernel()
def rows_at(points, scale, bits, keys, table, rows):
    """
    Find the row of the voxel that each point lies in.

    points  (N, 3) float64, m
    scale   float64, lattice units a metre
    bits    a voxel is 2^bits lattice units wide
    rows    (N,) int64, out: row, -1 if not found
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


@kernel()
def best_around(points, radius, voxel_size, positions, ranks, keys, table, rows):
    """
    Find the surfels of lowest rank around each point.

    points     (N, 3) float64, m
    radius     float64, m: largest distance from the point to the position of a surfel
    positions  (M, 3) float64, m
    ranks      (M,) float64, lower is better, nan excludes a surfel; length 0: rank by distance
    rows       (N, k) int64, out: best first, padded with -1; ties by row
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
                        insert_ranked(rank, row, best, rows, i)


@kernel()
def insert_ranked(rank, row, best, rows, i):
    """Insert a row into the sorted best rows of point i; a rank of nan is ignored."""
    index = len(best)
    while index > 0 and (
        rank < best[index - 1] or (rank == best[index - 1] and row < rows[i, index - 1])
    ):
        index -= 1
    if index == len(best) or not rank < math.inf:
        return
    for later in range(len(best) - 1, index, -1):
        best[later] = best[later - 1]
        rows[i, later] = rows[i, later - 1]
    best[index] = rank
    rows[i, index] = row


@kernel()
def reach(coordinate, radius, voxel_size):
    """Return the first and last valid voxel index that a ball may touch along an axis."""
    slack = radius + 1e-9 * voxel_size  # a mean may be rounded onto the face of its voxel
    first = np.floor((coordinate - slack) / voxel_size)
    last = np.floor((coordinate + slack) / voxel_size)
    return (
        np.int64(min(max(first, -float(INDEX_OFFSET)), float(INDEX_OFFSET))),
        np.int64(max(min(last, INDEX_OFFSET - 1.0), -INDEX_OFFSET - 1.0)),
    )


@kernel()
def keys_in_box(rows, used, low, high):
    """Return the keys of occupied voxels with indices from low to high, (3,) int64 each."""
    kept = np.empty(used, np.int64)
    flat = rows.ravel()
    num = 0
    for row in range(used):
        key = flat[first_word(row) + U(KEY)]
        kx, ky, kz = unpack(key)
        inside = low[0] <= kx <= high[0] and low[1] <= ky <= high[1] and low[2] <= kz <= high[2]
        if inside and count_of(flat, first_word(row)) > 0:
            kept[num] = key
            num += 1
    return kept[:num].copy()


@njit(cache=True, nogil=True, inline='always')
def mix(key):
    """Return the mixed key of a voxel, uint64; neighbouring voxels differ in all bits."""
    mixed = np.uint64(key) * _GOLDEN
    mixed ^= mixed >> np.uint64(29)
    mixed *= _GOLDEN
    mixed ^= mixed >> np.uint64(29)
    return mixed * _GOLDEN


@kernel()
def mix_keys(keys, mixed):
    """Mix voxel keys, (K,) int64, into (K,) uint64."""
    for i in range(len(keys)):
        mixed[i] = mix(keys[i])


@kernel()
def rows_held(rows, used, min_points, chosen, mixed):
    """
    List the rows of at least min_points points with their mixed keys; return their number.

    rows    (R, 12) int64, the slab
    used    number of rows ever used
    chosen  (R,) int32, out
    mixed   (R,) uint64, out
    """
    flat = rows.ravel()
    num = 0
    for row in range(used):
        at = first_word(row)
        if count_of(flat, at) >= min_points:
            chosen[num] = row
            mixed[num] = mix(flat[at + U(KEY)])
            num += 1
    return num


@kernel()
def mark_seen(observed, limit, keys, table, marks, mark, kept):
    """
    Mark the unmarked surfels whose voxels a scan observed.

    observed  (S,) int64, voxel keys of the scan
    limit     uint64, largest mixed key of the surfels
    keys      (K,) int64, of the surfels
    table     (B,) int32, hash table of the keys, as build_table makes it
    marks     (K,) int64, in and out: -1 for an unmarked surfel
    mark      int64
    kept      (S,) int64, out: the keys observed, without the surfels marked before

    Returns the number of surfels marked and of keys kept.
    """
    shift = hash_shift(len(table))
    num = num_kept = 0
    for key in observed:
        if mix(key) <= limit:
            row = find_key(key, keys, table, shift)
            if row >= 0:
                if marks[row] >= 0:
                    continue
                marks[row] = mark
                num += 1
        kept[num_kept] = key
        num_kept += 1
    return num, num_kept


@kernel()
def keys_within(keys, limit, within):
    """
    List the keys whose mixed keys are at most a limit; return their number.

    keys    (S,) int64
    limit   uint64
    within  (S,) int64, out
    """
    num = 0
    for key in keys:
        within[num] = key
        num += mix(key) <= limit
    return num
