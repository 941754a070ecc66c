# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Voxels as pieces of surfaces: which of them belong together, which lie on them.

All arrays have a row for each row of the map's slab. A link of two flat neighbours is a bit of
the one of lesser key: bit h of ``links`` says that the voxel in place h of ``around`` goes on
with the same surface. Links depend on the two voxels alone, so whatever
order they change in, they are those of the map as it is. Row r of ``around`` has the rows of all
neighbours, so that only voxels that come need the hash table.
"""

from numba import njit
import numpy as np

from surfel_mapper.models.kernels.joining import go_on
from surfel_mapper.models.kernels.piece_classes import FLAT, variance


@njit(cache=True, nogil=True, error_model='numpy')
def joins(i, j, kind, position, normal, rules):
    """Return whether two neighbours are pieces of one surface; see agree."""
    if kind[i] != FLAT or kind[j] != FLAT:
        return False
    away = cosine = n_i = n_j = 0.0
    for k in range(3):  # no views of rows: they take longer than the sums
        delta = position[i, k] - position[j, k]
        away += delta * delta
        cosine += normal[i, k] * normal[j, k]
        n_i += normal[i, k] * delta
        n_j += normal[j, k] * delta
    if not away < rules[4]:
        return False  # the index of a voxel at the end of the world has run over
    return go_on(cosine, n_i, n_j, 1.0, rules)


@njit(cache=True, nogil=True, error_model='numpy')
def set_link(i, j, h, is_joined, links, marks, marked, num):
    """Set or clear one link; mark both rows where it was otherwise; return how many are marked."""
    bit = np.uint64(1) << np.uint64(h)
    if is_joined == (links[i] & bit != 0):
        return num
    links[i] ^= bit
    return mark(i, marks, marked, mark(j, marks, marked, num))


@njit(cache=True, nogil=True, error_model='numpy')
def mark(row, marks, marked, num):
    """Put a row into a list, once; return how many are in it."""
    if not marks[row]:
        marks[row] = True
        marked[num] = row
        num += 1
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def leave(gone, around, links, marks, marked):
    """
    Take voxels out of the lists of their neighbours, and all their links.

    gone    (G,) int32, rows
    around  (R, 2 H) int32, rows of the voxels after each, then of those before, -1 for none
    links   (R,) uint64
    marks   (R,) bool, all False
    marked  (R,) int32, out: rows of which some link has changed

    Returns how many are marked.
    """
    num, half = 0, around.shape[1] // 2
    for i in range(len(gone)):
        row = gone[i]
        for h in range(2 * half):
            other = around[row, h]
            if other < 0:
                continue
            around[other, (h + half) % (2 * half)] = -1
            around[row, h] = -1
            if h >= half:
                num = set_link(other, row, h - half, False, links, marks, marked, num)
        links[row] = 0
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def enter(came, found, around):
    """
    Put voxels into the lists of their neighbours.

    came    (C,) int32, rows
    found   (C, 2 H) int32, rows of their neighbours, -1 for none
    around  (R, 2 H) int32, in place
    """
    half = around.shape[1] // 2
    for i in range(len(came)):
        for h in range(2 * half):
            other = found[i, h]
            around[came[i], h] = other
            if other >= 0:
                around[other, (h + half) % (2 * half)] = came[i]


@njit(cache=True, nogil=True, error_model='numpy')
def link(chosen, is_chosen, around, state, rules, links, marks, marked, num):
    """
    Set all links from and to some voxels anew.

    chosen     (K,) int32, rows
    is_chosen  (R,) bool, whether a row is one of them
    around     (R, 2 H) int32
    state      kind (R,), position (R, 3), normal (R, 3)
    rules      see agree, but for the fifth: square of the longest distance, m^2
    num        how many rows are marked already

    Returns how many are.
    """
    kind, position, normal = state
    half = around.shape[1] // 2
    for i in range(len(chosen)):
        row = np.int64(chosen[i])
        if kind[row] != FLAT and links[row] != 0:
            for h in range(half):
                if around[row, h] >= 0:
                    num = set_link(
                        row, np.int64(around[row, h]), h, False, links, marks, marked, num
                    )
        for h in range(half):
            after, before = np.int64(around[row, h]), np.int64(around[row, half + h])
            if after >= 0 and kind[row] == FLAT:
                joined = joins(row, after, kind, position, normal, rules)
                num = set_link(row, after, h, joined, links, marks, marked, num)
            if before >= 0 and not is_chosen[before] and kind[before] == FLAT:
                joined = joins(before, row, kind, position, normal, rules)
                num = set_link(before, row, h, joined, links, marks, marked, num)
    return num


@njit(cache=True, nogil=True, error_model='numpy')
def lie_on(chosen, around, state, covariance, rules, host):
    """
    Find the flat neighbour on whose plane a voxel lies that is not flat itself.

    chosen      (K,) int32, rows
    around      (R, A) int32, rows of the neighbours of each, -1 for none
    state       kind (R,), position (R, 3), normal (R, 3)
    covariance  (R, 6) float64, m^2
    rules       largest distance m, most variance along the normal m^2, square of the longest
                distance m^2
    host        (K,) int32, out: the nearest plane's row, -1 for none
    """
    kind, position, normal = state
    for i in range(len(chosen)):
        row = np.int64(chosen[i])
        best = rules[0]
        host[i] = -1
        c = covariance[row]
        for h in range(around.shape[1]):
            other = around[row, h]
            if other < 0 or kind[other] != FLAT:
                continue
            x, y, z = normal[other, 0], normal[other, 1], normal[other, 2]
            dx = position[row, 0] - position[other, 0]
            dy = position[row, 1] - position[other, 1]
            dz = position[row, 2] - position[other, 2]
            if not dx * dx + dy * dy + dz * dz < rules[2]:
                continue
            away = abs(x * dx + y * dy + z * dz)
            if away < best and variance(c, x, y, z) < rules[1]:
                best = away
                host[i] = other


@njit(cache=True, nogil=True, error_model='numpy')
def spread(rows, position, axes, low, voxel_size, points):
    """
    Write nine points a voxel, three by three across it, none outside of it.

    rows      (M,) int32
    position  (R, 3), axes (R, 2, 3) float64
    low       (M, 3) float64, lowest corner of each voxel, m
    points    (9 M, 3) float64, out
    """
    at = 0
    for i in range(len(rows)):
        row = rows[i]
        for a in range(-1, 2):
            for b in range(-1, 2):
                for j in range(3):
                    value = position[row, j] + a * axes[row, 0, j] + b * axes[row, 1, j]
                    points[at, j] = min(max(value, low[i, j]), low[i, j] + voxel_size)
                at += 1


@njit(cache=True, nogil=True, error_model='numpy')
def merge_moments(rows, starts, count, position, covariance, total, mean, merged):
    """
    Merge the moments of voxels, by the exact formula for two sets of points.

    rows        (M,) int32; group k has those from starts[k] to starts[k + 1] - 1
    count       (R,), position (R, 3), covariance (R, 6)
    total       (K,) int64, out: points
    mean        (K, 3) float64, out
    merged      (K, 6) float64, out: covariance, xx xy xz yy yz zz
    """
    for k in range(len(starts) - 1):
        first, points = rows[starts[k]], 0.0
        sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
        for i in range(starts[k], starts[k + 1]):
            row = rows[i]
            n = np.float64(count[row])
            x, y, z = (
                position[row, 0] - position[first, 0],
                position[row, 1] - position[first, 1],
                position[row, 2] - position[first, 2],
            )
            points += n
            sx, sy, sz = sx + n * x, sy + n * y, sz + n * z
            xx += n * x * x + (n - 1.0) * covariance[row, 0]
            xy += n * x * y + (n - 1.0) * covariance[row, 1]
            xz += n * x * z + (n - 1.0) * covariance[row, 2]
            yy += n * y * y + (n - 1.0) * covariance[row, 3]
            yz += n * y * z + (n - 1.0) * covariance[row, 4]
            zz += n * z * z + (n - 1.0) * covariance[row, 5]
        mx, my, mz = sx / points, sy / points, sz / points
        scale = 1.0 / max(points - 1.0, 1.0)
        total[k] = np.int64(points)
        mean[k, 0], mean[k, 1], mean[k, 2] = (
            position[first, 0] + mx,
            position[first, 1] + my,
            position[first, 2] + mz,
        )
        merged[k, 0], merged[k, 1] = scale * (xx - sx * mx), scale * (xy - sx * my)
        merged[k, 2], merged[k, 3] = scale * (xz - sx * mz), scale * (yy - sy * my)
        merged[k, 4], merged[k, 5] = scale * (yz - sy * mz), scale * (zz - sz * mz)
