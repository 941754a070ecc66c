# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Classes of voxels, the extent of their surfels, and which changes of them are material.

All arrays have a row for each row of the map's slab.

Source: Duff et al. 2017 for the orthonormal basis.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel
from surfel_mapper.models.kernels.frames import LEAST_WIDTH, plane_of

NONE, YOUNG, FLAT, ROUGH = 0, 1, 2, 3
"""Class of a voxel: empty, too few points, flat surfel, not flat."""


@kernel(error_model='numpy')
def classify(chosen, count, normal, covariance, rules, kind, axes):
    """
    Classify voxels, and compute their tangential extent.

    chosen      (K,) int32, rows; each holds points
    count       (R,) int64
    normal      (R, 3) float64, nan if all points are equal
    covariance  (R, 6) float64, m^2
    rules       least points, largest variance along the normal m^2, voxel size m
    kind        (R,) uint8, out
    axes        (R, 2, 3) float64, out: half edges of a rectangle of equal variance, m

    With the normal known, the two tangential axes follow in closed form.
    """
    longest = rules[2] * math.sqrt(0.5)
    for row in chosen:
        x, y, z = normal[row, 0], normal[row, 1], normal[row, 2]
        if math.isnan(x):
            x, y, z = 0.0, 0.0, 1.0
        ux, uy, uz, vx, vy, vz = across(x, y, z)
        c = covariance[row]
        uu, vv = variance(c, ux, uy, uz), variance(c, vx, vy, vz)
        both = variance(c, ux + vx, uy + vy, uz + vz)
        half, off = 0.5 * (uu - vv), 0.5 * (both - uu - vv)
        radius = math.hypot(half, off)
        most, least = 0.5 * (uu + vv) + radius, max(0.5 * (uu + vv) - radius, 0.0)
        cosine, sine = 1.0, 0.0  # of the longer axis
        if radius > 0.0:
            larger = math.sqrt(0.5 + 0.5 * abs(half) / radius)
            smaller = 0.5 * off / (radius * larger)
            cosine, sine = (larger, smaller) if half >= 0.0 else (smaller, larger)
        if count[row] < rules[0]:
            kind[row] = YOUNG
        elif least > LEAST_WIDTH * most and variance(c, x, y, z) < rules[1]:
            kind[row] = FLAT
        else:
            kind[row] = ROUGH
        most = min(math.sqrt(3.0 * most), longest)
        least = min(math.sqrt(3.0 * least), longest)
        axes[row, 0, 0] = most * (cosine * ux + sine * vx)
        axes[row, 0, 1] = most * (cosine * uy + sine * vy)
        axes[row, 0, 2] = most * (cosine * uz + sine * vz)
        axes[row, 1, 0] = least * (cosine * vx - sine * ux)
        axes[row, 1, 1] = least * (cosine * vy - sine * uy)
        axes[row, 1, 2] = least * (cosine * vz - sine * uz)


@kernel(error_model='numpy')
def classify_sparse(rows, neighbours, own, surfels, rules, kind, normal):
    """
    Classify voxels that are not flat by the points of their surroundings.

    A voxel with few points, or points on a line, is flat if its points lie on a plane with those
    of its neighbours, of which none is flat by itself; it has the normal of that plane, on the
    side of most normals around. Beside flat voxels it may get a host instead, which does not blur
    curved surfaces.

    rows        (K,) int32; those that are flat by themselves keep class and normal
    neighbours  (R, A) int32, rows of the neighbours of each, -1 for none
    own         (R,) uint8, class by the points of the voxel alone
    surfels     count (R,), position (R, 3), normal (R, 3), covariance (R, 6) and eigenvalues
                (R, 3) of single voxels
    rules       of classify
    kind        (R,) uint8, normal (R, 3) float64, out
    """
    count, position, own_normal, covariance, eigenvalues = surfels
    sums, value, axes = np.empty(10), np.empty(3), np.empty((3, 3))
    for row in rows:
        kind[row] = own[row]
        for j in range(3):
            normal[row, j] = own_normal[row, j]
        if own[row] == FLAT or own[row] == NONE or not eigenvalues[row, 0] < rules[1]:
            continue
        origin, near = position[row], neighbours[row]
        sums[:] = 0.0
        add_moments(row, origin, count, position, covariance, sums)
        has_flat = False
        for h in range(len(near)):
            if near[h] >= 0:
                has_flat |= own[near[h]] == FLAT
        if has_flat:
            continue
        for h in range(len(near)):
            if near[h] >= 0:
                add_moments(near[h], origin, count, position, covariance, sums)
        if sums[0] < rules[0]:
            continue
        plane_of(sums, max(sums[0] - 1.0, 1.0), value, axes)
        n = axes[0]
        away = (n[0] * sums[1] + n[1] * sums[2] + n[2] * sums[3]) / sums[0]
        if not (value[0] < rules[1] and value[1] > LEAST_WIDTH * value[2]):
            continue
        if not away * away + variance(covariance[row], n[0], n[1], n[2]) < rules[1]:
            continue
        votes = 0.0
        for h in range(-1, len(near)):
            voxel = near[h] if h >= 0 else row
            if voxel >= 0 and not math.isnan(own_normal[voxel, 0]):
                m = own_normal[voxel]
                votes += count[voxel] * (m[0] * n[0] + m[1] * n[1] + m[2] * n[2])
        kind[row] = FLAT
        for j in range(3):
            normal[row, j] = -n[j] if votes < 0.0 else n[j]


@inlined(error_model='numpy')
def add_moments(row, origin, count, position, covariance, sums):
    """Add the points of a voxel to moments (10,) about an origin: n, x y z, xx xy xz yy yz zz."""
    n = np.float64(count[row])
    x, y, z = (
        position[row, 0] - origin[0],
        position[row, 1] - origin[1],
        position[row, 2] - origin[2],
    )
    c, less = covariance[row], max(n - 1.0, 0.0)
    sums[0] += n
    sums[1] += n * x
    sums[2] += n * y
    sums[3] += n * z
    sums[4] += n * x * x + less * c[0]
    sums[5] += n * x * y + less * c[1]
    sums[6] += n * x * z + less * c[2]
    sums[7] += n * y * y + less * c[3]
    sums[8] += n * y * z + less * c[4]
    sums[9] += n * z * z + less * c[5]


@inlined(error_model='numpy')
def across(x, y, z):
    """Return two unit vectors that are orthogonal to a third and to each other."""
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return 1.0 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y


@inlined(error_model='numpy')
def variance(c, x, y, z):
    """Return the variance along a direction; c: xx xy xz yy yz zz."""
    along = x * x * c[0] + y * y * c[3] + z * z * c[5]
    return along + 2.0 * (x * y * c[1] + x * z * c[2] + y * z * c[4])


@kernel(error_model='numpy')
def mark_material(rows, old_kind, count, position, normal, kind, reported, rules, material):
    """
    Mark the rows whose change since the last report is material, and update the report.

    rows      (K,) int32
    old_kind  (K,) uint8, their previous classes
    reported  count (R,), position (R, 3), normal (R, 3) as last reported, in place
    rules     square of the distance m^2, cosine, factor of the count
    material  (R,) bool, all False; out
    """
    reported_count, reported_position, reported_normal = reported
    for i in range(len(rows)):
        row = rows[i]
        away = cosine = 0.0
        for j in range(3):
            delta = position[row, j] - reported_position[row, j]
            away += delta * delta
            cosine += normal[row, j] * reported_normal[row, j]
        more, less = count[row], reported_count[row]
        if more < less:
            more, less = less, more
        if (
            old_kind[i] != kind[row]
            or away > rules[0]
            or cosine < rules[1]
            or more >= rules[2] * less
        ):
            material[row] = True
            reported_count[row] = count[row]
            for j in range(3):
                reported_position[row, j], reported_normal[row, j] = (
                    position[row, j],
                    normal[row, j],
                )
