# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the moments of voxels say: mean, eigenvalues, normal, planarity, curvature.

Moments are first moved, in integers, from the voxel centre to the lattice point nearest to the
mean. Only then are they made float64, so that nothing cancels: points that are all equal give a
scatter of exactly 0 wherever in the voxel they lie. Voxels are gathered in chunks that stay in
the cache and are decomposed several at a time.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.eigen3 import decompose
from surfel_mapper.kernels.layout import (
    COUNT,
    INDEX_BITS,
    INDEX_MASK,
    INDEX_OFFSET,
    KEY,
    PRODUCT,
    ROW,
    SUM,
    VERSION,
    VIEW,
)
from surfel_mapper.kernels.prefetch import prefetch

CHUNK = 256
AHEAD = 16


@njit(cache=True, nogil=True, error_model='numpy')
def derive_surfels(rows, chosen, voxel_size, bits, outputs):
    """
    Derive the surfels of some rows of the slab.

    rows        (R, 16) int64
    chosen      (K,) int32 or int64, rows to derive; each holds at least one point
    voxel_size  float64, m
    bits        a voxel is 2^bits lattice units wide
    outputs     position (K, 3) float64 m, normal (K, 3), planarity (K,), curvature (K,),
                eigenvalues (K, 3) m^2, num_points (K,) int64, voxel_index (K, 3) int32

    One point, or all equal: eigenvalues 0; normal, planarity and curvature nan.
    """
    _, normal, planarity, curvature, eigenvalues, num_points, _ = outputs
    unit = voxel_size / (1 << bits)
    scatter = np.empty((6, CHUNK))
    values = np.empty((3, CHUNK))
    normals = np.empty((3, CHUNK))
    for start in range(0, len(chosen), CHUNK):
        num = min(CHUNK, len(chosen) - start)
        part = slice(start, start + num)
        gather(rows, chosen, start, num, scatter)
        place_means(rows, chosen[part], voxel_size, bits, outputs, start)
        decompose(scatter, num, values, normals)
        derive_shape(values, num, num_points[part], unit, planarity[part], curvature[part])
        for i in range(num):
            out = start + i
            row = np.int64(chosen[out])
            nx, ny, nz = normals[0, i], normals[1, i], normals[2, i]
            side = side_seen(nx, ny, nz, rows, row)  # a factor: half of the branches would miss
            side = math.nan if math.isnan(planarity[out]) else side
            normal[out, 0], normal[out, 1], normal[out, 2] = nx * side, ny * side, nz * side
            for j in range(3):
                eigenvalues[out, j] = values[j, i]


@njit(cache=True, nogil=True, error_model='numpy')
def gather(rows, chosen, start, num, scatter):
    """
    Collect the scatter of num voxels from start on.

    scatter  (6, CHUNK) float64, out: sum of products of deviations from the mean, lattice units
    """
    flat = rows.ravel()
    for i in range(num):
        if start + i + AHEAD < len(chosen):
            prefetch(flat, np.int64(chosen[start + i + AHEAD]) * ROW)
            prefetch(flat, np.int64(chosen[start + i + AHEAD]) * ROW + ROW // 2)
        row = np.int64(chosen[start + i])
        n = rows[row, COUNT]
        sx, sy, sz = rows[row, SUM], rows[row, SUM + 1], rows[row, SUM + 2]
        inverse = 1.0 / n
        # about the lattice point c nearest to the mean, still in integers
        cx = np.int64(np.rint(sx * inverse))
        cy = np.int64(np.rint(sy * inverse))
        cz = np.int64(np.rint(sz * inverse))
        dx, dy, dz = sx - n * cx, sy - n * cy, sz - n * cz
        fx, fy, fz = np.float64(dx), np.float64(dy), np.float64(dz)
        scatter[0, i] = (rows[row, PRODUCT] - cx * (sx + dx)) - fx * fx * inverse
        scatter[1, i] = (rows[row, PRODUCT + 1] - cx * sy - cy * dx) - fx * fy * inverse
        scatter[2, i] = (rows[row, PRODUCT + 2] - cx * sz - cz * dx) - fx * fz * inverse
        scatter[3, i] = (rows[row, PRODUCT + 3] - cy * (sy + dy)) - fy * fy * inverse
        scatter[4, i] = (rows[row, PRODUCT + 4] - cy * sz - cz * dy) - fy * fz * inverse
        scatter[5, i] = (rows[row, PRODUCT + 5] - cz * (sz + dz)) - fz * fz * inverse


@njit(cache=True, nogil=True, error_model='numpy')
def place_means(rows, chosen, voxel_size, bits, outputs, start):
    """Write position, count and voxel index of a chunk, from row start of the outputs on."""
    position, _, _, _, _, num_points, voxel_index = outputs
    cell = 1.0 / (1 << bits)
    half = (1 << (bits - 1)) + 0.5  # a lattice coordinate stands for the middle of its cell
    for i in range(len(chosen)):
        out = start + i
        row = np.int64(chosen[i])
        key = rows[row, KEY]
        n = rows[row, COUNT]
        num_points[out] = n
        inverse = 1.0 / n
        kx = (key >> (2 * INDEX_BITS)) - INDEX_OFFSET
        ky = ((key >> INDEX_BITS) & INDEX_MASK) - INDEX_OFFSET
        kz = (key & INDEX_MASK) - INDEX_OFFSET
        voxel_index[out, 0], voxel_index[out, 1], voxel_index[out, 2] = kx, ky, kz
        position[out, 0] = (kx + (rows[row, SUM] * inverse + half) * cell) * voxel_size
        position[out, 1] = (ky + (rows[row, SUM + 1] * inverse + half) * cell) * voxel_size
        position[out, 2] = (kz + (rows[row, SUM + 2] * inverse + half) * cell) * voxel_size


@njit(cache=True, nogil=True, error_model='numpy')
def derive_shape(values, num, num_points, unit, planarity, curvature):
    """
    Write planarity and curvature of a chunk, (num,) each; turn scatter into covariance.

    values  (3, CHUNK) float64: eigenvalues of the scatter, lattice units; out: of the
            covariance, m^2
    """
    for i in range(num):
        e0, e1, e2 = values[0, i], values[1, i], values[2, i]
        inverse = 1.0 / ((e0 + e1) + e2)
        planarity[i] = 2.0 * (e1 - e0) * inverse  # 0 times inf is nan, as it should be
        curvature[i] = e0 * inverse
        scale = unit * unit / max(np.float64(num_points[i] - 1), 1.0)
        values[0, i] = e0 * scale
        values[1, i] = e1 * scale
        values[2, i] = e2 * scale


@njit(cache=True, nogil=True, inline='always')
def side_seen(nx, ny, nz, rows, row):
    """
    Return 1 if a normal points to the side from which its voxel was seen, else -1.

    Where that is unknown or exactly sideways: 1 if the component of largest magnitude is
    positive; of equal ones the first counts.
    """
    towards = (nx * rows[row, VIEW] + ny * rows[row, VIEW + 1]) + nz * rows[row, VIEW + 2]
    if towards == 0.0:
        if abs(nx) >= abs(ny) and abs(nx) >= abs(nz):
            towards = nx
        elif abs(ny) >= abs(nz):
            towards = ny
        else:
            towards = nz
    return -1.0 if towards < 0.0 else 1.0


@njit(cache=True, nogil=True)
def rows_changed_at(rows, changed, version, min_points):
    """Return the rows whose last change was at a version and that hold at least so many points."""
    kept = np.empty(len(changed), np.int32)
    num = 0
    for row in changed:
        if rows[row, VERSION] == version and rows[row, COUNT] >= min_points:
            kept[num] = row
            num += 1
    return kept[:num]


@njit(cache=True, nogil=True)
def rows_changed_after(rows, used, version, min_points):
    """Return the rows changed after a version that hold at least so many points."""
    kept = np.empty(used, np.int32)
    num = 0
    for row in range(used):
        if rows[row, VERSION] > version and rows[row, COUNT] >= min_points:
            kept[num] = row
            num += 1
    return kept[:num].copy()
