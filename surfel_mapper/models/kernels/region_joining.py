# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Join patches to regions, the pair first that gains most; see models/joining.py.

A region is a chain of patches, named by the first. The means of the points of patch k are rows
starts[k] to starts[k + 1] - 1 of points (P, 3) and weights (P,). Interpreted, a fit of 200,000
points compares 10,000 pairs in 0.7 s, of which the height fields take a tenth.
"""

from heapq import heappop, heappush
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from surfel_mapper.kernels.compiling import inlined, kernel
from surfel_mapper.models.kernels.joining import gather, height_errors, TERMS

JOIN_COSINE = math.cos(math.radians(50.0))
"""Least cosine of the angle between the normals of joined regions at their means."""

CHART_COSINE = math.cos(math.radians(50.0))
"""Least cosine between the normal of a patch and the mean normal of the surface it joins."""

COPLANAR_COSINE, COPLANAR_GROWTH = math.cos(math.radians(6.0)), 1.25
"""Coplanar patches differ by less, and their common plane fits worse by less."""

REACH = 2.0
"""Only points within this many extents of the smaller patch are compared."""

MOST_ROWS = 600
"""Points that are compared, at most; larger patches are subsampled."""

POINTS_PER_TERM = 3.0
"""A height field needs more points."""

CHUNK = 64
"""Points with a common box: those of a chunk too far away are skipped together."""

LARGE_REGION = 100
"""
Patches of a region, beyond which only pairs with its latest patches are compared again at once,
others when their turn comes: 1,500 patches of rough ground take 2 s instead of 26.
"""

LAYER_SIGMAS = 3.0
"""Distance, in deviations of the noise, of a layer of a patch."""


class Regions(NamedTuple):
    """
    Tables of regions, a row for each patch; those of regions are at their first patch.

    Attributes
    ----------
    root : (K,) int64
        Region of each patch.
    after, last : (K,) int64
        Next patch of the same region, -1 for none; last patch of each region.
    patches, rows : (K,) int64
        Numbers of patches and of means.
    normal, mean : (K, 3) float64
        Sum of the normals of all points; a middle, m.
    extent : (K,) float64, m
        Half the width, about.
    patch_normal : (K, 3) float64
        Normal of each patch.
    patch_points, patch_sigma : (K,) float64
        Number of points of each patch, and noise across it, m.

    """

    root: npt.NDArray[np.int64]
    next_patch: npt.NDArray[np.int64]
    last: npt.NDArray[np.int64]
    patches: npt.NDArray[np.int64]
    rows: npt.NDArray[np.int64]
    normal: npt.NDArray[np.float64]
    mean: npt.NDArray[np.float64]
    extent: npt.NDArray[np.float64]
    patch_normal: npt.NDArray[np.float64]
    patch_points: npt.NDArray[np.float64]
    patch_sigma: npt.NDArray[np.float64]


@kernel(error_model='numpy')
def join_layers(pairs, points, weights, starts, regions):
    """
    Join patches that lie within the noise of a larger one, in front of or behind it.

    pairs    (R, 2) int64, patch and the larger one, in the order in which they are joined
    points, weights, starts  see above
    regions  Regions, in place; layers take the normal of the larger patch, and their distance
             from it is noise
    """
    for i in range(len(pairs)):
        small, large = pairs[i, 0], regions.root[pairs[i, 1]]
        if regions.root[small] != small:
            continue
        mean, normal = regions.mean[large], regions.patch_normal[large]
        squares = total = 0.0
        patch = small
        while patch >= 0:
            for row in range(starts[patch], starts[patch + 1]):
                away = 0.0
                for j in range(3):
                    away += (points[row, j] - mean[j]) * normal[j]
                squares += weights[row] * away * away
                total += weights[row]
            patch = regions.next_patch[patch]
        away = math.sqrt(squares / total)
        if away < LAYER_SIGMAS * regions.patch_sigma[large]:
            patch = small
            while patch >= 0:
                for j in range(3):
                    regions.patch_normal[patch, j] = normal[j]
                regions.patch_sigma[patch] = max(regions.patch_sigma[patch], away)
                patch = regions.next_patch[patch]
            for j in range(3):
                regions.normal[small, j] = normal[j] * regions.patch_points[small]
            join_pair(small, large, regions)


@inlined(error_model='numpy')
def join_pair(small, large, regions):
    """Join two regions; the large one keeps its name."""
    patch = small
    while patch >= 0:
        regions.root[patch] = large
        patch = regions.next_patch[patch]
    regions.next_patch[regions.last[large]] = small
    regions.last[large] = regions.last[small]
    regions.patches[large] += regions.patches[small]
    regions.rows[large] += regions.rows[small]
    gone, kept = length_of(regions.normal[small]), length_of(regions.normal[large])
    share, apart = gone / max(gone + kept, 1e-12), 0.0
    for j in range(3):
        delta = regions.mean[small, j] - regions.mean[large, j]
        apart += delta * delta
        regions.mean[large, j] += share * delta
        regions.normal[large, j] += regions.normal[small, j]
    extent = regions.extent[small]
    regions.extent[large] = max(regions.extent[large], extent, 0.5 * (math.sqrt(apart) + extent))


@kernel(error_model='numpy')
def join_smooth(edges, adjacent, points, weights, starts, boxes, floor, regions):
    """
    Join touching regions, those first that gain most.

    edges     (E, 2) int64, pairs of touching regions, the lesser first
    adjacent  first (K + 1,) int64 and regions (2 E,) int64 that touch each of them
    points, weights, starts  see above
    boxes     (C, 2, 3) float64, least and greatest coordinates of CHUNK points each
    floor     square of the residuals that are not resolved, m^2
    regions   Regions, in place
    """
    first, touching = adjacent
    state = points, weights, starts, boxes, floor
    scratch = np.empty((2, len(points)), np.int64), np.empty((4, 2 * len(points)))
    root, patches = regions.root, regions.patches
    heap = [(math.inf, np.int64(-1), np.int64(-1), np.int64(0), np.int64(0))]  # the last
    marked, joined = np.empty(len(root), np.int64), 0
    pairs, num = np.empty((len(edges) + len(root) + 1, 2), np.int64), len(edges)
    for k in range(len(root)):
        marked[k] = -1
    for i in range(len(edges)):
        pairs[i, 0], pairs[i, 1] = edges[i, 0], edges[i, 1]
    while True:
        for i in range(num):
            push(heap, pairs[i, 0], pairs[i, 1], state, scratch, regions)
        num = 0
        if not heap[0][0] < 0.0:
            break
        _, a, b, size_a, size_b = heappop(heap)
        if root[a] != a or root[b] != b:
            continue
        if patches[a] != size_a or patches[b] != size_b:
            known_a = patches[a] == size_a or size_a > LARGE_REGION
            if known_a and (patches[b] == size_b or size_b > LARGE_REGION):
                pairs[0, 0], pairs[0, 1], num = a, b, 1
            continue
        small, large = (a, b) if regions.rows[a] < regions.rows[b] else (b, a)
        patch = large if patches[large] <= LARGE_REGION else small  # a chain ends with the latest
        join_pair(small, large, regions)
        while patch >= 0:
            for n in range(first[patch], first[patch + 1]):
                neighbour = root[touching[n]]
                if neighbour != large and marked[neighbour] != joined:
                    marked[neighbour] = joined
                    pairs[num, 0], pairs[num, 1] = large, neighbour
                    num += 1
            patch = regions.next_patch[patch]
        joined += 1


@inlined(error_model='numpy')
def push(heap, a, b, state, scratch, regions):
    """Queue a pair that gains by being joined."""
    gain = gain_of(a, b, state, scratch, regions)
    if gain > 0.0:
        heappush(heap, (-gain, a, b, regions.patches[a], regions.patches[b]))


@inlined(error_model='numpy')
def gain_of(a, b, state, scratch, regions):
    """
    Return by how much a common height field of two regions is better than two; 0 for none.

    state    points, weights and starts, see above, boxes and floor of join_smooth
    scratch  (2, P) int64, (4, 2 P) float64
    """
    normals = np.empty((3, 3))
    for j in range(3):
        normals[0, j], normals[1, j] = regions.normal[a, j], regions.normal[b, j]
        normals[2, j] = regions.normal[a, j] + regions.normal[b, j]
    for i in range(3):
        normalise(normals[i])
    cosine = dot(normals[0], normals[1])
    if cosine < JOIN_COSINE:
        return 0.0
    for side in range(2):
        patch = b if side else a
        while patch >= 0:
            if dot(regions.patch_normal[patch], normals[2]) < CHART_COSINE:
                return 0.0
            patch = regions.next_patch[patch]
    small = a if regions.extent[a] < regions.extent[b] else b
    rows, points = scratch
    num_a = rows_near(a, small, state, regions, rows[0])
    num_b = rows_near(b, small, state, regions, rows[1])
    stride = 1 + (num_a + num_b) // MOST_ROWS
    zero = np.int64(0)  # a literal would be compiled for on its own
    middle = end = zero
    for side in range(2):
        middle = end
        number = num_b if side else num_a
        end = gather(rows[side], number, stride, state[0], state[1], points, middle)
    least = min(middle, end - middle)
    if least < 3:
        return 0.0
    rms_m = max(regions.patch_sigma[a], regions.patch_sigma[b])
    both_m = gain = cost = 0.0
    for turn in range(5):  # both, then each, then each with quartics, which only lower the gain
        if turn == 3 and not gain > 0.0:
            break
        low, high = middle if turn % 2 == 0 and turn else zero, middle if turn % 2 else end
        normal = normals[2] if turn == 0 else normals[(turn - 1) % 2]
        fit = heights(points, low, high, normal, turn == 0 or turn > 2, state[4])
        if turn == 0:
            cost, both_m = fit[0], fit[2]
        else:
            gain = (gain if turn % 2 == 0 else -cost) + fit[0]
            rms_m = max(rms_m, fit[2])
    if cosine > COPLANAR_COSINE and both_m < COPLANAR_GROWTH * rms_m:
        gain = max(gain, float(least))
    return gain


@kernel(error_model='numpy')
def rows_near(region, small, state, regions, rows):
    """
    List the rows of a region near a small one; return how many there are.

    state  of gain_of
    rows   (P,) int64, out
    """
    points, _, starts, boxes, _ = state
    limit = REACH * regions.extent[small]
    limit_sq = np.inf if region == small or regions.extent[region] < limit else limit * limit
    x, y, z = regions.mean[small, 0], regions.mean[small, 1], regions.mean[small, 2]
    patch, num = region, 0
    while patch >= 0:
        i, end = starts[patch], starts[patch + 1]
        while i < end:
            box, stop = boxes[i // CHUNK], min(i // CHUNK * CHUNK + CHUNK, end)
            dx = max(box[0, 0] - x, x - box[1, 0], 0.0)
            dy = max(box[0, 1] - y, y - box[1, 1], 0.0)
            dz = max(box[0, 2] - z, z - box[1, 2], 0.0)
            if dx * dx + dy * dy + dz * dz >= limit_sq:
                i = stop
            while i < stop:
                dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
                rows[num] = i
                num += dx * dx + dy * dy + dz * dz < limit_sq
                i += 1
        patch = regions.next_patch[patch]
    return num


@kernel(error_model='numpy', fastmath={'reassoc', 'nnan', 'nsz'})
def heights(points, low, high, normal, quartic, floor):
    """
    Fit height fields to columns low to high - 1 of points (4, n) over a plane.

    quartic says whether degree 4 is tried.

    Returns cost, cost of a plane, rms from a plane m, turn rad, and bend m of the quadric.
    """
    number = high - low
    tries = 3 if quartic and number > POINTS_PER_TERM * TERMS[2] else 2
    errors = np.empty(tries)
    turn = height_errors(points, low, high, normal, errors)
    best = plane = number * math.log(errors[0] + floor) + TERMS[0] * math.log(number)
    for d in range(1, tries):
        if number > POINTS_PER_TERM * TERMS[d]:
            cost = number * math.log(errors[d] + floor) + TERMS[d] * math.log(number)
            best = min(best, cost)
    bend = math.sqrt(12.0 * max(errors[0] - errors[1], 0.0))
    return best, plane, math.sqrt(errors[0] + floor), turn, bend


@kernel(error_model='numpy')
def describe_regions(names, state, regions, limits, normals, out):
    """
    Compute normals of regions, and how curved they are.

    names    (J,) int64, regions
    state    points, weights and starts, see above, boxes and floor of join_smooth
    limits   gain, turn and bend from which a region is curved; quartics are fitted only if the
             gain of a quadric alone is less, but its turn and bend are not
    normals  (J, 3) float64, out
    out      (J, 4) float64, out: gain of the best height field over a plane; turn, rad, and bend,
             m, of the quadric; rms from a plane, m
    """
    points, weights, _, _, floor = state
    rows, own = np.empty(len(points), np.int64), np.empty((4, len(points)))
    zero = np.int64(0)
    for k in range(len(names)):
        for j in range(3):
            normals[k, j] = regions.normal[names[k], j]
        normalise(normals[k])
        number = rows_near(names[k], names[k], state, regions, rows)
        end = gather(rows, number, 1 + number // MOST_ROWS, points, weights, own, zero)
        for quartic in range(2):
            best, plane, sigma, turn, bend = heights(
                own, zero, end, normals[k], quartic > 0, floor
            )
            out[k, 0], out[k, 1], out[k, 2], out[k, 3] = plane - best, turn, bend, sigma
            if not (turn > limits[1] and bend > limits[2] and plane - best <= limits[0]):
                break


@inlined(error_model='numpy')
def normalise(vector):
    """Scale a vector (3,) to unit length, in place; 0 stays 0."""
    length = max(math.sqrt(dot(vector, vector)), 1e-12)
    for j in range(3):
        vector[j] /= length


@inlined(error_model='numpy')
def length_of(vector):
    """Return the length of a vector (3,)."""
    return math.sqrt(dot(vector, vector))


@inlined(error_model='numpy')
def dot(a, b):
    """Return the scalar product of vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
