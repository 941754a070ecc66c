# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Derive surfels from the moments of voxels: mean, eigenvalues, normal and shape.

Moments are first moved, in exact arithmetic, from the voxel centre to the lattice point nearest to
the mean. The scatter is taken there, so nothing cancels: identical points give a scatter of
exactly 0 anywhere in the voxel. Voxels are gathered in chunks that stay in the cache and are
decomposed with vector instructions.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel, U
from surfel_mapper.kernels.layout import KEY, PRODUCT, SCANS, STAMP_ROW
from surfel_mapper.kernels.prefetch import LINE_BYTES, prefetch, prefetch_to_write
from surfel_mapper.kernels.quantisation import unpack
from surfel_mapper.kernels.symmetric3 import decompose_one
from surfel_mapper.mapping.kernels.rows import (
    count_of,
    first_word,
    prefetch_row,
    prefetch_row_early,
    sum_of,
    view_of,
)

CHUNK = 128
"""Voxels processed at once: their moments stay in the first-level cache."""

AHEAD = 16
"""Number of rows between the prefetch of a row and its use."""

EARLY = CHUNK
"""Number of rows between the early prefetch of a row and its use."""

LINE = LINE_BYTES // 8
"""Numbers of 64 bits in a cache line."""

EXACT_BITS = 54
"""A second moment of n points of b bits is below n 4^(b - 1), so float64 holds it exactly for
n < 2^(54 - 2 b), with a margin of two."""

# Rows of the chunk of moments: count, sums, products and views as in a row of the slab.
N = 0
S = 1
P = 4
V = 10
MOMENTS = 13


@kernel(error_model='numpy')
def derive_surfels(rows, stamps, chosen, voxel_size, bits, outputs):
    """
    Derive the surfels of some rows of the slab.

    rows        (R, 12) int64
    stamps      (R, 2) uint32, see kernels/layout.py
    chosen      (K,) int32 or int64, rows to derive; each holds at least one point
    voxel_size  float64, m
    bits        a voxel is 2^bits lattice units wide
    outputs     position (K, 3) float64 m, normal (K, 3), planarity (K,), curvature (K,),
                eigenvalues (K, 3) m^2, num_points (K,) int64, voxel_index (K, 3) int32,
                num_scans (K,) int64, covariance (K, 6) m^2, or (0, 6) to leave it out

    A single point or identical points: eigenvalues 0; normal, planarity and curvature nan.
    """
    keys, moments = np.empty(CHUNK, np.int64), np.empty((MOMENTS, CHUNK))
    mean, scatter = np.empty((3, CHUNK)), np.empty((6, CHUNK))
    values, normals, shape = np.empty((3, CHUNK)), np.empty((3, CHUNK)), np.empty((2, CHUNK))
    many = 1 << max(EXACT_BITS - 2 * bits, 0)
    unit = voxel_size / (1 << bits)
    vectors = outputs[0].ravel(), outputs[1].ravel(), outputs[4].ravel()
    written = *vectors, outputs[2], outputs[3], outputs[5], outputs[6].ravel(), outputs[7]
    changes, covariance = stamps.ravel(), outputs[8]
    for start in range(0, len(chosen), CHUNK):
        num = min(CHUNK, len(chosen) - start)
        most = gather(rows, changes, chosen, start, num, keys, moments, written)
        center(moments, num, mean, scatter)
        if most >= many:
            center_exactly(rows, chosen, start, num, scatter)
        for i in range(num):
            xx, xy, xz = scatter[0, i], scatter[1, i], scatter[2, i]
            yy, yz, zz = scatter[3, i], scatter[4, i], scatter[5, i]
            (e0, e1, e2), (nx, ny, nz) = decompose_one(xx, xy, xz, yy, yz, zz)
            values[0, i], values[1, i], values[2, i] = e0, e1, e2
            normals[0, i], normals[1, i], normals[2, i] = nx, ny, nz
        for i in range(num):
            e0, e1, e2 = values[0, i], values[1, i], values[2, i]
            inverse = 1.0 / ((e0 + e1) + e2)
            shape[0, i], shape[1, i] = 2.0 * (e1 - e0) * inverse, e0 * inverse
            scale = unit * unit / max(moments[N, i] - 1.0, 1.0)
            values[0, i], values[1, i], values[2, i] = e0 * scale, e1 * scale, e2 * scale
        for i in range(num):
            nx, ny, nz = normals[0, i], normals[1, i], normals[2, i]
            side = side_of(nx, ny, nz, moments[V, i], moments[V + 1, i], moments[V + 2, i])
            side = math.nan if math.isnan(shape[0, i]) else side
            normals[0, i], normals[1, i], normals[2, i] = nx * side, ny * side, nz * side
        write_surfels(
            start, num, keys, moments, mean, normals, values, shape, voxel_size, bits, outputs
        )
        write_scans(start, num, chosen, moments, changes, outputs[7])
        if len(covariance):
            write_covariances(start, num, moments, scatter, unit, covariance)


@inlined()
def prefetch_outputs(written, row):
    """
    Prefetch the memory of LINE surfels from a row on, to be written.

    written  position, normal and eigenvalues, each (3 K,) float64; planarity and curvature (K,)
             float64; num_points (K,) int64; voxel_index (3 K,) int32; num_scans (K,) int64
    """
    position, normal, eigenvalues, planarity, curvature, num_points, voxel_index = written[:7]
    for line in range(3):
        at = min(3 * row + LINE * line, len(position) - 1)
        prefetch_to_write(position, at)
        prefetch_to_write(normal, at)
        prefetch_to_write(eigenvalues, at)
    prefetch_to_write(planarity, row)
    prefetch_to_write(curvature, row)
    prefetch_to_write(num_points, row)
    prefetch_to_write(voxel_index, 3 * row)
    prefetch_to_write(voxel_index, min(3 * row + 2 * LINE, len(voxel_index) - 1))
    prefetch_to_write(written[7], row)


@inlined()
def side_of(nx, ny, nz, vx, vy, vz):
    """
    Return 1 if a normal points towards the sensor, else -1.

    If the direction v of the sensor is unknown or orthogonal to the normal, its component of
    largest magnitude decides, the first of equal ones.
    """
    facing = (nx * vx + ny * vy) + nz * vz
    y_or_z = ny if abs(ny) >= abs(nz) else nz
    largest = nx if (abs(nx) >= abs(ny)) & (abs(nx) >= abs(nz)) else y_or_z
    return -1.0 if (largest if facing == 0.0 else facing) < 0.0 else 1.0


@inlined(error_model='numpy')
def write_surfels(
    start, num, keys, moments, mean, normals, values, shape, voxel_size, bits, outputs
):
    """
    Write the surfels of a chunk to the outputs of derive_surfels.

    mean             (3, CHUNK) float64, lattice units about the centre of the voxel
    normals, values  (3, CHUNK) float64, as in the outputs
    shape            (2, CHUNK) float64, planarity and curvature
    """
    position, normal, planarity, curvature, eigenvalues, num_points, voxel_index = outputs[:7]
    cell = 1.0 / (1 << bits)
    half = (1 << (bits - 1)) + 0.5  # a lattice coordinate stands for the middle of its cell
    first = U(start)
    for i in range(U(num)):
        x, y, z = unpack(keys[i])
        row = first + i
        num_points[row] = np.int64(moments[N, i])
        voxel_index[row, 0], voxel_index[row, 1], voxel_index[row, 2] = x, y, z
        planarity[row], curvature[row] = shape[0, i], shape[1, i]
        normal[row, 0], normal[row, 1], normal[row, 2] = (
            normals[0, i],
            normals[1, i],
            normals[2, i],
        )
        eigenvalues[row, 0], eigenvalues[row, 1] = values[0, i], values[1, i]
        eigenvalues[row, 2] = values[2, i]
        position[row, 0] = (x + (mean[0, i] + half) * cell) * voxel_size
        position[row, 1] = (y + (mean[1, i] + half) * cell) * voxel_size
        position[row, 2] = (z + (mean[2, i] + half) * cell) * voxel_size


@inlined()
def write_scans(start, num, chosen, moments, changes, num_scans):
    """Write the numbers of scans of a chunk, 1 to the number of points; see VoxelTable."""
    for i in range(U(num)):
        row = U(start) + i
        scans = np.int64(np.int32(changes[U(chosen[row]) * U(STAMP_ROW) + U(SCANS)]))
        num_scans[row] = min(max(scans, 1), np.int64(moments[N, i]))


@inlined(error_model='numpy')
def write_covariances(start, num, moments, scatter, unit, covariance):
    """Write the covariances of a chunk, (K, 6) m^2; unit: of the lattice, m."""
    for i in range(num):
        scale = unit * unit / max(moments[N, i] - 1.0, 1.0)
        for pair in range(6):
            covariance[start + i, pair] = scatter[pair, i] * scale


@inlined()
def gather(rows, changes, chosen, start, num, keys, moments, written):
    """
    Gather the moments of num voxels from start on; return the largest count.

    changes  (R * 2,) uint32, the stamps, which are prefetched
    keys     (CHUNK,) int64, out
    moments  (MOMENTS, CHUNK) float64, out
    written  arrays that are written next, see prefetch_outputs
    """
    flat, last = rows.ravel(), len(chosen) - 1
    most = np.int64(0)
    for i in range(num):
        if i % LINE == 0:
            prefetch_outputs(written, start + i)
        prefetch_row_early(flat, np.int64(chosen[min(start + i + EARLY, last)]))
        prefetch_row(flat, np.int64(chosen[min(start + i + AHEAD, last)]))
        prefetch(changes, np.int64(chosen[min(start + i + AHEAD, last)]) * STAMP_ROW)
        at = first_word(chosen[start + i])
        n = count_of(flat, at)
        most = max(most, n)
        keys[i], moments[N, i] = flat[at + U(KEY)], n
        moments[V, i], moments[V + 1, i], moments[V + 2, i] = view_of(flat, at)
        for axis in range(3):
            moments[S + axis, i] = sum_of(flat, at, axis)
        for pair in range(6):
            moments[P + pair, i] = flat[at + U(PRODUCT) + U(pair)]
    return most


@inlined(error_model='numpy')
def center(moments, num, mean, scatter):
    """
    Compute mean and scatter of the voxels of a chunk, in lattice units.

    moments  (MOMENTS, CHUNK) float64, of a number of points that EXACT_BITS allows
    mean     (3, CHUNK) float64, out: about the centre of the voxel
    scatter  (6, CHUNK) float64, out: sum of products of deviations from the mean

    All but the last product and the last difference are of integers below 2^53, so exact.
    """
    for i in range(num):
        n = moments[N, i]
        inverse = 1.0 / n
        sx, sy, sz = moments[S, i], moments[S + 1, i], moments[S + 2, i]
        mx, my, mz = sx * inverse, sy * inverse, sz * inverse
        # about the lattice point c nearest to the mean
        cx, cy, cz = np.rint(mx), np.rint(my), np.rint(mz)
        dx, dy, dz = sx - n * cx, sy - n * cy, sz - n * cz
        mean[0, i], mean[1, i], mean[2, i] = mx, my, mz
        scatter[0, i] = (moments[P, i] - cx * (sx + dx)) - dx * dx * inverse
        scatter[1, i] = (moments[P + 1, i] - cx * sy - cy * dx) - dx * dy * inverse
        scatter[2, i] = (moments[P + 2, i] - cx * sz - cz * dx) - dx * dz * inverse
        scatter[3, i] = (moments[P + 3, i] - cy * (sy + dy)) - dy * dy * inverse
        scatter[4, i] = (moments[P + 4, i] - cy * sz - cz * dy) - dy * dz * inverse
        scatter[5, i] = (moments[P + 5, i] - cz * (sz + dz)) - dz * dz * inverse


@inlined(error_model='numpy')
def center_exactly(rows, chosen, start, num, scatter):
    """Compute the scatters as ``center`` does, in int64, which is exact for any count."""
    flat = rows.ravel()
    for i in range(num):
        at = first_word(chosen[start + i])
        n = count_of(flat, at)
        inverse = 1.0 / n
        pair = 0
        for a in range(3):
            sa = sum_of(flat, at, a)
            ca = np.int64(np.rint(sa * inverse))
            da = sa - n * ca
            for b in range(a, 3):
                sb = sum_of(flat, at, b)
                cb = np.int64(np.rint(sb * inverse))
                db = sb - n * cb
                about = flat[at + U(PRODUCT) + U(pair)] - ca * sb - cb * da
                scatter[pair, i] = about - np.float64(da) * np.float64(db) * inverse
                pair += 1
