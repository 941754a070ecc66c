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

from surfel_mapper.kernels.compiling import kernel, part, U
from surfel_mapper.kernels.layout import KEY, PRODUCT
from surfel_mapper.kernels.prefetch import LINE_BYTES, prefetch_to_write
from surfel_mapper.kernels.quantisation import unpack
from surfel_mapper.kernels.symmetric3 import decompose_chunk, make_work
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
    keys, moments = np.empty(CHUNK, np.int64), np.empty((MOMENTS, CHUNK))
    scatter, shape = np.empty((6, CHUNK)), np.empty((2, CHUNK))
    mean, values, normals = np.empty((3, CHUNK)), np.empty((3, CHUNK)), np.empty((3, CHUNK))
    work = make_work(CHUNK)
    many = 1 << max(EXACT_BITS - 2 * bits, 0)
    vectors = position.ravel(), normal.ravel(), eigenvalues.ravel()
    written = vectors, (planarity, curvature), num_points, voxel_index.ravel()
    for start in range(0, len(chosen), CHUNK):
        num = min(CHUNK, len(chosen) - start)
        end = start + num
        most = gather(rows, chosen, start, num, keys, moments, written)
        write_index(keys, moments, num, num_points[start:end], voxel_index[start:end])
        center(moments, num, mean, scatter)
        if most >= many:
            center_exactly(rows, chosen, start, num, scatter)
        place(mean, num, voxel_size, bits, voxel_index[start:end], position[start:end])
        decompose_chunk(scatter, 0, num, work, values, normals)
        derive_shape(values, num, moments, voxel_size / (1 << bits), shape)
        turn(normals, num, moments, shape)
        write_numbers(shape[0], num, planarity[start:end])
        write_numbers(shape[1], num, curvature[start:end])
        write_vectors(normals, num, normal[start:end])
        write_vectors(values, num, eigenvalues[start:end])


@kernel(error_model='numpy')
def derive_covariances(rows, chosen, voxel_size, bits, covariance):
    """
    Derive the covariances of the points of some rows of the slab.

    rows, chosen, voxel_size, bits: as of derive_surfels
    covariance  (K, 6) float64, out: xx xy xz yy yz zz, m^2
    """
    keys, moments = np.empty(CHUNK, np.int64), np.empty((MOMENTS, CHUNK))
    mean, scatter = np.empty((3, CHUNK)), np.empty((6, CHUNK))
    many = 1 << max(EXACT_BITS - 2 * bits, 0)
    unit = voxel_size / (1 << bits)
    for start in range(0, len(chosen), CHUNK):
        num = min(CHUNK, len(chosen) - start)
        most = gather(rows, chosen, start, num, keys, moments, None)
        center(moments, num, mean, scatter)
        if most >= many:
            center_exactly(rows, chosen, start, num, scatter)
        for i in range(num):
            scale = unit * unit / max(moments[N, i] - 1.0, 1.0)
            for pair in range(6):
                covariance[start + i, pair] = scatter[pair, i] * scale


@part()
def gather(rows, chosen, start, num, keys, moments, written):
    """
    Gather the moments of num voxels from start on; return the largest count.

    keys     (CHUNK,) int64, out
    moments  (MOMENTS, CHUNK) float64, out
    written  arrays that are written next, to be prefetched, see prefetch_outputs; None for others
    """
    flat, last = rows.ravel(), len(chosen) - 1
    most = np.int64(0)
    for i in range(num):
        if written is not None and i % LINE == 0:
            prefetch_outputs(written, start + i)
        prefetch_row_early(flat, np.int64(chosen[min(start + i + EARLY, last)]))
        prefetch_row(flat, np.int64(chosen[min(start + i + AHEAD, last)]))
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


@part()
def prefetch_outputs(written, row):
    """
    Prefetch the memory of LINE surfels from a row on, to be written.

    written  position, normal and eigenvalues, each (3 K,) float64; planarity and curvature (K,)
             float64; num_points (K,) int64; voxel_index (3 K,) int32

    If the outputs do not fit the second level of the cache, deriving takes 1.15 times as long
    without.
    """
    vectors, numbers, num_points, voxel_index = written
    for vector in vectors:
        for line in range(3):
            prefetch_to_write(vector, min(3 * row + LINE * line, len(vector) - 1))
    for number in numbers:
        prefetch_to_write(number, row)
    prefetch_to_write(num_points, row)
    prefetch_to_write(voxel_index, 3 * row)
    prefetch_to_write(voxel_index, min(3 * row + 2 * LINE, len(voxel_index) - 1))


@part()
def write_index(keys, moments, num, num_points, voxel_index):
    """Write the numbers of points (num,) and the voxel indices (num, 3) of a chunk."""
    for i in range(num):
        num_points[i] = np.int64(moments[N, i])
    for i in range(num):
        voxel_index[i, 0], voxel_index[i, 1], voxel_index[i, 2] = unpack(keys[i])


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


@part(error_model='numpy')
def place(mean, num, voxel_size, bits, voxel_index, position):
    """Convert the means of a chunk to positions (num, 3), m."""
    cell = 1.0 / (1 << bits)
    half = (1 << (bits - 1)) + 0.5  # a lattice coordinate stands for the middle of its cell
    for i in range(num):
        for axis in range(3):
            inside = (mean[axis, i] + half) * cell
            position[i, axis] = (voxel_index[i, axis] + inside) * voxel_size


@part(error_model='numpy')
def derive_shape(values, num, moments, unit, shape):
    """
    Compute planarity and curvature of a chunk; scale eigenvalues of scatter to covariance.

    values  (3, CHUNK) float64, in: eigenvalues of the scatter, lattice units; out: of the
            covariance, m^2
    shape   (2, CHUNK) float64, out: planarity and curvature
    """
    for i in range(num):
        e0, e1, e2 = values[0, i], values[1, i], values[2, i]
        inverse = 1.0 / ((e0 + e1) + e2)
        shape[0, i] = 2.0 * (e1 - e0) * inverse  # 0 times inf is nan, as documented
        shape[1, i] = e0 * inverse
        scale = unit * unit / max(moments[N, i] - 1.0, 1.0)
        values[0, i] = e0 * scale
        values[1, i] = e1 * scale
        values[2, i] = e2 * scale


@part()
def turn(normals, num, moments, shape):
    """
    Turn the normals (3, CHUNK) of a chunk towards the sensor; nan where the planarity is.

    If its direction is unknown or orthogonal to the normal, the component of largest magnitude
    becomes positive, the first of equal ones.
    """
    for i in range(num):
        nx, ny, nz = normals[0, i], normals[1, i], normals[2, i]
        towards = (nx * moments[V, i] + ny * moments[V + 1, i]) + nz * moments[V + 2, i]
        y_or_z = ny if abs(ny) >= abs(nz) else nz
        largest = nx if (abs(nx) >= abs(ny)) & (abs(nx) >= abs(nz)) else y_or_z
        side = -1.0 if (largest if towards == 0.0 else towards) < 0.0 else 1.0
        side = math.nan if math.isnan(shape[0, i]) else side
        normals[0, i] = nx * side
        normals[1, i] = ny * side
        normals[2, i] = nz * side


@part()
def write_numbers(numbers, num, out):
    """Write the first numbers of a chunk, (CHUNK,), to (num,). A slice would compile much more."""
    for i in range(num):
        out[i] = numbers[i]


@part()
def write_vectors(vectors, num, out):
    """
    Write the vectors of a chunk, (3, CHUNK), to rows (num, 3).

    One array at a time, as every loop here: with several outputs the compiler would have to test
    too many pairs of arrays for overlap, and does not vectorise the loop.
    """
    for i in range(num):
        out[i, 0], out[i, 1], out[i, 2] = vectors[0, i], vectors[1, i], vectors[2, i]
