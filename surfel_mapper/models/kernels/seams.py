# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Which points of a surface continue another one beyond its boundary.

Points are in voxels of the edge of the reach, so all within reach of a point are in the voxels
around its own. Most of these hold points of one surface only, and are skipped.
"""

import math

from numba import njit
import numpy as np

MOST_SURFACES = 8
"""Surfaces within reach of a point, at most; more are left out."""


@njit(cache=True, nogil=True, error_model='numpy')
def find_continuations(voxels, points, normals, owner, axes, rules, pairs):
    """
    List surfaces and the points of others that continue them; return how many there are.

    voxels   starts (V + 1,) int64 and rows (N,) int32 of the points by voxel; starts and rows of
             neighbour_table
    points   (N, 3) float64, m
    normals  (N, 3) float64, of the surface of each point, of any sign
    owner    (N,) int64, surface of each point
    axes     (K, 3) float64, mean normals of the surfaces
    rules    reach m; least cosine between the normals on both sides; sine of the steepest way to a
             point, and the distance below which that is not resolved, m; least cosine between the
             normal of a point and the mean normal of the surface that it continues
    pairs    (M, 2) int64, out: surface, row of the point; pairs beyond M are counted only
    """
    starts, rows, first, adjacent = voxels
    near, away_sq = np.empty(MOST_SURFACES, np.int64), np.empty(MOST_SURFACES)
    num = 0
    for v in range(len(starts) - 1):
        if not is_mixed(v, starts, rows, first, adjacent, owner):
            continue
        for k in range(starts[v], starts[v + 1]):
            row = rows[k]
            held = 0
            for n in range(first[v] - 1, first[v + 1]):
                other = adjacent[n] if n >= first[v] else v
                for i in range(starts[other], starts[other + 1]):
                    if owner[rows[i]] != owner[row]:
                        distance_sq = squared_distance(points, row, rows[i])
                        if distance_sq < rules[0] ** 2:
                            held = keep_nearest(rows[i], distance_sq, owner, near, away_sq, held)
            for i in range(held):
                if continues(
                    row, near[i], away_sq[i], points, normals, axes[owner[near[i]]], rules
                ):
                    if num < len(pairs):
                        pairs[num, 0], pairs[num, 1] = owner[near[i]], row
                    num += 1
    return num


@njit(cache=True, nogil=True)
def is_mixed(v, starts, rows, first, adjacent, owner):
    """Return whether a voxel and those around hold points of several surfaces."""
    own = owner[rows[starts[v]]]
    for n in range(first[v] - 1, first[v + 1]):
        other = adjacent[n] if n >= first[v] else v
        for i in range(starts[other], starts[other + 1]):
            if owner[rows[i]] != own:
                return True
    return False


@njit(cache=True, nogil=True, error_model='numpy')
def squared_distance(points, i, j):
    """Return the squared distance of two points, m^2."""
    x, y, z = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
    return x * x + y * y + z * z


@njit(cache=True, nogil=True)
def keep_nearest(row, distance_sq, owner, near, away_sq, held):
    """Keep a point if it is the nearest of its surface; ties go to the lower row."""
    for i in range(held):
        if owner[near[i]] == owner[row]:
            if distance_sq < away_sq[i] or (distance_sq == away_sq[i] and row < near[i]):
                near[i], away_sq[i] = row, distance_sq
            return held
    if held < len(near):
        near[held], away_sq[held] = row, distance_sq
        held += 1
    return held


@njit(cache=True, nogil=True, error_model='numpy')
def continues(row, near, away_sq, points, normals, axis, rules):
    """Return whether a point continues the surface of the one that is nearest to it."""
    _, crease, steepest, resolved_m, upright = rules
    height = cosine = slope = 0.0
    for j in range(3):
        height += (points[row, j] - points[near, j]) * normals[near, j]
        cosine += normals[row, j] * normals[near, j]
        slope += normals[row, j] * axis[j]
    smooth = abs(height) < steepest * max(math.sqrt(away_sq), resolved_m)
    return smooth and abs(cosine) > crease and abs(slope) > upright
