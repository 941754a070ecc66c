# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Which patches touch, and how well planes, quadrics and quartics fit their points.

Points are the means by voxel and owner; those of patch k are rows starts[k] to starts[k + 1] - 1.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.symmetric3 import eigen_frame

TERMS = np.array([3, 6, 15])
"""Coefficients of a plane, a quadric and a quartic height field."""

POWERS = np.array([(a, d - a) for d in range(5) for a in range(d, -1, -1)])
"""Powers of x and y in the terms of height fields, by degree."""

RIDGE = 1e-10
"""Added to the normal equations of coordinates in [-1, 1], for points in one line."""


@njit(cache=True, nogil=True)
def sort_owners(first, owners, means, counts, least, out):
    """
    Sort the means by owner, stably.

    first, owners, means, counts  (V + 1,) int64, (M,) int32, (M, 3), (M,) float64
    least                         least owner; those below are left out
    out                           starts (owners + 1,) int64, then voxel, means and counts sorted
    """
    starts, to_voxel, to_mean, to_count = out
    starts[:] = 0
    for owner in owners:
        if owner >= least:
            starts[owner - least + 1] += 1
    for k in range(len(starts) - 1):
        starts[k + 1] += starts[k]
    place = starts[:-1].copy()
    for v in range(len(first) - 1):
        for i in range(first[v], first[v + 1]):
            if owners[i] < least:
                continue
            row = place[owners[i] - least]
            place[owners[i] - least] += 1
            to_voxel[row], to_count[row] = v, counts[i]
            for j in range(3):
                to_mean[row, j] = means[i, j]


@njit(cache=True, nogil=True)
def touching_patches(starts, voxel, adjacent, first, owners, pairs):
    """
    Count the voxels of each patch that touch another one; return how many pairs there are.

    starts    (K + 1,) int64, voxel (P,) int32: voxels of each patch
    adjacent  starts and rows of neighbour_table
    first     (V + 1,) int64, owners (M,) int32: owners of the points of each voxel
    pairs     (R, 3) int64, out: patch, other patch, voxels of the patch that contain points of the
            other one or are neighbours of such voxels; rows beyond R are counted only
    """
    low, rows = adjacent
    number, num = len(starts) - 1, 0
    marked, count = np.full(number, -1, np.int64), np.zeros(number, np.int64)
    found = np.empty(number, np.int64)
    for k in range(number):
        num_found = 0
        for i in range(starts[k], starts[k + 1]):
            own = voxel[i]
            for n in range(low[own] - 1, low[own + 1]):
                v = rows[n] if n >= low[own] else own
                for m in range(first[v], first[v + 1]):
                    other = owners[m]
                    if other < 0 or other == k or marked[other] == i:
                        continue
                    marked[other] = i
                    if count[other] == 0:
                        found[num_found] = other
                        num_found += 1
                    count[other] += 1
        for n in range(num_found):
            if num < len(pairs):
                pairs[num, 0], pairs[num, 1], pairs[num, 2] = k, found[n], count[found[n]]
            count[found[n]] = 0
            num += 1
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def gather(rows, points, weights, found):
    """Copy points and weights of rows (n,) to found (4, n), as height_errors takes them."""
    for n in range(len(rows)):
        i = rows[n]
        for j in range(3):
            found[j, n] = points[i, j]
        found[3, n] = weights[i]


@njit(cache=True, nogil=True, error_model='numpy')
def height_errors(points, normal, errors):
    """
    Fit height fields of degree 1, 2 and 4 over a plane; return by how much the quadric turns, rad.

    Two errors leave out the quartic, which takes most of the time.

    points   (4, n) float64: x, y, z, weight
    normal   (3,) float64, of the plane
    errors   (2,) or (3,) float64, out: weighted mean squares of the residuals, m^2

    The Cholesky factor of the largest system contains those of the others, so one pass is enough.
    The turn is that of the normals of the quadric, for a strip of constant curvature the angle
    between its ends.
    """
    local = np.empty_like(points)
    scale = local_points(points, normal, local)
    quadric, terms = np.empty(TERMS[1]), np.empty(TERMS[len(errors) - 1])
    matrix = np.empty((len(terms), len(terms)))
    solve_heights(local, quadric, matrix)
    solve_transposed(matrix, quadric)
    turn = turn_of(local, quadric)
    left = solve_heights(local, terms, matrix)
    done = 0
    for d in range(len(errors)):
        for p in range(done, TERMS[d]):
            left -= terms[p] * terms[p]
        done = TERMS[d]
        errors[d] = max(left, 0.0) * scale * scale
    return turn


@njit(cache=True, nogil=True, error_model='numpy', fastmath={'reassoc', 'nnan', 'nsz'})
def local_points(points, normal, local):
    """
    Compute points over a plane, in [-1, 1]; return the factor to m.

    points  of height_errors
    local   (4, n) float64, out: x, y, height, share of the weight
    """
    x_axis, y_axis = np.empty(3), np.empty(3)
    tangential_axes(normal, x_axis, y_axis)
    (xa, xb, xc), (ya, yb, yc), (za, zb, zc) = x_axis, y_axis, normal
    x, y, z, weight = points[0], points[1], points[2], points[3]
    u, v, height, share = local[0], local[1], local[2], local[3]
    total = a = b = c = 0.0
    for n in range(len(x)):
        total += weight[n]
        a, b, c = a + weight[n] * x[n], b + weight[n] * y[n], c + weight[n] * z[n]
    a, b, c, scale = a / total, b / total, c / total, 1e-12
    for n in range(len(x)):
        dx, dy, dz = x[n] - a, y[n] - b, z[n] - c
        u[n] = dx * xa + dy * xb + dz * xc
        v[n] = dx * ya + dy * yb + dz * yc
        height[n] = dx * za + dy * zb + dz * zc
        scale = max(scale, abs(u[n]), abs(v[n]))
    for n in range(len(x)):
        share[n] = weight[n] / total
        u[n] /= scale
        v[n] /= scale
        height[n] /= scale
    return scale


@njit(cache=True, nogil=True, error_model='numpy')
def solve_heights(local, reduced, matrix):
    """
    Fit a height field by least squares; return the weighted mean square of the heights.

    local    of local_points
    reduced  (T,) float64, out: right side of the triangular system; its squares are the parts of
             the mean square that the terms explain, one after the other
    matrix   (T, T) float64 or larger, out: its Cholesky factor
    """
    size = len(reduced)
    degree = 2 if size == TERMS[1] else 4
    sums, right = np.empty((2, 2 * degree + 1, 2 * degree + 1))
    squares = height_sums(local, degree, sums, right)
    for p in range(size):
        x, y = POWERS[p]
        reduced[p] = right[y, x]
        for q in range(p + 1):
            matrix[p, q] = sums[y + POWERS[q, 1], x + POWERS[q, 0]]
    for p in range(size):
        matrix[p, p] += RIDGE
        for q in range(p + 1):
            value = matrix[p, q]
            for m in range(q):
                value -= matrix[p, m] * matrix[q, m]
            matrix[p, q] = math.sqrt(max(value, RIDGE)) if p == q else value / matrix[q, q]
        for m in range(p):
            reduced[p] -= matrix[p, m] * reduced[m]
        reduced[p] /= matrix[p, p]
    return squares


@njit(cache=True, nogil=True, error_model='numpy')
def solve_transposed(matrix, reduced):
    """Solve for the coefficients, in place; matrix and reduced of solve_heights."""
    for p in range(len(reduced) - 1, -1, -1):
        for m in range(p + 1, len(reduced)):
            reduced[p] -= matrix[m, p] * reduced[m]
        reduced[p] /= matrix[p, p]


@njit(cache=True, nogil=True, error_model='numpy')
def height_sums(local, degree, sums, right):
    """
    Sum monomials of x and y, and these times the height; return the weighted mean square height.

    The normal equations of degree d have (2 d + 1) (d + 1) different entries of their
    ((d + 1) (d + 2) / 2)^2, and a sum over all points at a time is four times as fast.

    local  of local_points
    sums   (2 d + 1, 2 d + 1) float64, out: of share x^a y^b at [b, a], for a + b <= 2 d
    right  (2 d + 1, 2 d + 1) float64, out: of share z x^a y^b, for a + b <= d
    """
    number = local.shape[1]
    powers, z = np.empty((2 * degree + 1, number)), local[2].copy()
    x, y, powers[0] = local[0], local[1], local[3]
    for a in range(1, len(powers)):
        for n in range(number):
            powers[a, n] = powers[a - 1, n] * x[n]
    factor = np.ones(number)
    for b in range(2 * degree + 1):
        for a in range(2 * degree + 1 - b):
            sums[b, a] = product_sum(factor, powers[a])
        if b <= degree:
            z *= factor
            for a in range(degree + 1 - b):
                right[b, a] = product_sum(z, powers[a])
            z[:] = local[2]
        factor *= y
    z *= z
    return product_sum(z, powers[0])


@njit(cache=True, nogil=True, error_model='numpy', fastmath={'reassoc'})
def product_sum(a, b):
    """Return the scalar product of vectors (n,)."""
    total = 0.0
    for n in range(len(a)):
        total += a[n] * b[n]
    return total


@njit(cache=True, nogil=True, error_model='numpy', fastmath={'reassoc'})
def turn_of(local, terms):
    """
    Return sqrt(12) times the root mean square angle of a quadric's normals to their mean.

    local  of local_points; shares are multiplied by the squared cosine of the slope, so that
           heights weigh as much as distances from the surface
    terms  (6,) float64, of the quadric
    """
    x, y, share = local[0], local[1], local[3]
    _, a, b, c, d, e = terms
    sum_x = sum_y = sum_z = 0.0
    for n in range(len(x)):
        slope_x, slope_y = a + 2.0 * c * x[n] + d * y[n], b + d * x[n] + 2.0 * e * y[n]
        length_sq = 1.0 + slope_x * slope_x + slope_y * slope_y
        up = 1.0 / math.sqrt(length_sq)
        sum_x, sum_y, sum_z = sum_x + slope_x * up, sum_y + slope_y * up, sum_z + up
        share[n] /= length_sq
    mean_sq = (sum_x * sum_x + sum_y * sum_y + sum_z * sum_z) / float(len(x)) ** 2
    # unit normals: their mean square distance from the mean is 1 less its square
    return math.sqrt(12.0 * max(1.0 - mean_sq, 0.0))


@njit(cache=True, nogil=True, error_model='numpy')
def tangential_axes(normal, x_axis, y_axis):
    """Compute unit vectors orthogonal to a unit normal and to each other."""
    least = 0
    for j in range(1, 3):
        if abs(normal[j]) < abs(normal[least]):
            least = j
    length = math.sqrt(1.0 - normal[least] ** 2)
    for j in range(3):
        x_axis[j] = ((1.0 if j == least else 0.0) - normal[least] * normal[j]) / length
    for j in range(3):
        a, b = (j + 1) % 3, (j + 2) % 3
        y_axis[j] = normal[a] * x_axis[b] - normal[b] * x_axis[a]


@njit(cache=True, nogil=True, error_model='numpy')
def plane_frames(points, weights, starts, means, normals, values):
    """
    Compute weighted mean (K, 3), normal (K, 3) and eigenvalues (K, 3) of every patch; 0 if empty.

    points, weights, starts  see above
    """
    scatter, value, axes = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for k in range(len(starts) - 1):
        total, mean = 0.0, np.zeros(3)
        means[k], normals[k], values[k] = 0.0, 0.0, 0.0
        if starts[k] == starts[k + 1]:
            continue
        for i in range(starts[k], starts[k + 1]):
            total += weights[i]
            for j in range(3):
                mean[j] += weights[i] * points[i, j]
        for j in range(3):
            means[k, j] = mean[j] / total
        scatter[:] = 0.0
        for i in range(starts[k], starts[k + 1]):
            for a in range(3):
                for b in range(a + 1):
                    scatter[a, b] += (
                        weights[i] * (points[i, a] - means[k, a]) * (points[i, b] - means[k, b])
                    )
        for a in range(3):
            for b in range(a + 1):
                scatter[a, b] /= total
                scatter[b, a] = scatter[a, b]
        eigen_frame(scatter, value, axes)
        normals[k], values[k] = axes[0], value


@njit(cache=True, nogil=True)
def rename_owners(starts, group, index, owner):
    """
    Rename patch k to index[k] (K,) in owners (P,) int32; free ones become -1 - their group (V,).

    starts  (V + 1,) int64, first owner of each voxel
    """
    for v in range(len(starts) - 1):
        for i in range(starts[v], starts[v + 1]):
            owner[i] = index[owner[i]] if owner[i] >= 0 else -1 - group[v]
