# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Region merging: which flat clusters belong to one surface, by pair tests and union-find.

The cheap tests on means and normals run for all pairs. Pairs that pass are compared point by
point, nearest pairs first, and skipped if they already are in one region, as only the regions
matter. A point is compared with a cluster only inside its widened bounding box.

Source: Gao and Dong 2025; the test for arcs is our own.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel


@inlined(error_model='numpy')
def gap(delta, distance, value_i, frame_i, value_j, frame_j):
    """
    Return a lower bound of the distance of two clusters: that of their boxes of three sigma.

    delta     (3,) float64, between the means; distance is its length
    value_*   (3,) float64, eigenvalues ascending
    frame_*   (3, 3) float64, rows along eigenvalues descending
    """
    result = distance
    for side in range(2):
        value, frame = (value_j, frame_j) if side else (value_i, frame_i)
        for k in range(3):
            along = frame[k, 0] * delta[0] + frame[k, 1] * delta[1] + frame[k, 2] * delta[2]
            result -= 3.0 * math.sqrt(value[2 - k]) * abs(along) / distance
    return result


@inlined(error_model='numpy')
def same_surface(normal_i, normal_j, delta, scale, rules):
    """
    Return whether two pieces lie on one plane or on one arc.

    scale  factor on lengths: 1 without noise
    rules  (cos_plane, offset, cos_arc, arc_offset, gap, near)

    Tangents of an arc make equal and opposite angles with its chord, so the sum of the normals
    is perpendicular to it; for parallel pieces the same expression is the step between them.
    """
    cosine = n_i = n_j = 0.0
    for j in range(3):
        cosine += normal_i[j] * normal_j[j]
        n_i += normal_i[j] * delta[j]
        n_j += normal_j[j] * delta[j]
    return same_surface_products(cosine, n_i, n_j, scale, rules)


@inlined(error_model='numpy')
def same_surface_products(cosine, n_i, n_j, scale, rules):
    """Evaluate same_surface from n_i . n_j, n_i . delta and n_j . delta."""
    if abs(cosine) > rules[0] and 0.5 * (abs(n_i) + abs(n_j)) < rules[1] * scale:
        return True
    return cosine > rules[2] and 0.5 * abs(n_i + n_j) < rules[3] * scale


@inlined(error_model='numpy')
def find_root(parent, i):
    """Return the root of a union-find tree, with path halving."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel(error_model='numpy')
def find_pairs(means, values, frames, scales, rules, pairs, lengths):
    """
    List pairs of clusters that may be pieces of one surface; return how many there are.

    means    (K, 3), values (K, 3), frames (K, 3, 3): of bisect_cloud
    scales   (K,) float64, see same_surface
    rules    (cos_plane, offset, cos_arc, arc_offset, gap, near), lengths in m; see same_surface;
             boxes of a pair are nearer than gap
    pairs    (M, 2) int64, out: pairs beyond M are counted only
    lengths  (M,) float64, out: distances of their means, m
    """
    num = 0
    delta = np.empty(3)
    least_plane, least_arc = rules[0] - 1e-12, rules[2] - 1e-12
    for i in range(len(means)):
        nx, ny, nz = frames[i, 2, 0], frames[i, 2, 1], frames[i, 2, 2]
        for j in range(i):
            cosine = nx * frames[j, 2, 0] + ny * frames[j, 2, 1] + nz * frames[j, 2, 2]
            if abs(cosine) <= least_plane and cosine <= least_arc:  # most pairs end here
                continue
            length = 0.0
            for k in range(3):
                delta[k] = means[i, k] - means[j, k]
                length += delta[k] * delta[k]
            length = math.sqrt(length)
            scale = 0.5 * (scales[i] + scales[j])
            if not same_surface(frames[i, 2], frames[j, 2], delta, scale, rules):
                continue
            if length > 0.0 and not (
                gap(delta, length, values[i], frames[i], values[j], frames[j]) < rules[4]
            ):
                continue
            if num < len(pairs):
                pairs[num, 0], pairs[num, 1], lengths[num] = i, j, length
            num += 1
    return num


@kernel(error_model='numpy')
def merge_pairs(points, starts, boxes, pairs, near, parent):
    """
    Find the connected components of clusters whose points are near.

    points  (N, 3) float64; cluster k has the rows starts[k, 0] to starts[k, 1] - 1
    starts  (K, 2) int64
    boxes   (K, 2, 3) float64, least and greatest coordinates of each
    pairs   (P, 2) int64, clusters to compare, the nearest first
    near    m
    parent  (K,) int64, out: lowest cluster of the component
    """
    for k in range(len(parent)):
        parent[k] = k
    for p in range(len(pairs)):
        i, j = pairs[p, 0], pairs[p, 1]
        root_i, root_j = find_root(parent, i), find_root(parent, j)
        if root_i != root_j and touch(points, starts[i], starts[j], boxes[i], boxes[j], near):
            parent[max(root_i, root_j)] = min(root_i, root_j)
    for k in range(len(parent)):
        parent[k] = find_root(parent, k)


@inlined(error_model='numpy')
def touch(points, rows_i, rows_j, box_i, box_j, near):
    """Return whether two ranges of rows hold points nearer to each other than a distance."""
    for j in range(3):
        if box_i[0, j] - near > box_j[1, j] or box_j[0, j] - near > box_i[1, j]:
            return False
    near_sq = near * near
    inner = np.empty((rows_j[1] - rows_j[0], 3))
    num_inner = 0
    x0, y0, z0 = box_i[0, 0] - near, box_i[0, 1] - near, box_i[0, 2] - near
    x1, y1, z1 = box_i[1, 0] + near, box_i[1, 1] + near, box_i[1, 2] + near
    for i in range(rows_j[0], rows_j[1]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        inner[num_inner, 0], inner[num_inner, 1], inner[num_inner, 2] = x, y, z
        num_inner += (x0 <= x) & (x <= x1) & (y0 <= y) & (y <= y1) & (z0 <= z) & (z <= z1)
    x0, y0, z0 = box_j[0, 0] - near, box_j[0, 1] - near, box_j[0, 2] - near
    x1, y1, z1 = box_j[1, 0] + near, box_j[1, 1] + near, box_j[1, 2] + near
    for i in range(rows_i[0], rows_i[1]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        if px < x0 or px > x1 or py < y0 or py > y1 or pz < z0 or pz > z1:
            continue
        for k in range(num_inner):
            x, y, z = px - inner[k, 0], py - inner[k, 1], pz - inner[k, 2]
            if x * x + y * y + z * z < near_sq:
                return True
    return False
