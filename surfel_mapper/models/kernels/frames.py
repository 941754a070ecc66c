# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Moments of points, and the frames of clusters, facets and surfels from their eigenvectors."""

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel
from surfel_mapper.kernels.symmetric3 import decompose_one, write_frame

LEAST_WIDTH = 0.04
"""A surfel with a smaller ratio of the tangential variances is a line: no reliable normal."""


@kernel(error_model='numpy')
def eigen_frame(matrix, values, vectors):
    """
    Decompose a symmetric positive semidefinite matrix.

    matrix   (3, 3) float64
    values   (3,) float64, out: ascending, 0 below the rounding of the trace
    vectors  (3, 3) float64, out: unit vectors in rows; the component of largest magnitude positive
    """
    xx, xy, xz = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    yy, yz, zz = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    eigenvalues, normal = decompose_one(xx, xy, xz, yy, yz, zz)
    values[0], values[1], values[2] = eigenvalues
    write_frame((xx, xy, xz, yy, yz, zz), normal, vectors)


@kernel(error_model='numpy')
def eigen_frames(matrices, values, vectors):
    """Decompose matrices (K, 3, 3) into values (K, 3) and vectors (K, 3, 3) by eigen_frame."""
    for k in range(len(matrices)):
        eigen_frame(matrices[k], values[k], vectors[k])


@inlined(error_model='numpy')
def add_point(points, i, origin, weight, sums):
    """Add a point to moments (10,) about an origin: 1, x, y, z, xx, xy, xz, yy, yz, zz."""
    x, y, z = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
    u, v, w = weight * x, weight * y, weight * z
    sums[0] += weight
    sums[1] += u
    sums[2] += v
    sums[3] += w
    sums[4] += u * x
    sums[5] += u * y
    sums[6] += u * z
    sums[7] += v * y
    sums[8] += v * z
    sums[9] += w * z


@inlined(error_model='numpy')
def scatter_of(sums, divisor, scatter):
    """Compute the scatter (3, 3) about the mean of moments (10,), by a divisor."""
    k = 4
    for a in range(3):
        for b in range(a, 3):
            moment = sums[k] - sums[1 + a] * sums[1 + b] / sums[0]
            moment = max(moment, 0.0) if a == b else moment
            scatter[a, b] = scatter[b, a] = moment / divisor
            k += 1


@kernel(error_model='numpy')
def plane_of(sums, divisor, value, axes):
    """
    Compute the eigenvalues (3,) of the covariance of moments, ascending, and axes (3, 3) as rows.

    sums     (10,) float64: number, sums of x y z, xx xy xz yy yz zz
    divisor  of the sums of squared deviations: the number, or one less
    value    (3,), axes (3, 3) float64, out
    """
    scatter = np.empty((3, 3))
    scatter_of(sums, divisor, scatter)
    eigen_frame(scatter, value, axes)


@kernel(error_model='numpy')
def group_scatters(points, weights, starts, totals, means, scatters):
    """
    Sum the moments of groups of points, each about its first point, and move them to the mean.

    points    (N, 3) float64; group k has the rows starts[k] to starts[k + 1] - 1
    weights   (N,) float64
    starts    (K + 1,) int64
    totals    (K,) float64, out: weights
    means     (K, 3) float64, out: 0 without weight
    scatters  (K, 3, 3) float64, out: weighted sums of outer products of deviations
    """
    sums = np.empty(10)
    for k in range(len(starts) - 1):
        sums[:] = 0.0
        for i in range(starts[k], starts[k + 1]):
            add_point(points, i, points[starts[k]], weights[i], sums)
        totals[k], means[k], scatters[k] = sums[0], 0.0, 0.0
        if sums[0] > 0.0:
            for a in range(3):
                means[k, a] = points[starts[k], a] + sums[1 + a] / sums[0]
            scatter_of(sums, 1.0, scatters[k])


@kernel(error_model='numpy')
def member_moments(points, group, counts, means, covariances):
    """
    Compute the moments of groups of points in any order.

    points       (N, 3) float64
    group        (N,) int64, group of each
    counts       (G,) int64, points of each group
    means        (G, 3) float64, zeros; out
    covariances  (G, 3, 3) float64, zeros; out: 0 for single points
    """
    for i in range(len(points)):
        for a in range(3):
            means[group[i], a] += points[i, a]
    for g in range(len(counts)):
        for a in range(3):
            means[g, a] /= counts[g]
    for i in range(len(points)):
        g = group[i]
        for a in range(3):
            for b in range(3):
                product = (points[i, a] - means[g, a]) * (points[i, b] - means[g, b])
                covariances[g, a, b] += product
    for g in range(len(counts)):
        for a in range(3):
            for b in range(3):
                covariances[g, a, b] /= max(counts[g] - 1, 1)


@kernel(error_model='numpy')
def split_members(points, group, means, axes, number):
    """
    Move the points of groups beyond planes through their means to other groups, in place.

    points  (N, 3), group (N,) int64; means, axes (G, 3) float64: normals of the planes, 0 for none
    number  (G,) int64, the other groups
    """
    for i in range(len(points)):
        g, along = group[i], 0.0
        for a in range(3):
            along += (points[i, a] - means[g, a]) * axes[g, a]
        if along > 0.0:
            group[i] = number[g]
