# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Read the field at points: interpolated distance and gradient, state of the voxel.

Blocks are found by hash; the last block is cached, because neighbouring points mostly share it.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.hashing import DEPTH, find_row
from surfel_mapper.kernels.layout import INDEX_BITS, INDEX_OFFSET

UNKNOWN = 0
FREE = 1
OCCUPIED = 2


@njit(cache=True, nogil=True)
def block_row(a, b, c, head, table, depth):
    """Return the row of a block, -1 if the map does not contain it."""
    low, high = -INDEX_OFFSET, INDEX_OFFSET
    if a < low or b < low or c < low or a >= high or b >= high or c >= high:
        return np.int64(-1)
    x, y, z = a + INDEX_OFFSET, b + INDEX_OFFSET, c + INDEX_OFFSET
    return find_row(x << 2 * INDEX_BITS | y << INDEX_BITS | z, head, table, depth)


@njit(cache=True, nogil=True)
def find_voxel(i, j, k, bits, recent, head, table, depth):
    """
    Return row and number of a voxel; row -1 if the map does not contain its block.

    i, j, k  int64, index of the voxel in the map
    bits     a block has 2^bits voxels a side
    recent   (4,) int64, in and out: index and row of the last block
    """
    a, b, c = i >> bits, j >> bits, k >> bits
    if a != recent[0] or b != recent[1] or c != recent[2]:
        recent[0], recent[1], recent[2] = a, b, c
        recent[3] = block_row(a, b, c, head, table, depth)
    mask = (1 << bits) - 1
    return recent[3], (i & mask) | (j & mask) << bits | (k & mask) << 2 * bits


@njit(cache=True, nogil=True)
def sample(points, scale, bits, field, head, table, state, distance, gradient):
    """
    Interpolate the distance at points and its gradient.

    points    (P, 3) float64, in voxels; non-finite points are unknown
    scale     float64, voxels a metre
    field     (R, 2, N) float32
    distance  (P,) float32 m, out; nan if a voxel is missing
    gradient  (P, 3) float32, out; nan if a voxel is missing
    """
    recent = np.array([1 << 40, 0, 0, -1])
    corner = np.empty(8)
    depth = state[DEPTH]
    for p in range(len(points)):
        distance[p] = np.nan
        gradient[p, :] = np.nan
        x, y, z = points[p, 0] - 0.5, points[p, 1] - 0.5, points[p, 2] - 0.5
        if not (abs(x) < 1e12 and abs(y) < 1e12 and abs(z) < 1e12):
            continue
        i, j, k = np.floor(x), np.floor(y), np.floor(z)
        u, v, w = x - i, y - j, z - k
        complete = True
        for n in range(8):
            a, b, c = np.int64(i) + (n & 1), np.int64(j) + (n >> 1 & 1), np.int64(k) + (n >> 2)
            row, voxel = find_voxel(a, b, c, bits, recent, head, table, depth)
            if row < 0 or not field[row, 1, voxel] > 0.0:
                complete = False
                break
            corner[n] = field[row, 0, voxel]
        if not complete:
            continue
        # Along x first, then y, then z; the gradient from the same four and two values.
        c00, c10 = corner[0] + u * (corner[1] - corner[0]), corner[2] + u * (corner[3] - corner[2])
        c01, c11 = corner[4] + u * (corner[5] - corner[4]), corner[6] + u * (corner[7] - corner[6])
        c0, c1 = c00 + v * (c10 - c00), c01 + v * (c11 - c01)
        distance[p] = c0 + w * (c1 - c0)
        low = (corner[1] - corner[0]) * (1.0 - v) + (corner[3] - corner[2]) * v
        high = (corner[5] - corner[4]) * (1.0 - v) + (corner[7] - corner[6]) * v
        gradient[p, 0] = (low + w * (high - low)) * scale
        gradient[p, 1] = ((c10 - c00) * (1.0 - w) + (c11 - c01) * w) * scale
        gradient[p, 2] = (c1 - c0) * scale


@njit(cache=True, nogil=True)
def classify(points, bits, occupied, field, head, table, state, states):
    """
    Classify the voxel of each point as unknown, free or occupied.

    points    (P, 3) float64, voxels
    occupied  float32 m, largest distance of an occupied voxel
    states    (P,) uint8, out
    """
    recent = np.array([1 << 40, 0, 0, -1])
    depth = state[DEPTH]
    for p in range(len(points)):
        x, y, z = np.floor(points[p, 0]), np.floor(points[p, 1]), np.floor(points[p, 2])
        states[p] = UNKNOWN
        if not (abs(x) < 1e12 and abs(y) < 1e12 and abs(z) < 1e12):
            continue
        i, j, k = np.int64(x), np.int64(y), np.int64(z)
        row, voxel = find_voxel(i, j, k, bits, recent, head, table, depth)
        if row < 0 or not field[row, 1, voxel] > 0.0:
            continue
        states[p] = OCCUPIED if field[row, 0, voxel] <= occupied else FREE
