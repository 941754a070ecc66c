# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Derive surfels from the moments of voxels: mean, eigenvalues, normal, planarity, curvature.

Moments are first moved, in exact arithmetic, from the voxel centre to the lattice point nearest to
the mean. The scatter is taken there, so nothing cancels: identical points give a scatter of
exactly 0 anywhere in the voxel. Voxels are gathered in chunks that stay in the cache and are
decomposed with vector instructions.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import kernel, part
from surfel_mapper.kernels.layout import (
    KEY,
    PRODUCT,
)
from surfel_mapper.kernels.quantisation import unpack
from surfel_mapper.kernels.symmetric3 import decompose_chunk, make_work
from surfel_mapper.mapping.kernels.rows import (
    count_of,
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
def derive_surfels(rows, chosen, voxel_size, bits, outputs):
    """
    Derive the surfels of some rows of the slab.

    rows        (R, 12) int64
    chosen      (K,) int32 or int64, rows to derive; each holds at least one point
    voxel_size  float64, m
    bits        a voxel is 2^bits lattice units wide
    outputs     position (K, 3) float64 m, normal (K, 3), planarity (K,), curvature (K,),
                eigenvalues (K, 3) m^2, num_points (K,) int64, voxel_index (K, 3) int32

    A single point or identical points: eigenvalues 0; normal, planarity and curvature nan.
    """
    position, normal, planarity, curvature, eigenvalues, num_points, voxel_index = outputs
    moments = np.empty((MOMENTS, CHUNK))
    scatter = np.empty((6, CHUNK))
    mean, values, normals = np.empty((3, CHUNK)), np.empty((3, CHUNK)), np.empty((3, CHUNK))
    work = make_work(CHUNK)
    many = 1 << max(EXACT_BITS - 2 * bits, 0)
    for start in range(0, len(chosen), CHUNK):
        num = min(CHUNK, len(chosen) - start)
        most = gather(rows, chosen, start, num, moments, num_points, voxel_index)
        center(moments, num, mean, scatter)
        if most >= many:
            center_exactly(rows, chosen, start, num, scatter)
        place(mean, start, num, voxel_size, bits, voxel_index, position)
        decompose_chunk(scatter, 0, num, work, values, normals)
        derive_shape(values, num, moments, voxel_size / (1 << bits), planarity, curvature, start)
        turn(normals, num, moments)
        for i in range(num):
            out = start + i
            # a factor instead of a branch, which would be mispredicted half of the time
            known = math.nan if math.isnan(planarity[out]) else 1.0
            for axis in range(3):
                normal[out, axis] = normals[axis, i] * known
                eigenvalues[out, axis] = values[axis, i]


@kernel(error_model='numpy')
def derive_covariances(rows, chosen, voxel_size, bits, covariance):
    """
    Derive the covariances of the points of some rows of the slab.

    rows, chosen, voxel_size, bits: as of derive_surfels
    covariance  (K, 6) float64, out: xx xy xz yy yz zz, m^2
    """
    moments = np.empty((MOMENTS, CHUNK))
    mean, scatter = np.empty((3, CHUNK)), np.empty((6, CHUNK))
    num_points, voxel_index = np.empty(len(chosen), np.int64), np.empty((len(chosen), 3), np.int32)
    many = 1 << max(EXACT_BITS - 2 * bits, 0)
    unit = voxel_size / (1 << bits)
    for start in range(0, len(chosen), CHUNK):
        num = min(CHUNK, len(chosen) - start)
        most = gather(rows, chosen, start, num, moments, num_points, voxel_index)
        center(moments, num, mean, scatter)
        if most >= many:
            center_exactly(rows, chosen, start, num, scatter)
        for i in range(num):
            scale = unit * unit / max(moments[N, i] - 1.0, 1.0)
            for pair in range(6):
                covariance[start + i, pair] = scatter[pair, i] * scale


@part()
def gather(rows, chosen, start, num, moments, num_points, voxel_index):
    """
    Gather the moments of num voxels from start on; return the largest count.

    moments      (MOMENTS, CHUNK) float64, out
    num_points   (K,) int64, out
    voxel_index  (K, 3) int32, out
    """
    flat = rows.ravel()
    most = np.int64(0)
    for i in range(num):
        out = start + i
        if out + EARLY < len(chosen):
            prefetch_row_early(flat, np.int64(chosen[out + EARLY]))
        if out + AHEAD < len(chosen):
            prefetch_row(flat, np.int64(chosen[out + AHEAD]))
        row = np.int64(chosen[out])
        key, n = rows[row, KEY], count_of(rows, row)
        voxel_index[out, 0], voxel_index[out, 1], voxel_index[out, 2] = unpack(key)
        num_points[out] = n
        most = max(most, n)
        moments[N, i] = n
        moments[V, i], moments[V + 1, i], moments[V + 2, i] = view_of(rows, row)
        for axis in range(3):
            moments[S + axis, i] = sum_of(rows, row, axis)
        for pair in range(6):
            moments[P + pair, i] = rows[row, PRODUCT + pair]
    return most


@part(error_model='numpy')
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


@part(error_model='numpy')
def center_exactly(rows, chosen, start, num, scatter):
    """Compute the scatters as ``center`` does, in int64, which is exact for any count."""
    for i in range(num):
        row = np.int64(chosen[start + i])
        n = count_of(rows, row)
        inverse = 1.0 / n
        pair = 0
        for a in range(3):
            sa = sum_of(rows, row, a)
            ca = np.int64(np.rint(sa * inverse))
            da = sa - n * ca
            for b in range(a, 3):
                sb = sum_of(rows, row, b)
                cb = np.int64(np.rint(sb * inverse))
                db = sb - n * cb
                about = rows[row, PRODUCT + pair] - ca * sb - cb * da
                scatter[pair, i] = about - np.float64(da) * np.float64(db) * inverse
                pair += 1


@part(error_model='numpy')
def place(mean, start, num, voxel_size, bits, voxel_index, position):
    """Convert the means of a chunk to positions, m, from row start on."""
    cell = 1.0 / (1 << bits)
    half = (1 << (bits - 1)) + 0.5  # a lattice coordinate stands for the middle of its cell
    for i in range(num):
        for axis in range(3):
            inside = (mean[axis, i] + half) * cell
            position[start + i, axis] = (voxel_index[start + i, axis] + inside) * voxel_size


@part(error_model='numpy')
def derive_shape(values, num, moments, unit, planarity, curvature, start):
    """
    Compute planarity and curvature of a chunk; scale eigenvalues of scatter to covariance.

    values  (3, CHUNK) float64, in: eigenvalues of the scatter, lattice units; out: of the
            covariance, m^2
    start   first row of the chunk in planarity and curvature
    """
    for i in range(num):
        e0, e1, e2 = values[0, i], values[1, i], values[2, i]
        inverse = 1.0 / ((e0 + e1) + e2)
        planarity[start + i] = 2.0 * (e1 - e0) * inverse  # 0 times inf is nan, as documented
        curvature[start + i] = e0 * inverse
        scale = unit * unit / max(moments[N, i] - 1.0, 1.0)
        values[0, i] = e0 * scale
        values[1, i] = e1 * scale
        values[2, i] = e2 * scale


@part()
def turn(normals, num, moments):
    """
    Turn the normals (3, CHUNK) of a chunk towards the sensor.

    If its direction is unknown or orthogonal to the normal, the component of largest magnitude
    becomes positive, the first of equal ones.
    """
    for i in range(num):
        nx, ny, nz = normals[0, i], normals[1, i], normals[2, i]
        towards = (nx * moments[V, i] + ny * moments[V + 1, i]) + nz * moments[V + 2, i]
        y_or_z = ny if abs(ny) >= abs(nz) else nz
        largest = nx if (abs(nx) >= abs(ny)) & (abs(nx) >= abs(nz)) else y_or_z
        side = -1.0 if (largest if towards == 0.0 else towards) < 0.0 else 1.0
        normals[0, i] = nx * side
        normals[1, i] = ny * side
        normals[2, i] = nz * side
