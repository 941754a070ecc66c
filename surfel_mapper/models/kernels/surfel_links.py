# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Links between neighbouring flat surfels, and hosts of voxels that are not flat.

All arrays have a row for each row of the map's slab. A link is stored at the voxel of lesser key:
bit h of ``links`` says that the voxel ``neighbours[row, h]`` continues the same surface. A link
depends on its two voxels alone, so the result does not depend on the order of changes. Row r of
``neighbours`` has the rows of all neighbours, so only new voxels need the hash table.
"""

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel
from surfel_mapper.models.kernels.region_merging import same_surface_products
from surfel_mapper.models.kernels.surfel_classes import FLAT, variance

ROUNDS = 3
"""Patches grow by so many voxels over sparse and rough ones."""


@inlined(error_model='numpy')
def are_linked(i, j, state, rules):
    """
    Return whether two neighbours are pieces of one surface; see same_surface.

    Voxels that are flat with those around only are linked on planes: these hide an arc.
    """
    kind, position, normal, own = state
    if kind[i] != FLAT or kind[j] != FLAT:
        return False
    away = cosine = n_i = n_j = 0.0
    for k in range(3):  # views of rows take longer than the sums
        delta = position[i, k] - position[j, k]
        away += delta * delta
        cosine += normal[i, k] * normal[j, k]
        n_i += normal[i, k] * delta
        n_j += normal[j, k] * delta
    if not away < rules[4]:
        return False  # voxel indices wrap around at the limit of the grid
    if (own[i] != FLAT or own[j] != FLAT) and not abs(cosine) > rules[0]:
        return False
    return same_surface_products(cosine, n_i, n_j, 1.0, rules)


@inlined(error_model='numpy')
def set_link(i, j, h, is_joined, links, marks, marked, num):
    """Set or clear one link, mark both rows if it changed, return how many are marked."""
    bit = np.uint64(1) << np.uint64(h)
    if is_joined == (links[i] & bit != 0):
        return num
    links[i] ^= bit
    return mark(i, marks, marked, mark(j, marks, marked, num))


@inlined(error_model='numpy')
def mark(row, marks, marked, num):
    """Append a row to a list unless it is there already; return the length of the list."""
    if not marks[row]:
        marks[row] = True
        marked[num] = row
        num += 1
    return num


@kernel(error_model='numpy')
def unlink(gone, neighbours, links, marks, marked):
    """
    Remove voxels from the lists of their neighbours, with all links.

    gone        (G,) int32, rows
    neighbours  (R, 2 H) int32, rows of the voxels after each, then of those before; -1 for none
    links       (R,) uint64
    marks       (R,) bool, all False
    marked      (R,) int32, out: remaining rows with a changed link of their own

    Returns how many rows are marked.
    """
    num, half = 0, neighbours.shape[1] // 2
    for i in range(len(gone)):
        row = gone[i]
        for h in range(2 * half):
            neighbour = neighbours[row, h]
            if neighbour < 0:
                continue
            neighbours[neighbour, (h + half) % (2 * half)] = -1
            neighbours[row, h] = -1
            if h >= half:
                num = set_link(neighbour, row, h - half, False, links, marks, marked, num)
        links[row] = 0
    return num


@kernel(error_model='numpy')
def link_neighbours(came, around, neighbours):
    """
    Enter voxels into the lists of their neighbours.

    came        (C,) int32, rows
    around      (C, 2 H) int32, rows of their neighbours, -1 for none
    neighbours  (R, 2 H) int32, in place
    """
    half = neighbours.shape[1] // 2
    for i in range(len(came)):
        for h in range(2 * half):
            neighbour = around[i, h]
            neighbours[came[i], h] = neighbour
            if neighbour >= 0:
                neighbours[neighbour, (h + half) % (2 * half)] = came[i]


@kernel(error_model='numpy')
def update_links(chosen, is_chosen, neighbours, state, rules, links, marks, marked, num):
    """
    Recompute all links from and to some voxels.

    chosen      (K,) int32, rows
    is_chosen   (R,) bool, whether a row is one of them
    neighbours  (R, 2 H) int32
    state       kind (R,), position (R, 3), normal (R, 3), class (R,) of the voxel alone
    rules       see same_surface, but the fifth is the square of the longest distance, m^2
    num         number of rows already marked

    Returns how many rows are marked.
    """
    kind = state[0]
    half = neighbours.shape[1] // 2
    for i in range(len(chosen)):
        row = np.int64(chosen[i])
        if kind[row] != FLAT and links[row] != 0:
            for h in range(half):
                if neighbours[row, h] >= 0:
                    num = set_link(
                        row, np.int64(neighbours[row, h]), h, False, links, marks, marked, num
                    )
        for h in range(half):
            ahead, behind = np.int64(neighbours[row, h]), np.int64(neighbours[row, half + h])
            if ahead >= 0 and kind[row] == FLAT:
                joined = are_linked(row, ahead, state, rules)
                num = set_link(row, ahead, h, joined, links, marks, marked, num)
            if behind >= 0 and not is_chosen[behind] and kind[behind] == FLAT:
                joined = are_linked(behind, row, state, rules)
                num = set_link(behind, row, h, joined, links, marks, marked, num)
    return num


@kernel(error_model='numpy')
def spread(rows, neighbours, steps, marks, marked):
    """
    List rows and those within some steps of them; return how many there are.

    rows        (K,) int32, -1 for none
    neighbours  (R, A) int32, rows of the neighbours of each, -1 for none
    marks       (R,) bool, all False; restored afterwards
    marked      (R,) int32, out
    """
    num = 0
    for row in rows:
        if row >= 0:
            num = mark(row, marks, marked, num)
    low = 0
    for _ in range(steps):
        high = num
        for i in range(low, high):
            for h in range(neighbours.shape[1]):
                neighbour = neighbours[marked[i], h]
                if neighbour >= 0:
                    num = mark(neighbour, marks, marked, num)
        low = high
    for i in range(num):
        marks[marked[i]] = False
    return num


@kernel(error_model='numpy')
def find_hosts(chosen, neighbours, state, covariance, rules, host, level):
    """
    Find for voxels that are not flat a flat one on whose plane they lie.

    Patches grow over voxels with few points and rough ones: first over neighbours of flat voxels,
    then over neighbours of these, and so on; a voxel has the nearest plane of its first round.

    chosen      (K,) int32, rows
    neighbours  (R, A) int32, rows of the neighbours of each, -1 for none
    state       kind (R,), position (R, 3), normal (R, 3)
    covariance  (R, 6) float64, m^2
    rules       largest distance m, largest variance along the normal m^2, square of the longest
                distance m^2
    host        (R,) int32, in place for chosen rows: row with the nearest plane, -1 for none
    level       (R,) uint8, in place for chosen rows: the round, 0 without a host
    """
    kind, position, normal = state
    for row in chosen:
        host[row], level[row] = -1, 0
    for step in range(1, ROUNDS + 1):
        for i in range(len(chosen)):
            row = np.int64(chosen[i])
            if kind[row] == FLAT or level[row] != 0:
                continue
            best = rules[0]
            c = covariance[row]
            for h in range(neighbours.shape[1]):
                near = neighbours[row, h]
                if near < 0 or level[near] != step - 1:
                    continue
                candidate = host[near] if step > 1 else near
                if kind[candidate] != FLAT:
                    continue
                x, y, z = normal[candidate, 0], normal[candidate, 1], normal[candidate, 2]
                dx = position[row, 0] - position[candidate, 0]
                dy = position[row, 1] - position[candidate, 1]
                dz = position[row, 2] - position[candidate, 2]
                if not dx * dx + dy * dy + dz * dz < rules[2]:
                    continue
                away = abs(x * dx + y * dy + z * dz)
                if away < best and variance(c, x, y, z) < rules[1]:
                    best = away
                    host[row], level[row] = candidate, step
