# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Groups of pieces: who hangs together, who turns too far to be a graph over one plane.

A component is called by the row of the voxel of least key in it, so that ids need no table and
do not depend on the order in which voxels came.
"""

from numba import njit
import numpy as np

from surfel_mapper.models.kernels.joining import find_root

LEAST_SHARE = 0.4
"""The mean of unit vectors within 60 deg of it is at least half as long, but for outliers."""


@njit(cache=True, nogil=True, error_model='numpy')
def rows_of_groups(group, flags, loose, rows):
    """
    List the rows whose group is flagged.

    group  (R,) int32, -1 for none
    flags  (R,) bool, by group
    loose  (R,) bool, rows that are listed too
    rows   (R,) int32, out

    Returns how many there are.
    """
    num = 0
    for row in range(len(group)):
        if loose[row] or (group[row] >= 0 and flags[group[row]]):
            rows[num] = row
            num += 1
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def hang_together(rows, links, around, places, parent):
    """
    Find which voxels are linked, by whatever way through the others.

    rows      (M,) int32
    links     (R,) uint64
    around    (R, 2 H) int32
    places    (R,) int32, all -1; as before afterwards
    parent    (M,) int64, out: the first of those that hang together
    """
    for i in range(len(rows)):
        places[rows[i]] = i
        parent[i] = i
    for i in range(len(rows)):
        bits, h = links[rows[i]], 0
        while bits:
            if bits & np.uint64(1):
                j = places[around[rows[i], h]]
                if j >= 0:
                    one, other = find_root(parent, i), find_root(parent, np.int64(j))
                    parent[max(one, other)] = min(one, other)
            bits >>= np.uint64(1)
            h += 1
    for i in range(len(rows)):
        parent[i] = find_root(parent, i)
        places[rows[i]] = -1


@njit(cache=True, nogil=True, error_model='numpy')
def name_components(rows, parent, key, component):
    """
    Call every component by its voxel of least key.

    rows, parent  of hang_together
    key           (R,) int64
    component     (R,) int32, out for these rows
    """
    least = np.arange(len(rows))
    for i in range(len(rows)):
        root = parent[i]
        if key[rows[i]] < key[rows[least[root]]]:
            least[root] = i
    for i in range(len(rows)):
        component[rows[i]] = rows[least[parent[i]]]


@njit(cache=True, nogil=True, error_model='numpy')
def sort_by_group(rows, group, places, ordered, starts):
    """
    Put rows group by group, in the order in which groups and rows first appear.

    rows     (M,) int32
    group    (R,) int32, of each row
    places   (R,) int32, all -1; as before afterwards
    ordered  (M,) int32, out
    starts   (M + 1,) int64, out: where each group begins, and M

    Returns how many groups there are.
    """
    num = 0
    of_row = np.empty(len(rows), np.int64)
    for i in range(len(rows)):
        name = group[rows[i]]
        if places[name] < 0:
            places[name] = num
            starts[num + 1] = 0
            num += 1
        of_row[i] = places[name]
        starts[of_row[i] + 1] += 1
    starts[0] = 0
    for k in range(num):
        starts[k + 1] += starts[k]
    filled = starts[:num].copy()
    for i in range(len(rows)):
        places[group[rows[i]]] = -1
        ordered[filled[of_row[i]]] = rows[i]
        filled[of_row[i]] += 1
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def mean_normals(rows, starts, flat, normal, means):
    """
    Find the mean unit normals of groups, from their flat voxels alone.

    Those of a chart are within a cone; where they cancel, nobody saw the voxels from one side, and
    they are turned to the side of most.

    rows    (M,) int32; group k has those from starts[k] to starts[k + 1] - 1
    flat    (R,) bool
    normal  (R, 3) float64
    means   (K, 3) float64, out
    """
    for k in range(len(starts) - 1):
        mean = means[k]
        mean[:] = 0.0
        for turn in range(3):
            x = y = z = 0.0
            num = 0
            for i in range(starts[k], starts[k + 1]):
                n = normal[rows[i]]
                if not flat[rows[i]]:
                    continue
                if turn == 1 and num == 0:
                    mean[0], mean[1], mean[2] = n[0], n[1], n[2]
                cosine = n[0] * mean[0] + n[1] * mean[1] + n[2] * mean[2]
                side = -1.0 if turn > 0 and cosine < 0.0 else 1.0
                x, y, z = x + side * n[0], y + side * n[1], z + side * n[2]
                num += 1
            length = np.sqrt(x * x + y * y + z * z)
            scale = 1.0 / length if length > 0.0 else 0.0
            mean[0], mean[1], mean[2] = scale * x, scale * y, scale * z
            if turn == 0 and length > LEAST_SHARE * num:
                break


@njit(cache=True, nogil=True, error_model='numpy')
def suspects(rows, starts, means, normal, position, rules, found):
    """
    Find groups that may turn too far from their mean normal, or lie over themselves.

    rules  cosine that all normals have to the mean if none does; height along the mean normal,
           m, that the group has to have to lie over itself
    found  (K,) bool, out
    """
    for k in range(len(starts) - 1):
        low, high, least = np.inf, -np.inf, 1.0
        x, y, z = means[k, 0], means[k, 1], means[k, 2]
        for i in range(starts[k], starts[k + 1]):
            row = rows[i]
            cosine = x * normal[row, 0] + y * normal[row, 1] + z * normal[row, 2]
            height = x * position[row, 0] + y * position[row, 1] + z * position[row, 2]
            least = min(least, cosine)
            low, high = min(low, height), max(high, height)
        found[k] = least < rules[0] or high - low > rules[1]
