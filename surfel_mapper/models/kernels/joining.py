# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Which patches touch, and by how much a common height field of two regions is better than two.

Points are the means by voxel and owner; those of patch k are rows starts[k] to starts[k + 1] - 1.
The patches of region r are members[first[r]] to members[first[r + 1] - 1].
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel

PLANE, QUADRIC = 3, 6
"""Terms of height fields."""

POWERS = np.array([(a, d - a) for d in range(3) for a in range(d, -1, -1)])
"""Powers of x and y in the terms of height fields, by degree."""

RIDGE = 1e-10
"""Added to the normal equations of coordinates in [-1, 1], for points in one line."""

COPLANAR_COSINE, COPLANAR_GROWTH = math.cos(math.radians(6.0)), 1.25
"""Coplanar patches differ by less, and their common plane fits worse by less."""

REACH = 2.0
"""Only points within this many extents of the smaller region are compared."""

MOST_ROWS = 600
"""Points that are compared, at most; larger regions are subsampled."""

ROUNDS = 3
"""Fits of a round surface, each with the curvature of the previous one."""

MOST_STEEP = 0.05
"""Share of the points of a joined surface with a slope beyond the limit."""

POINTS_PER_TERM = 2.0
"""A height field needs more points. Those are means by voxel: each is of many."""


@kernel(error_model='numpy')
def touching_patches(starts, voxel, adjacent, first, owners, pairs):
    """
    Count the voxels of each patch that touch another one; return how many pairs there are.

    starts    (K + 1,) int64, voxel (P,) int32: voxels of each patch, equal ones in a row
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
            if i > starts[k] and voxel[i - 1] == own:
                continue
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
def local_points(points, low, normal, local):
    """
    Compute points over a plane, in [-1, 1]; return the factor to m.

    points, low, normal  of heights
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
def height_sums(local, powers, sums, right):
    """
    Sum monomials of x and y, and these times the height; return the weighted mean square height.

    A sum over all points at a time is four times as fast as all sums at a point.

    local   of local_points
    powers  (5, n) float64, scratch
    sums    (5, 5) float64, out: of share x^a y^b at [b, a], for a + b <= 4
    right   (3, 3) float64, out: of share z x^a y^b, for a + b <= 2
    """
    squares = 0.0
    for n in range(local.shape[1]):
        value = local[3, n]
        squares += value * local[2, n] * local[2, n]
        for a in range(5):
            powers[a, n] = value
            value *= local[0, n]
    for b in range(5):
        for a in range(5 - b):
            total = height = 0.0
            for n in range(local.shape[1]):
                total += powers[a, n]
                height += powers[a, n] * local[2, n]
            sums[b, a] = total
            if a + b < 3:
                right[b, a] = height
            for n in range(local.shape[1]):
                powers[a, n] *= local[1, n]
    return squares


@inlined(error_model='numpy')
def solve_heights(sums, right, reduced, matrix):
    """
    Solve the triangular part of a least squares fit of a quadric.

    sums, right  of height_sums
    reduced      (6,) float64, out: right side of the triangular system; its squares are the
                 parts of the mean square that the terms explain, one after the other
    matrix       (6, 6) float64, out: its Cholesky factor
    """
    for p in range(QUADRIC):
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
def solve_transposed(matrix, reduced, number):
    """Solve for the first coefficients, in place; matrix and reduced of solve_heights."""
    for p in range(number - 1, -1, -1):
        for m in range(p + 1, number):
            reduced[p] -= matrix[m, p] * reduced[m]
        reduced[p] /= matrix[p, p]


@inlined(error_model='numpy')
def round_heights(local, raw, terms, steepest):
    """
    Turn the heights of a round surface into those of a quadric; return its turn and steep share.

    On a circle z = g (x^2 + z^2), so z - g z^2 of cylinders and balls is a quadric, with residuals
    that are distances. g is half the larger curvature of the quadric of the previous round.

    local     of local_points; heights, and shares times the squared cosine of the slope: out
    raw       (2, n) float64, heights and shares
    terms     (6,) float64, of the quadric
    steepest  least cosine of the slope

    The turn is sqrt(12) times the root mean square angle of the normals to their mean.
    """
    a, b, c, d, e = terms[1], terms[2], terms[3], terms[4], terms[5]
    g = math.sqrt((c - e) * (c - e) + d * d)
    g = 0.5 * (c + e + (g if c + e > 0.0 else -g))
    sum_x = sum_y = sum_z = steep = 0.0
    for n in range(local.shape[1]):
        x, y, z = local[0, n], local[1, n], raw[0, n]
        slope_x, slope_y = a + 2.0 * c * x + d * y, b + d * x + 2.0 * e * y
        slope_z = 1.0 - 2.0 * g * z
        length_sq = slope_z * slope_z + slope_x * slope_x + slope_y * slope_y
        up = 1.0 / math.sqrt(length_sq)
        steep += slope_z * up < steepest
        sum_x, sum_y, sum_z = sum_x + slope_x * up, sum_y + slope_y * up, sum_z + slope_z * up
        local[2, n] = z - g * z * z
        local[3, n] = raw[1, n] / length_sq
    mean_sq = (sum_x * sum_x + sum_y * sum_y + sum_z * sum_z) / float(local.shape[1]) ** 2
    # unit normals: their mean square distance from the mean is 1 less its square
    return math.sqrt(12.0 * max(1.0 - mean_sq, 0.0)), steep / local.shape[1]


@kernel(error_model='numpy')
def compare_regions(pairs, groups, pieces, regions, rules, columns, out):
    """
    Compute by how much one height field of a pair of regions is better than two.

    pairs    (R, 2) int64; a pair of a region with itself describes the region
    groups   members (K,) int64 and first (K + 1,) int64: see above
    pieces   starts (K + 1,) int64, points (P, 3), weights (P,), patch normals (K, 3) float64
    regions  sums of normals (K, 3), middles (K, 3), extents (K,), m, noise across them (K,), m
    rules    floor (K,) float64, square of the residuals that are not resolved, m^2; least cosine
             of the slope of a joined surface, see MOST_STEEP
    columns  (4, P + 1) float64, scratch
    out      (R, 4) float64, out: gain of a pair, 0 for none; of a region: gain of the best height
             field over a plane, turn, rad, and bend, m, of the quadric, rms from a plane, m

    (Longer than other kernels: the points of both regions are copied by one loop.)
    """
    (members, first), (floor, steepest) = groups, rules
    starts, points, weights, patch_normals = pieces
    totals, middles, extents, noise = regions
    normals, ends, zero = np.empty((3, 3)), np.zeros(3, np.int64), np.int64(0)
    for r in range(len(pairs)):
        a, b = pairs[r, 0], pairs[r, 1]
        out[r, 0] = 0.0
        for j in range(3):
            normals[0, j], normals[1, j] = totals[a, j], totals[b, j]
            normals[2, j] = totals[a, j] + totals[b, j]
        for i in range(3):
            normalise(normals[i])
        cosine, is_single, is_chart, num = dot(normals[0], normals[1]), a == b, True, zero
        small = a if extents[a] < extents[b] else b
        x, y, z = middles[small, 0], middles[small, 1], middles[small, 2]
        for side in range(1 if is_single else 2):
            region, limit = b if side else a, REACH * extents[small]
            limit_sq = np.inf if region == small or extents[region] < limit else limit * limit
            for m in range(first[region], first[region + 1]):
                patch = members[m]
                if not is_single and dot(patch_normals[patch], normals[2]) < steepest:
                    is_chart = False
                if not is_chart:
                    break
                for i in range(starts[patch], starts[patch + 1]):
                    dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
                    columns[0, num], columns[1, num] = points[i, 0], points[i, 1]
                    columns[2, num], columns[3, num] = points[i, 2], weights[i]
                    num += dx * dx + dy * dy + dz * dz < limit_sq
            ends[side + 1] = num
        if not is_chart:
            continue
        stride, end, border = 1 + num // MOST_ROWS, zero, zero
        for side in range(1 if is_single else 2):
            border = end
            for i in range(ends[side], ends[side + 1], stride):
                for j in range(4):
                    columns[j, end] = columns[j, i]
                end += 1
        if min(border, end - border) < 3 and not is_single:
            continue
        least = max(floor[a], floor[b])
        both = heights(columns, zero, end, normals[2], (least, steepest, end))
        gain, out[r, 1], out[r, 2], out[r, 3] = both[1] - both[0], both[3], both[4], both[2]
        if not is_single:
            gain, rms_m = -both[0], max(noise[a], noise[b])
            for side in range(2):
                low, high = (border, end) if side else (zero, border)
                own = heights(columns, low, high, normals[side], (least, steepest, end))
                gain, rms_m = gain + own[0], max(rms_m, own[2])
            if cosine > COPLANAR_COSINE and both[2] < COPLANAR_GROWTH * rms_m:
                gain = max(gain, float(min(border, end - border)))
            elif both[5] > MOST_STEEP and both[0] < both[1]:
                gain = 0.0
        out[r, 0] = max(gain, 0.0)


@kernel(error_model='numpy', fastmath={'reassoc', 'nnan', 'nsz'})
def heights(points, low, high, normal, rules):
    """
    Fit a plane and a quadric over a plane to columns low to high - 1 of points (4, n).

    Returns cost, cost of a plane, rms from a plane m, and of the quadric turn rad, bend m, and the
    share of its points beyond the steepest slope.

    The Cholesky factor of the quadric contains the plane's, so one solution is enough for both.
    The turn is that of the normals of the quadric, for a strip of constant curvature the angle
    between its ends. After the first round the quadric is that of a round surface. Rules are the
    square of the residuals that are not resolved, the least cosine of the slope, and the number
    of points of both regions: by the criterion a term costs the same in one field and in two.
    """
    number, (floor, steepest, every) = high - low, rules
    local, powers = np.empty((4, number)), np.empty((5, number))
    sums, right, plane = np.empty((5, 5)), np.empty((3, 3)), np.empty(PLANE)
    terms, matrix = np.empty(QUADRIC), np.empty((QUADRIC, QUADRIC))
    scale = local_points(points, low, normal, local)
    raw = local[2:].copy()
    plane_sq = quadric_sq = turn = steep = 0.0
    for round_number in range(ROUNDS):
        quadric_sq = height_sums(local, powers, sums, right)
        solve_heights(sums, right, terms, matrix)
        if not round_number:
            plane_sq = quadric_sq
            for p in range(PLANE):
                plane[p] = terms[p]
                plane_sq -= terms[p] * terms[p]
            solve_transposed(matrix, plane, PLANE)
            plane_sq /= 1.0 + plane[1] * plane[1] + plane[2] * plane[2]
        for p in range(QUADRIC):
            quadric_sq -= terms[p] * terms[p]
        if round_number < ROUNDS - 1:
            solve_transposed(matrix, terms, QUADRIC)
            turn, steep = round_heights(local, raw, terms, steepest)
    plane_sq = max(plane_sq, 0.0) * scale * scale
    quadric_sq = max(quadric_sq, 0.0) * scale * scale
    best = plane = number * math.log(plane_sq + floor) + PLANE * math.log(every)
    if number > POINTS_PER_TERM * QUADRIC:
        best = min(best, number * math.log(quadric_sq + floor) + QUADRIC * math.log(every))
    bend = math.sqrt(12.0 * max(plane_sq - quadric_sq, 0.0))
    return best, plane, math.sqrt(plane_sq + floor), turn, bend, steep


@inlined(error_model='numpy')
def normalise(vector):
    """Scale a vector (3,) to unit length, in place; 0 stays 0."""
    length = max(math.sqrt(dot(vector, vector)), 1e-12)
    for j in range(3):
        vector[j] /= length


@inlined(error_model='numpy')
def dot(a, b):
    """Return the scalar product of vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
