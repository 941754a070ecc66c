# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Which patches touch, and how well planes, quadrics and quartics fit their points.

Points are the means by voxel and owner; those of patch k are rows starts[k] to starts[k + 1] - 1.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel

TERMS = np.array([3, 6, 15])
"""Coefficients of a plane, a quadric and a quartic height field."""

POWERS = np.array([(a, d - a) for d in range(5) for a in range(d, -1, -1)])
"""Powers of x and y in the terms of height fields, by degree."""

RIDGE = 1e-10
"""Added to the normal equations of coordinates in [-1, 1], for points in one line."""


@kernel(error_model='numpy')
def sort_owners(first, owners, means, counts, least, out):
    """
    Sort the means by owner, stably.

    first, owners, means, counts  (V + 1,) int64, (M,) int32, (M, 3), (M,) float64
    least                         least owner; those below are left out
    out                           starts (owners + 1,) int64, then voxel, means and counts sorted
    """
    starts, to_voxel, to_mean, to_count = out
    starts[:] = 0
    for i in range(len(owners)):
        if owners[i] >= least:
            starts[owners[i] - least + 1] += 1
    next_row = np.empty(len(starts), np.int64)
    for k in range(len(starts) - 1):
        next_row[k] = starts[k]
        starts[k + 1] += starts[k]
    for v in range(len(first) - 1):
        for i in range(first[v], first[v + 1]):
            if owners[i] < least:
                continue
            row = next_row[owners[i] - least]
            next_row[owners[i] - least] += 1
            to_voxel[row], to_count[row] = v, counts[i]
            for j in range(3):
                to_mean[row, j] = means[i, j]


@kernel(error_model='numpy')
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
    table = np.empty((number, 3), np.int64)
    marked, count, touched = table[:, 0], table[:, 1], table[:, 2]
    for k in range(number):
        marked[k], count[k] = -1, 0
    for k in range(number):
        num_touched = 0
        for i in range(starts[k], starts[k + 1]):
            own = voxel[i]
            for n in range(low[own] - 1, low[own + 1]):
                v = rows[n] if n >= low[own] else own
                for m in range(first[v], first[v + 1]):
                    neighbour = owners[m]
                    if neighbour < 0 or neighbour == k or marked[neighbour] == i:
                        continue
                    marked[neighbour] = i
                    if count[neighbour] == 0:
                        touched[num_touched] = neighbour
                        num_touched += 1
                    count[neighbour] += 1
        for n in range(num_touched):
            if num < len(pairs):
                pairs[num, 0], pairs[num, 1], pairs[num, 2] = k, touched[n], count[touched[n]]
            count[touched[n]] = 0
            num += 1
    return num


@inlined(error_model='numpy')
def gather(rows, number, stride, points, weights, columns, low):
    """
    Copy every stride-th of the first ``number`` rows as height_errors takes them; return the end.

    rows             (N,) int64
    points, weights  (P, 3), (P,) float64
    columns          (4, M) float64, out from column low on: x, y, z, weight
    """
    for n in range(0, number, stride):
        i = rows[n]
        for j in range(3):
            columns[j, low] = points[i, j]
        columns[3, low] = weights[i]
        low += 1
    return low


@inlined(error_model='numpy', fastmath={'reassoc', 'nnan', 'nsz'})
def height_errors(points, low, high, normal, errors):
    """
    Fit height fields of degree 1, 2 and 4 over a plane; return by how much the quadric turns, rad.

    Two errors leave out the quartic, which takes most of the time.

    points     (4, n) float64: x, y, z, weight
    low, high  columns low to high - 1 are used
    normal     (3,) float64, of the plane
    errors     (2,) or (3,) float64, out: weighted mean squares of the residuals, m^2

    The Cholesky factor of the largest system contains those of the others, so one pass is enough.
    The turn is that of the normals of the quadric, for a strip of constant curvature the angle
    between its ends. Shares of the second pass are multiplied by the squared cosine of the slope
    of the quadric, so that heights weigh as much as distances from the surface.
    """
    most = TERMS[len(errors) - 1]
    local, powers = np.empty((4, high - low)), np.empty((9, high - low))
    sums, right = np.empty((9, 9)), np.empty((5, 5))
    terms, matrix = np.empty(most), np.empty((most, most))
    scale = local_points(points, low, normal, local)
    residual = turn = 0.0
    for again in range(2):
        size = most if again else TERMS[1]
        degree = 4 if size > TERMS[1] else 2
        residual = height_sums(local, degree, powers, sums, right)
        solve_heights(size, sums, right, terms, matrix)
        if not again:
            solve_transposed(size, matrix, terms)
            turn = turn_of(local, terms)
    done = 0
    for d in range(len(errors)):
        for p in range(done, TERMS[d]):
            residual -= terms[p] * terms[p]
        done = TERMS[d]
        errors[d] = max(residual, 0.0) * scale * scale
    return turn


@inlined(error_model='numpy')
def local_points(points, low, normal, local):
    """
    Compute points over a plane, in [-1, 1]; return the factor to m.

    points, low, normal  of height_errors
    local                (4, n) float64, out: x, y, height, share of the weight
    """
    least = 0
    for j in range(1, 3):
        if abs(normal[j]) < abs(normal[least]):
            least = j
    length = math.sqrt(1.0 - normal[least] ** 2)
    za, zb, zc = normal[0], normal[1], normal[2]
    xa = ((1.0 if least == 0 else 0.0) - normal[least] * za) / length
    xb = ((1.0 if least == 1 else 0.0) - normal[least] * zb) / length
    xc = ((1.0 if least == 2 else 0.0) - normal[least] * zc) / length
    ya, yb, yc = zb * xc - zc * xb, zc * xa - za * xc, za * xb - zb * xa
    total = a = b = c = 0.0
    for n in range(local.shape[1]):
        x, y, z, weight = (
            points[0, low + n],
            points[1, low + n],
            points[2, low + n],
            points[3, low + n],
        )
        total += weight
        a, b, c = a + weight * x, b + weight * y, c + weight * z
    a, b, c, scale = a / total, b / total, c / total, 1e-12
    for n in range(local.shape[1]):
        dx, dy, dz = points[0, low + n] - a, points[1, low + n] - b, points[2, low + n] - c
        u = dx * xa + dy * xb + dz * xc
        v = dx * ya + dy * yb + dz * yc
        local[0, n], local[1, n] = u, v
        local[2, n] = dx * za + dy * zb + dz * zc
        scale = max(scale, abs(u), abs(v))
    for n in range(local.shape[1]):
        local[0, n] /= scale
        local[1, n] /= scale
        local[2, n] /= scale
        local[3, n] = points[3, low + n] / total
    return scale


@inlined(error_model='numpy')
def height_sums(local, degree, powers, sums, right):
    """
    Sum monomials of x and y, and these times the height; return the weighted mean square height.

    The normal equations of degree d have (2 d + 1) (d + 1) different entries of their
    ((d + 1) (d + 2) / 2)^2, and a sum over all points at a time is four times as fast.

    local   of local_points
    powers  (2 d + 1, n) float64, scratch
    sums    (2 d + 1, 2 d + 1) float64, out: of share x^a y^b at [b, a], for a + b <= 2 d
    right   (d + 1, d + 1) float64, out: of share z x^a y^b, for a + b <= d
    """
    squares = 0.0
    for n in range(local.shape[1]):
        value = local[3, n]
        squares += value * local[2, n] * local[2, n]
        for a in range(2 * degree + 1):
            powers[a, n] = value
            value *= local[0, n]
    for b in range(2 * degree + 1):
        for a in range(2 * degree + 1 - b):
            total = 0.0
            for n in range(local.shape[1]):
                total += powers[a, n]
            sums[b, a] = total
        for a in range(degree + 1 - b):
            total = 0.0
            for n in range(local.shape[1]):
                total += powers[a, n] * local[2, n]
            right[b, a] = total
        for a in range(2 * degree - b):
            for n in range(local.shape[1]):
                powers[a, n] *= local[1, n]
    return squares


@inlined(error_model='numpy')
def solve_heights(size, sums, right, reduced, matrix):
    """
    Solve the triangular part of a least squares fit of ``size`` terms.

    sums, right  of height_sums
    reduced      (size,) float64 or longer, out: right side of the triangular system; its squares
                 are the parts of the mean square that the terms explain, one after the other
    matrix       (size, size) float64 or larger, out: its Cholesky factor
    """
    for p in range(size):
        x, y = POWERS[p, 0], POWERS[p, 1]
        reduced[p] = right[y, x]
        for q in range(p + 1):
            value = sums[y + POWERS[q, 1], x + POWERS[q, 0]]
            value += RIDGE if p == q else 0.0
            for m in range(q):
                value -= matrix[p, m] * matrix[q, m]
            matrix[p, q] = math.sqrt(max(value, RIDGE)) if p == q else value / matrix[q, q]
        for m in range(p):
            reduced[p] -= matrix[p, m] * reduced[m]
        reduced[p] /= matrix[p, p]


@inlined(error_model='numpy')
def solve_transposed(size, matrix, reduced):
    """Solve for the coefficients, in place; matrix and reduced of solve_heights."""
    for p in range(size - 1, -1, -1):
        for m in range(p + 1, size):
            reduced[p] -= matrix[m, p] * reduced[m]
        reduced[p] /= matrix[p, p]


@inlined(error_model='numpy')
def turn_of(local, terms):
    """
    Return sqrt(12) times the root mean square angle of a quadric's normals to their mean.

    local  of local_points; shares are multiplied by the squared cosine of the slope
    terms  (6,) float64, of the quadric
    """
    a, b, c, d, e = terms[1], terms[2], terms[3], terms[4], terms[5]
    sum_x = sum_y = sum_z = 0.0
    for n in range(local.shape[1]):
        x, y = local[0, n], local[1, n]
        slope_x, slope_y = a + 2.0 * c * x + d * y, b + d * x + 2.0 * e * y
        length_sq = 1.0 + slope_x * slope_x + slope_y * slope_y
        up = 1.0 / math.sqrt(length_sq)
        sum_x, sum_y, sum_z = sum_x + slope_x * up, sum_y + slope_y * up, sum_z + up
        local[3, n] /= length_sq
    mean_sq = (sum_x * sum_x + sum_y * sum_y + sum_z * sum_z) / float(local.shape[1]) ** 2
    # unit normals: their mean square distance from the mean is 1 less its square
    return math.sqrt(12.0 * max(1.0 - mean_sq, 0.0))
