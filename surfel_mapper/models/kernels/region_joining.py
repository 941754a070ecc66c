# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Join patches to regions, the pair first that gains most; see models/joining.py.

A region is a chain of patches, named by the first. The means of the points of patch k are rows
starts[k] to starts[k + 1] - 1 of points (P, 3) and weights (P,). Interpreted, a fit of 200,000
points compares 10,000 pairs in 0.7 s, of which the height fields take a tenth.

One module: joining and description of regions share the fits of height fields.
"""

from heapq import heappop, heappush
import math
from typing import NamedTuple

from numba import njit
import numpy as np
import numpy.typing as npt

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
    after: npt.NDArray[np.int64]
    last: npt.NDArray[np.int64]
    patches: npt.NDArray[np.int64]
    rows: npt.NDArray[np.int64]
    normal: npt.NDArray[np.float64]
    mean: npt.NDArray[np.float64]
    extent: npt.NDArray[np.float64]
    patch_normal: npt.NDArray[np.float64]
    patch_points: npt.NDArray[np.float64]
    patch_sigma: npt.NDArray[np.float64]


@njit(cache=True, nogil=True, error_model='numpy')
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
        part = small
        while part >= 0:
            for row in range(starts[part], starts[part + 1]):
                away = 0.0
                for j in range(3):
                    away += (points[row, j] - mean[j]) * normal[j]
                squares += weights[row] * away * away
                total += weights[row]
            part = regions.after[part]
        away = math.sqrt(squares / total)
        if away < LAYER_SIGMAS * regions.patch_sigma[large]:
            part = small
            while part >= 0:
                regions.patch_normal[part] = normal
                regions.patch_sigma[part] = max(regions.patch_sigma[part], away)
                part = regions.after[part]
            for j in range(3):
                regions.normal[small, j] = normal[j] * regions.patch_points[small]
            join_pair(small, large, regions)


@njit(cache=True, nogil=True, error_model='numpy')
def join_pair(small, large, regions):
    """Join two regions; the large one keeps its name."""
    part = small
    while part >= 0:
        regions.root[part] = large
        part = regions.after[part]
    regions.after[regions.last[large]] = small
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


@njit(cache=True, nogil=True, error_model='numpy')
def join_smooth(edges, adjacent, points, weights, starts, floor, regions):
    """
    Join touching regions, those first that gain most.

    edges     (E, 2) int64, pairs of touching regions, the lesser first
    adjacent  first (K + 1,) int64 and regions (2 E,) int64 that touch each of them
    points, weights, starts  see above
    floor     square of the residuals that are not resolved, m^2
    regions   Regions, in place
    """
    first, others = adjacent
    state = points, weights, starts, chunk_boxes(points), floor
    root, patches = regions.root, regions.patches
    heap = [(math.inf, np.int64(-1), np.int64(-1), np.int64(0), np.int64(0))]  # the last
    marked = np.full(len(root), -1, np.int64)
    for i in range(len(edges)):
        push(heap, edges[i, 0], edges[i, 1], state, regions)
    joined = 0
    while heap[0][0] < 0.0:
        _, a, b, size_a, size_b = heappop(heap)
        if root[a] != a or root[b] != b:
            continue
        if patches[a] != size_a or patches[b] != size_b:
            known_a = patches[a] == size_a or size_a > LARGE_REGION
            if known_a and (patches[b] == size_b or size_b > LARGE_REGION):
                push(heap, a, b, state, regions)
            continue
        small, large = (a, b) if regions.rows[a] < regions.rows[b] else (b, a)
        part = large if patches[large] <= LARGE_REGION else small  # a chain ends with the latest
        join_pair(small, large, regions)
        while part >= 0:
            for n in range(first[part], first[part + 1]):
                other = root[others[n]]
                if other != large and marked[other] != joined:
                    marked[other] = joined
                    push(heap, large, other, state, regions)
            part = regions.after[part]
        joined += 1


@njit(cache=True, nogil=True, error_model='numpy')
def push(heap, a, b, state, regions):
    """Queue a pair that gains by being joined."""
    gain = gain_of(a, b, state, regions)
    if gain > 0.0:
        heappush(heap, (-gain, a, b, regions.patches[a], regions.patches[b]))


@njit(cache=True, nogil=True, error_model='numpy')
def gain_of(a, b, state, regions):
    """
    Return by how much a common height field of two regions is better than two; 0 for none.

    state  points, weights and starts, see above, boxes of chunk_boxes, floor of join_smooth
    """
    total_a, total_b = regions.normal[a], regions.normal[b]
    lengths = max(length_of(total_a), 1e-12) * max(length_of(total_b), 1e-12)
    cosine = dot(total_a, total_b) / lengths  # before any copy: most pairs end here
    if cosine < JOIN_COSINE:
        return 0.0
    normal_a, normal_b, mean = unit(total_a), unit(total_b), unit(total_a + total_b)
    for region in (a, b):
        part = region
        while part >= 0:
            if dot(regions.patch_normal[part], mean) < CHART_COSINE:
                return 0.0
            part = regions.after[part]
    small = a if regions.extent[a] < regions.extent[b] else b
    rows_a, rows_b = rows_near(a, small, state, regions), rows_near(b, small, state, regions)
    stride = 1 + (len(rows_a) + len(rows_b)) // MOST_ROWS
    rows_a, rows_b = rows_a[::stride], rows_b[::stride]
    least = min(len(rows_a), len(rows_b))
    if least < 3:
        return 0.0
    points = np.empty((4, len(rows_a) + len(rows_b)))
    gather(rows_a, state[0], state[1], points[:, : len(rows_a)])
    gather(rows_b, state[0], state[1], points[:, len(rows_a) :])
    points_a, points_b = points[:, : len(rows_a)].copy(), points[:, len(rows_a) :].copy()
    floor = state[4]
    both = heights(points, mean, True, floor)
    heights_a = heights(points_a, normal_a, False, floor)
    heights_b = heights(points_b, normal_b, False, floor)
    gain = heights_a[0] + heights_b[0] - both[0]
    if gain > 0.0:  # quartics only lower it
        heights_a = heights(points_a, normal_a, True, floor)
        heights_b = heights(points_b, normal_b, True, floor)
        gain = heights_a[0] + heights_b[0] - both[0]
    if cosine > COPLANAR_COSINE:
        sigma = max(regions.patch_sigma[a], regions.patch_sigma[b])
        if both[2] < COPLANAR_GROWTH * max(heights_a[2], heights_b[2], sigma):
            gain = max(gain, float(least))
    return gain


@njit(cache=True, nogil=True, error_model='numpy')
def chunk_boxes(points):
    """Return least and greatest coordinates of CHUNK points each, (C, 2, 3) float64."""
    boxes = np.empty(((len(points) + CHUNK - 1) // CHUNK, 2, 3))
    boxes[:, 0], boxes[:, 1] = np.inf, -np.inf
    for i in range(len(points)):
        box = boxes[i // CHUNK]
        for j in range(3):
            box[0, j] = min(box[0, j], points[i, j])
            box[1, j] = max(box[1, j], points[i, j])
    return boxes


@njit(cache=True, nogil=True, error_model='numpy')
def rows_near(region, small, state, regions):
    """Return the rows of a region near a small one, (n,) int64; state as of gain_of."""
    points, _, starts, boxes, _ = state
    limit = REACH * regions.extent[small]
    if region == small or regions.extent[region] < limit:
        return rows_of(region, starts, regions)
    rows = np.empty(regions.rows[region], np.int64)
    x, y, z = regions.mean[small]
    part, num = region, 0
    while part >= 0:
        i, end = starts[part], starts[part + 1]
        while i < end:
            box, stop = boxes[i // CHUNK], min(i // CHUNK * CHUNK + CHUNK, end)
            dx = max(box[0, 0] - x, x - box[1, 0], 0.0)
            dy = max(box[0, 1] - y, y - box[1, 1], 0.0)
            dz = max(box[0, 2] - z, z - box[1, 2], 0.0)
            if dx * dx + dy * dy + dz * dz >= limit * limit:
                i = stop
            while i < stop:
                dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
                if dx * dx + dy * dy + dz * dz < limit * limit:
                    rows[num] = i
                    num += 1
                i += 1
        part = regions.after[part]
    return rows[:num]


@njit(cache=True, nogil=True, error_model='numpy')
def rows_of(region, starts, regions):
    """Return all rows of a region, (n,) int64."""
    rows, part, num = np.empty(regions.rows[region], np.int64), region, 0
    while part >= 0:
        for i in range(starts[part], starts[part + 1]):
            rows[num] = i
            num += 1
        part = regions.after[part]
    return rows


@njit(cache=True, nogil=True, error_model='numpy')
def heights(points, normal, quartic, floor):
    """
    Fit height fields to points (4, n) over a plane; quartic: whether degree 4 is tried.

    Returns cost, cost of a plane, rms from a plane m, turn rad, and bend m of the quadric.
    """
    number = points.shape[1]
    tries = 3 if quartic and number > POINTS_PER_TERM * TERMS[2] else 2
    errors = np.empty(tries)
    turn = height_errors(points, normal, errors)
    best = plane = number * math.log(errors[0] + floor) + TERMS[0] * math.log(number)
    for d in range(1, tries):
        if number > POINTS_PER_TERM * TERMS[d]:
            cost = number * math.log(errors[d] + floor) + TERMS[d] * math.log(number)
            best = min(best, cost)
    bend = math.sqrt(12.0 * max(errors[0] - errors[1], 0.0))
    return best, plane, math.sqrt(errors[0] + floor), turn, bend


@njit(cache=True, nogil=True, error_model='numpy')
def describe_regions(names, points, weights, starts, floor, regions, limits, normals, found):
    """
    Compute normals of regions, and how curved they are.

    names    (J,) int64, regions
    points, weights, starts, floor  see join_smooth
    limits   gain, turn and bend from which a region is curved; quartics are fitted only if the
             gain of a quadric alone is less, but its turn and bend are not
    normals  (J, 3) float64, out
    found    (J, 4) float64, out: gain of the best height field over a plane; turn, rad, and bend,
             m, of the quadric; rms from a plane, m
    """
    for k in range(len(names)):
        normals[k] = unit(regions.normal[names[k]])
        rows = rows_of(names[k], starts, regions)
        rows = rows[:: 1 + len(rows) // MOST_ROWS]
        own = np.empty((4, len(rows)))
        gather(rows, points, weights, own)
        best, plane, sigma, turn, bend = heights(own, normals[k], False, floor)
        if turn > limits[1] and bend > limits[2] and plane - best <= limits[0]:
            best, plane, sigma, turn, bend = heights(own, normals[k], True, floor)
        found[k, 0], found[k, 1], found[k, 2], found[k, 3] = plane - best, turn, bend, sigma


@njit(cache=True, nogil=True, error_model='numpy')
def unit(vector):
    """Return the unit vector; 0 for 0."""
    return vector / max(length_of(vector), 1e-12)


@njit(cache=True, nogil=True, error_model='numpy')
def length_of(vector):
    """Return the length of a vector (3,)."""
    return math.sqrt(dot(vector, vector))


@njit(cache=True, nogil=True, error_model='numpy')
def dot(a, b):
    """Return the scalar product of vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
