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

One module: both kinds of growth share the test of a point against a patch.

Source: Besl and Jain 1988 (region growing from seeds).
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.models.kernels.frames import LEAST_WIDTH, plane_of

SLOTS = 4
"""Candidates of a voxel, at most: three faces meet in a corner."""

LEAST_SHARE = 0.25
"""Share of the points of a voxel on a patch for it to be grown from."""

LEAST_FREE_SHARE = 1.0 / 3.0
"""Share of the free points of a voxel on a facet for it to be grown from."""

LEAST_POINTS = 6
"""Points that determine the plane of a voxel, at least."""

FREE = -1
"""Owner of a point on no patch."""

ROUNDS = 3
"""A facet is grown this many times, each time from the plane of the previous result."""

LARGE_REGION = 100
"""
Voxels of a region that is no facet, from which on none of them is a seed again: otherwise a rail
of n voxels is grown n times, and 160 m of it in voxels of 4 cm take 2 s.
"""


@njit(cache=True, nogil=True, error_model='numpy')
def plane_distance(points, i, plane):
    """Return the distance of a point from a plane, m."""
    return abs(
        points[i, 0] * plane[0] + points[i, 1] * plane[1] + points[i, 2] * plane[2] + plane[3]
    )


@njit(cache=True, nogil=True, error_model='numpy')
def sample_distances(points, starts, label, tangent, stride, patch, distance):
    """
    Sample distances of points from their patches; return how many there are.

    label    (V,) int32, patch of each voxel, -1 for none
    tangent  (V, 4) float64, plane of the patch there
    stride   every stride-th point of patches is used
    patch    (P,) int32, distance (P,) float64, out
    """
    num = skip = 0
    for v in range(len(label)):
        if label[v] < 0:
            continue
        i, end = starts[v] + skip, starts[v + 1]
        while i < end:
            patch[num], distance[num] = label[v], plane_distance(points, i, tangent[v])
            num += 1
            i += stride
        skip = i - end
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def classify_free(points, starts, owner, thickness, count, flat, mean, normal):
    """
    Fit a plane to the free points of every voxel.

    owner      (P,) int32
    thickness  m, 6 sigma, of a flat voxel
    count      (V,) int64, out: free points
    flat       (V,) bool, out
    mean       (V, 3), normal (V, 3) float64, out for voxels with free points, flat voxels
    """
    scatter, value, axes = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    sums = np.empty(10)
    for v in range(len(starts) - 1):
        sums[:] = 0.0
        low, high = starts[v], starts[v + 1]
        for i in range(low, high):
            if owner[i] == FREE:
                add_point(points, i, points[low], sums)
        count[v], flat[v] = np.int64(sums[0]), False
        if count[v] > 0:
            for j in range(3):
                mean[v, j] = points[low, j] + sums[1 + j] / sums[0]
        if count[v] >= LEAST_POINTS:
            plane_of(sums, sums[0], scatter, value, axes)
            if 36.0 * value[0] < thickness**2 and value[1] > LEAST_WIDTH * value[2]:
                flat[v] = True
                normal[v] = axes[0]


@njit(cache=True, nogil=True, error_model='numpy')
def add_point(points, i, origin, sums):
    """Add a point to moments (10,) about an origin: 1, x, y, z, xx, xy, xz, yy, yz, zz."""
    x, y, z = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
    sums[0] += 1.0
    sums[1] += x
    sums[2] += y
    sums[3] += z
    sums[4] += x * x
    sums[5] += x * y
    sums[6] += x * z
    sums[7] += y * y
    sums[8] += y * z
    sums[9] += z * z


@njit(cache=True, nogil=True, error_model='numpy')
def grow_patches(
    points, starts, adjacent, label, tangent, tolerance, free, candidate, candidate_plane
):
    """
    Find the candidates of voxels by growing all patches together, breadth first.

    adjacent         starts and rows of neighbour_table
    label            (V,) int32, patch of each voxel, -1 for none
    tangent          (V, 4) float64, plane of the patch there
    tolerance        (K,) float64, m, of each patch
    free             flat (V,), normal (V, 3) of voxels without a patch; least cosine of the
                     normals of a flat voxel and a patch
    candidate        (V, SLOTS) int32, all -1; out
    candidate_plane  (V, SLOTS, 4) float64, out
    """
    first, rows = adjacent
    flat, normal, least_cosine = free
    queue = np.empty((len(label) * (SLOTS + 1), 2), np.int32)
    plane, head, tail = np.empty(4), 0, 0
    for v in range(len(label)):
        if label[v] >= 0:
            queue[tail, 0], queue[tail, 1] = v, -1
            tail += 1
    while head < tail:
        u, slot = queue[head, 0], queue[head, 1]
        head += 1
        patch = label[u] if slot < 0 else candidate[u, slot]
        plane[:] = tangent[u] if slot < 0 else candidate_plane[u, slot]
        for k in range(first[u], first[u + 1]):
            v = rows[k]
            place = -1 if label[v] == patch else slot_of(candidate[v], patch)
            if place < 0:
                continue
            num = 0
            for i in range(starts[v], starts[v + 1]):
                num += plane_distance(points, i, plane) < tolerance[patch]
            if num == 0:
                continue
            if label[v] < 0 and flat[v] and abs_cosine(normal[v], plane) < least_cosine:
                continue
            candidate[v, place], candidate_plane[v, place] = patch, plane
            if label[v] < 0 and num >= LEAST_SHARE * (starts[v + 1] - starts[v]):
                queue[tail, 0], queue[tail, 1] = v, place
                tail += 1


@njit(cache=True, nogil=True)
def slot_of(candidates, patch):
    """Return the free slot for a patch; -1 if it is a candidate already or all are taken."""
    for slot in range(SLOTS):
        if candidates[slot] == patch:
            return -1
        if candidates[slot] < 0:
            return slot
    return -1


@njit(cache=True, nogil=True, error_model='numpy')
def abs_cosine(normal, plane):
    """Return the cosine of the angle between two planes."""
    return abs(normal[0] * plane[0] + normal[1] * plane[1] + normal[2] * plane[2])


@njit(cache=True, nogil=True, error_model='numpy')
def assign_points(points, starts, label, tangent, tolerance, candidate, candidate_plane, owner):
    """
    Assign each point to the patch of its voxel, or to the nearest candidate if that fits better.

    label ... candidate_plane  of grow_patches
    owner                      (P,) int32, out: patch, FREE for none
    """
    for v in range(len(label)):
        for i in range(starts[v], starts[v + 1]):
            own, best = label[v], np.inf
            if own >= 0:
                best = plane_distance(points, i, tangent[v])
                if best <= tolerance[own]:
                    best = -1.0
            for slot in range(SLOTS):
                patch = candidate[v, slot]
                if patch < 0:
                    break
                away = plane_distance(points, i, candidate_plane[v, slot])
                if away < tolerance[patch] and away < best:
                    own, best = patch, away
            owner[i] = own


@njit(cache=True, nogil=True, error_model='numpy')
def find_facets(points, starts, adjacent, free, rules, owner, planes, num_planes):
    """
    Grow facets from flat voxels of free points, the densest first; return the number of planes.

    adjacent    of grow_patches
    free        count (V,), flat (V,), mean (V, 3), normal (V, 3) of classify_free; count and flat
                are consumed
    rules       tolerance m; least voxels; least points; least cosine of the normals of a flat
                voxel and the facet; least width, m
    owner       (P,) int32, in place
    planes      (K, 4) float64, of patches and facets; facets are appended
    num_planes  planes that exist
    """
    count, flat, mean, normal = free
    tolerance, least_voxels, least_points, _, least_width = rules
    visited, region = np.zeros(len(count), np.int32), np.empty(len(count), np.int64)
    sums, plane, start = np.empty(10), np.empty(4), np.empty(3)
    scatter, value, axes = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    rejected, mark = np.zeros(len(count), np.bool_), 0
    for seed in np.argsort(-count, kind='mergesort'):
        if num_planes == len(planes):
            break
        if rejected[seed] or not flat[seed] or count[seed] < LEAST_POINTS:
            continue
        start[:] = normal[seed]
        set_plane(start, mean[seed], plane)
        size = 0
        for turn in range(ROUNDS):
            mark += 1
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
            if not is_small:
                plane_of(sums, sums[0], scatter, value, axes)
                is_small = math.sqrt(12.0 * max(value[1], 0.0)) < least_width
            if is_small:
                if size > LARGE_REGION:
                    rejected[region[:size]] = True
                size = 0
                break
            for j in range(3):
                start[j] = mean[seed, j] + sums[1 + j] / sums[0]
            set_plane(axes[0], start, plane)
        flat[seed] = False
        if size == 0:
            continue
        planes[num_planes] = plane
        for k in range(size):
            u = region[k]
            flat[u] = False
            for i in range(starts[u], starts[u + 1]):
                if owner[i] == FREE and plane_distance(points, i, plane) < tolerance:
                    owner[i] = num_planes
                    count[u] -= 1
        num_planes += 1
    return num_planes


@njit(cache=True, nogil=True, error_model='numpy')
def set_plane(normal, point, plane):
    """Set a plane through a point."""
    plane[3] = 0.0
    for j in range(3):
        plane[j] = normal[j]
        plane[3] -= normal[j] * point[j]


@njit(cache=True, nogil=True, error_model='numpy')
def grow_facet(
    points, starts, adjacent, free, rules, owner, seed, adapts, plane, sums, visited, region, mark
):
    """
    Grow one facet from a voxel; return the number of its voxels.

    adjacent ... owner  of find_facets
    adapts            whether the plane is refitted whenever the points have doubled
    plane             (4,) float64, in place
    sums              (10,) float64, out: moments of the points, about the mean of the seed
    visited           (V,) int32: mark for voxels that were tested
    region            (V,) int64, out
    """
    first, rows = adjacent
    count, flat, mean, normal = free
    tolerance, _, _, least_cosine, _ = rules
    centre = np.empty(3)
    scatter, value, axes = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    sums[:] = 0.0
    region[0], visited[seed] = seed, mark
    size, head, refit = 1, 0, 20.0
    while head < size:
        u = region[head]
        head += 1
        for i in range(starts[u], starts[u + 1]):
            if owner[i] == FREE and plane_distance(points, i, plane) < tolerance:
                add_point(points, i, mean[seed], sums)
        if adapts and sums[0] >= refit:
            refit = 2.0 * sums[0]
            plane_of(sums, sums[0], scatter, value, axes)
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
