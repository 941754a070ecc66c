# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Region growing over the voxels of a cloud, from patches and from single voxels.

Patches grow over touching voxels: a voxel becomes a candidate of a patch if some of its points lie
on the patch, extended as a plane beyond its boundary, and is grown from if a quarter of them do.
Then each point takes the nearest of the candidates of its voxel, so a voxel at an edge is divided
between its faces. Facets too small for recursive bisection are grown from the densest flat voxels
of the free points that are left.

Points, starts and adjacent (the neighbours) are those of voxel_points.py. A plane is four
numbers: unit normal and offset, with distance normal . p + offset.

Source: Besl and Jain 1988 (region growing from seeds).
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel
from surfel_mapper.models.kernels.frames import add_point, LEAST_WIDTH, plane_of

SLOTS = 4
"""Candidates of a voxel, at most: three faces meet in a corner."""

LEAST_SHARE = 0.25
"""Share of the points of a voxel on a patch for it to be grown from."""

LEAST_FREE_SHARE = 1.0 / 3.0
"""Share of the free points of a voxel on a facet for it to be grown from."""

FREE = -1
"""Owner of a point on no patch."""

ROUNDS = 3
"""A facet is grown this many times, each time from the plane of the previous result."""

BESIDE = 3.0
"""
Points are beside a patch up to this number of tolerances. In scatter they are twice as many as the
points on it.
"""

LARGE_REGION = 100
"""
Voxels of a region that is no facet, from which on none of them is a seed again: otherwise a rail
of n voxels is grown n times, and 160 m of it in voxels of 4 cm take 2 s.
"""


@inlined(error_model='numpy')
def plane_distance(points, i, plane):
    """Return the distance of a point from a plane, m."""
    return abs(
        points[i, 0] * plane[0] + points[i, 1] * plane[1] + points[i, 2] * plane[2] + plane[3]
    )


@kernel(error_model='numpy')
def describe_free(points, starts, owner, rules, count, flat, mean, normal):
    """
    Describe the free points of each voxel.

    owner   (P,) int32
    rules   least number of points; squared thickness, 6 sigma, of flat voxels, m^2
    count   (V,) int64, zeros; out: free points
    flat    (V,) bool, zeros; out: whether there are enough, and are flat
    mean    (V, 3) float64, zeros, m; out for voxels with enough
    normal  (V, 3) float64, zeros; out for voxels with enough
    """
    sums, value, axes = np.empty(10), np.empty(3), np.empty((3, 3))
    for v in range(len(count)):
        for i in range(starts[v], starts[v + 1]):
            count[v] += owner[i] == FREE
        if count[v] < rules[0]:
            continue
        sums[:] = 0.0
        for i in range(starts[v], starts[v + 1]):
            if owner[i] == FREE:
                add_point(points, i, points[starts[v]], 1.0, sums)
        plane_of(sums, sums[0], value, axes)
        flat[v] = 36.0 * value[0] < rules[1] and value[1] > LEAST_WIDTH * value[2]
        for j in range(3):
            mean[v, j] = points[starts[v], j] + sums[1 + j] / sums[0]
            normal[v, j] = axes[0, j]


@kernel(error_model='numpy')
def fit_layers(points, starts, widths, rounds, planes):
    """
    Fit the plane of each group again to its points near the plane, several times.

    points, starts  (N, 3) float64, (K + 1,) int64: group k has rows from starts[k] on
    widths          (2, K) float64, m: distance of near points in the first round, and at least
    planes          (K, 4) float64, in place
    """
    sums, value, axes, centre_of_voxel = np.empty(10), np.empty(3), np.empty((3, 3)), np.empty(3)
    for k in range(len(planes)):
        width, start = widths[0, k], starts[k]
        for _ in range(rounds):
            sums[:] = 0.0
            for i in range(start, starts[k + 1]):
                if plane_distance(points, i, planes[k]) < width:
                    add_point(points, i, points[start], 1.0, sums)
            if sums[0] == 0.0:
                break
            plane_of(sums, sums[0], value, axes)
            for j in range(3):
                centre_of_voxel[j] = points[start, j] + sums[1 + j] / sums[0]
            set_plane(axes[0], centre_of_voxel, planes[k])
            width = max(0.7 * width, widths[1, k])


@kernel(error_model='numpy')
def grow_patches(points, starts, adjacent, label, tangent, tolerance, free, candidate):
    """
    Find the candidates of voxels by growing all patches together, breadth first.

    adjacent   starts and rows of neighbour_table
    label      (V,) int32, patch of each voxel, -1 for none
    tangent    (V, 4) float64, plane of the patch there
    tolerance  (K,) float64, m, of each patch
    free       flat (V,), normal (V, 3) of voxels without a patch; least cosine of the normals of a
               flat voxel and a patch
    candidate  (V, SLOTS) int32, all -1; out: voxels from which patches were grown
    """
    first, rows = adjacent
    flat, normal, least_cosine = free
    queue = np.empty((len(label) * (SLOTS + 1), 2), np.int32)
    head, tail = 0, 0
    for v in range(len(label)):
        if label[v] >= 0:
            queue[tail, 0] = queue[tail, 1] = v
            tail += 1
    while head < tail:
        u, source = queue[head, 0], queue[head, 1]
        head += 1
        patch, plane = label[source], tangent[source]
        for k in range(first[u], first[u + 1]):
            v = rows[k]
            slot = -1 if label[v] == patch else slot_of(candidate[v], label, patch)
            if slot < 0:
                continue
            num = 0
            for i in range(starts[v], starts[v + 1]):
                num += plane_distance(points, i, plane) < tolerance[patch]
            if num == 0:
                continue
            if label[v] < 0 and flat[v] and abs_cosine(normal[v], plane) < least_cosine:
                continue
            candidate[v, slot] = source
            if label[v] < 0 and num >= LEAST_SHARE * (starts[v + 1] - starts[v]):
                queue[tail, 0], queue[tail, 1] = v, source
                tail += 1


@inlined(error_model='numpy')
def slot_of(candidates, label, patch):
    """Return the free slot for a patch; -1 if it is a candidate already or all are taken."""
    for slot in range(SLOTS):
        if candidates[slot] < 0:
            return slot
        if label[candidates[slot]] == patch:
            return -1
    return -1


@inlined(error_model='numpy')
def abs_cosine(normal, plane):
    """Return the cosine of the angle between two planes."""
    return abs(normal[0] * plane[0] + normal[1] * plane[1] + normal[2] * plane[2])


@kernel(error_model='numpy')
def assign_points(points, starts, label, tangent, tolerance, candidate, owner):
    """
    Assign each point to the patch of its voxel, or to the nearest candidate if that fits better.

    label ... candidate  of grow_patches
    owner                (P,) int32, out: patch, FREE for none
    """
    for v in range(len(label)):
        for i in range(starts[v], starts[v + 1]):
            own, best = label[v], np.inf
            if own >= 0:
                best = plane_distance(points, i, tangent[v])
                if best <= tolerance[own]:
                    best = -1.0
            for slot in range(SLOTS):
                source = candidate[v, slot]
                if source < 0:
                    break
                away = plane_distance(points, i, tangent[source])
                if away < tolerance[label[source]] and away < best:
                    own, best = label[source], away
            owner[i] = own


@kernel(error_model='numpy')
def find_facets(points, starts, adjacent, free, order, rules, owner, planes, num_planes):
    """
    Grow facets from flat voxels of free points, the densest first; return the number of planes.

    adjacent    of grow_patches
    free        count (V,) int64, flat (V,) bool, mean (V, 3), normal (V, 3) float64 of the free
                points of each voxel; count and flat are consumed
    order       (S,) int64, voxels in the order in which they are seeds
    rules       tolerance m; least voxels; least points; least cosine of the normals of a flat
                voxel and the facet; least width, m; free points beside by points on it, at most
    owner       (P,) int32, in place
    planes      (K, 4) float64, of patches and facets; facets are appended
    num_planes  planes that exist
    """
    count, flat, mean, normal = free
    tolerance, least_voxels, least_points, _, least_width, most_beside = rules
    marks = np.zeros((3, len(count)), np.int64)
    visited, region, rejected = marks[0], marks[1], marks[2]
    plane, start, sums = np.empty(4), np.empty(3), np.empty(11)
    value, axes, mark = np.empty(3), np.empty((3, 3)), 0
    for seed in order:
        if num_planes == len(planes):
            break
        if rejected[seed] or not flat[seed]:
            continue
        for j in range(3):
            start[j] = mean[seed, j]
            axes[0, j] = normal[seed, j]
        size = 0
        for turn in range(ROUNDS):
            mark += 1
            set_plane(axes[0], start, plane)
            size = grow_facet(
                points,
                starts,
                adjacent,
                free,
                rules,
                owner,
                seed,
                turn == 0,
                plane,
                sums,
                visited,
                region,
                mark,
            )
            is_small = sums[0] < least_points or size < least_voxels
            is_small |= sums[10] > most_beside * sums[0]
            if not is_small:
                plane_of(sums, sums[0], value, axes)
                is_small = math.sqrt(12.0 * max(value[1], 0.0)) < least_width
            if is_small:
                if size > LARGE_REGION:
                    for k in range(size):
                        rejected[region[k]] = 1
                size = 0
                break
            for j in range(3):
                start[j] = mean[seed, j] + sums[1 + j] / sums[0]
        flat[seed] = False
        if size == 0:
            continue
        set_plane(axes[0], start, plane)
        for j in range(4):
            planes[num_planes, j] = plane[j]
        for k in range(size):
            u = region[k]
            flat[u] = False
            for i in range(starts[u], starts[u + 1]):
                if owner[i] == FREE and plane_distance(points, i, plane) < tolerance:
                    owner[i] = num_planes
                    count[u] -= 1
        num_planes += 1
    return num_planes


@inlined(error_model='numpy')
def set_plane(normal, point, plane):
    """Set a plane through a point."""
    plane[3] = 0.0
    for j in range(3):
        plane[j] = normal[j]
        plane[3] -= normal[j] * point[j]


@inlined(error_model='numpy')
def grow_facet(
    points, starts, adjacent, free, rules, owner, seed, adapts, plane, sums, visited, region, mark
):
    """
    Grow one facet from a voxel; return the number of its voxels.

    adjacent ... owner  of find_facets
    adapts            whether the plane is refitted whenever the points have doubled
    plane             (4,) float64, in place
    sums              (11,) float64, out: moments of the points, about the mean of the seed; number
                      of those beside
    visited           (V,) int64: mark for voxels that were tested
    region            (V,) int64, out
    """
    first, rows = adjacent
    count, flat, mean, normal = free
    tolerance, _, _, least_cosine, _, _ = rules
    value, axes, centre = np.empty(3), np.empty((3, 3)), np.empty(3)
    sums[:] = 0.0
    region[0], visited[seed] = seed, mark
    size, head, refit = 1, 0, 20.0
    while head < size:
        u = region[head]
        head += 1
        for i in range(starts[u], starts[u + 1]):
            if owner[i] != FREE:
                continue
            away = plane_distance(points, i, plane)
            if away < tolerance:
                add_point(points, i, mean[seed], 1.0, sums)
            sums[10] += tolerance <= away < BESIDE * tolerance
        if adapts and sums[0] >= refit:
            refit = 2.0 * sums[0]
            plane_of(sums, sums[0], value, axes)
            if value[1] > 0.5 * LEAST_WIDTH * value[2] and (
                abs_cosine(normal[seed], axes[0]) > least_cosine
            ):
                for j in range(3):
                    centre[j] = mean[seed, j] + sums[1 + j] / sums[0]
                set_plane(axes[0], centre, plane)
        for k in range(first[u], first[u + 1]):
            v = rows[k]
            if visited[v] == mark or count[v] == 0:
                continue
            visited[v] = mark
            if flat[v] and abs_cosine(normal[v], plane) < least_cosine:
                continue
            num = 0
            for i in range(starts[v], starts[v + 1]):
                num += owner[i] == FREE and plane_distance(points, i, plane) < tolerance
            if num >= LEAST_FREE_SHARE * count[v]:
                region[size] = v
                size += 1
    return size


@kernel(error_model='numpy')
def count_beside(points, starts, adjacent, table, normals, tolerance, width, counts):
    """
    Count the points on each patch and on both sides of it, whichever patch owns them.

    adjacent   of grow_patches
    table      owners (M,) int32, means (M, 3) and first (V + 1,) of owner_means
    normals    (K, 3) float64, of the patches
    tolerance  (K,) float64, m
    width      distance of points from a mean along the patch, at most, m
    counts     (K, 3) int64, zeros; out: points on the patch, below, above
    """
    first, rows = adjacent
    owners, means, begin = table
    for v in range(len(starts) - 1):
        for k in range(begin[v], begin[v + 1]):
            patch = owners[k]
            if patch < 0:
                continue
            for j in range(first[v] - 1, first[v + 1]):
                u = v if j < first[v] else rows[j]
                for i in range(starts[u], starts[u + 1]):
                    x = points[i, 0] - means[k, 0]
                    y = points[i, 1] - means[k, 1]
                    z = points[i, 2] - means[k, 2]
                    height = x * normals[patch, 0] + y * normals[patch, 1] + z * normals[patch, 2]
                    away = abs(height)
                    if x * x + y * y + z * z - away * away > width * width:
                        continue
                    if away <= tolerance[patch]:
                        counts[patch, 0] += 1
                    elif away <= BESIDE * tolerance[patch]:
                        counts[patch, 1 + int(height > 0.0)] += 1
