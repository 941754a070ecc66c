# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Sum and judge the cells of the adaptive cut.

A cell of level l holds the voxels of equal index >> l. Its key is the packed index of the voxel
above its centre, ((index >> l) << l) + 2^(l - 1), which names level and cell. Its row has the
layout of a voxel, with moments about the centre of the cell, so the same kernel derives surfels
of both.

A ``node`` is a voxel or a cell, and a tuple of arrays: rows (R, 12) int64 and stamps (R, 2)
uint32 (kernels/layout.py), and links (R, 2) int64: the key of a voxel, and the row of the parent
+ 1, shifted by LINK_BITS, with flags. Stamps of cells are PLANE, MIXED, EMPTY or 0.
``children`` (R, 8) int32 has the rows + 1 of the children of each cell, by octant.

The planarity of a cell is judged from its moments and those of its children, in lattice units.
Only additions, products, divisions and square roots are used, so every machine gives the same
cut.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel, U
from surfel_mapper.kernels.layout import BITS, KEY, MAX_MAP_COUNT, PRODUCT, ROW, SCANS, STAMP
from surfel_mapper.kernels.prefetch import prefetch
from surfel_mapper.mapping.kernels.rows import (
    add_to_row,
    count_of,
    first_word,
    prefetch_row,
    sum_of,
    view_of,
)
from surfel_mapper.mapping.kernels.voxels import clear_row

SHOWN, DIRTY, OPEN, LINK_BITS = 1, 2, 4, 3
"""Flags of a link: the node is in the cut; it or a voxel in it changed; nodes below it may be in
the cut."""

PLANE, MIXED, EMPTY = 1, 2, 4
"""Stamps of a cell: its points lie on one plane; they do not; it has none."""

MIN_POINTS = 10
"""Minimum number of points of a plane."""

MIN_SPREAD = 0.015
"""Minimum middle eigenvalue of a plane, of the square of the size: a full square has 1/12."""

CHILD_POINTS, CHILD_SPREAD = 8, 0.01
"""The same minima for a child to have a plane that has to agree."""

SIGMAS = 4.0
"""Number of standard errors within which means and normals of children agree."""

MIN_NOISE = 0.25
"""Minimum noise of points about a plane for standard errors, of ``max_thickness_m``. Else it is
that of the points: scans lie on each other within 1 to 2 cm, which no voxel alone shows."""

MAX_OFFSET = 0.75
"""Tolerance of distances besides standard errors, of ``max_thickness_m``."""

MAX_SINE = 0.17
"""Tolerance of angles besides standard errors: the sine of 10 deg."""

AHEAD = 8
"""Number of nodes between the prefetch of a row and its use."""

LINKED, LINK = 0, 1
"""Columns of links."""

COUNT, ERROR = 3, 4
"""Columns of the means of children: number of points, squared error of the normal or -1."""


@kernel(error_model='numpy')
def sum_children(dirty, level, bits, nodes, cells, children, summed, full, means, ends):
    """
    Sum the children of dirty cells of a level to their rows.

    dirty   (K,) int32
    bits    a voxel is 2^bits lattice units wide
    nodes   the children: voxels or cells
    summed  (K,) int32, out: the cells that may be planes
    full    (8 K,) int32, out: rows of their children with enough points for a plane
    means   (8 K, 5) float64, out: sums of all their children, about the centre of the cell, and
            numbers of points
    ends    (K + 1, 2) int64, out: first of the means and full children of each cell, from 0 on

    The sums of a cell with a mixed child are left out: it and those above it are mixed. Returns
    the number of cells summed.
    """
    flat, stamps, cell_flat, cell_stamps = nodes[0].ravel(), nodes[1], cells[0].ravel(), cells[1]
    flat_children = children.ravel()
    half = np.int64(1) << (bits + level - 2)
    limit = MAX_MAP_COUNT >> (2 * (bits - BITS + level))
    num, num_means, num_full = 0, 0, 0
    below, octants = np.empty(8, np.int64), np.empty(8, np.int64)
    for index in range(len(dirty)):
        prefetch_children(dirty, index, flat_children, flat)
        cell = np.int64(dirty[index])
        num_below, num_points, flags, most_scans = 0, np.int64(0), np.uint32(0), np.uint32(0)
        for octant in range(8):
            child = np.int64(flat_children[U(cell) * U(8) + U(octant)]) - 1
            if child >= 0:
                n = count_of(flat, first_word(child))
                below[num_below], octants[num_below] = child, octant
                num_below += n > 0
                num_points += n
                flags |= stamps[child, STAMP]
                most_scans = max(most_scans, stamps[child, SCANS])
        at = first_word(cell)
        clear_row(cell_flat, at, cell_flat[at + U(KEY)])
        cell_stamps[cell, STAMP] = 0 if num_points else EMPTY
        cell_stamps[cell, SCANS] = most_scans
        if (level > 1 and flags & MIXED) or num_points > limit:
            cell_stamps[cell, STAMP] = MIXED
            continue
        for i in range(num_below):
            first = first_word(below[i])
            n = add_child(flat, first, octants[i], half, cell_flat, at, means, num_means)
            full[num_full] = below[i]
            num_full += n >= CHILD_POINTS
            num_means += 1
        summed[num] = cell
        num += num_points > 0
        ends[num, 0], ends[num, 1] = num_means, num_full
    return num


@inlined()
def prefetch_children(dirty, index, flat_children, flat):
    """Prefetch the rows of the children of a later dirty cell, and the row numbers of another."""
    last = len(dirty) - 1
    prefetch(flat_children, np.int64(dirty[min(index + 2 * AHEAD, last)]) * 8)
    first = U(dirty[min(index + AHEAD, last)]) * U(8)
    for octant in range(U(8)):
        prefetch_row(flat, max(np.int64(flat_children[first + octant]) - 1, 0))


@inlined(error_model='numpy')
def add_child(flat, first, octant, half, cell_flat, at, means, row):
    """Add a child to the row of its cell, set its sum and count; return the count."""
    n = count_of(flat, first)
    dx = half if octant & 4 else -half
    dy = half if octant & 2 else -half
    dz = half if octant & 1 else -half
    px, py, pz = sum_of(flat, first, 0), sum_of(flat, first, 1), sum_of(flat, first, 2)
    qx, qy, qz = px + n * dx, py + n * dy, pz + n * dz
    add_to_row(cell_flat, at, n, (qx, qy, qz), view_of(flat, first))
    pairs, to = first + U(PRODUCT), at + U(PRODUCT)
    cell_flat[to] += flat[pairs] + dx * (px + qx)
    cell_flat[to + U(1)] += flat[pairs + U(1)] + dx * qy + dy * px
    cell_flat[to + U(2)] += flat[pairs + U(2)] + dx * qz + dz * px
    cell_flat[to + U(3)] += flat[pairs + U(3)] + dy * (py + qy)
    cell_flat[to + U(4)] += flat[pairs + U(4)] + dy * qz + dz * py
    cell_flat[to + U(5)] += flat[pairs + U(5)] + dz * (pz + qz)
    means[row, 0], means[row, 1], means[row, 2], means[row, COUNT] = qx, qy, qz, n
    return n


@kernel(error_model='numpy')
def judge(summed, means, ends, cells, children, thickness, size, stamps):
    """
    Judge cells: PLANE, MIXED or, with too few points or children or too little spread, 0.

    summed           (K,) int32, rows of the cells
    means, ends      as of sum_children; sums become means
    cells, children  of the cells and of their full children: normal (K, 3), eigenvalues (K, 3)
    thickness, size  ``max_thickness_m`` and size of the cells, lattice units
    stamps           (R, 2) uint32, of cells, out

    The points must be near the plane of the cell, and so must the mean of each child. Children
    with a plane of their own must have the same normal, and their planes must contain the means of
    each other: a step at the border of two children tilts the plane of the cell, but not theirs.
    Tolerances add SIGMAS standard errors.
    """
    normals, values = cells
    child_normals, child_values = children
    offset, noise = MAX_OFFSET * thickness, MIN_NOISE * thickness
    spread_sq = CHILD_SPREAD * 0.25 * size * size
    for index in range(U(len(summed))):
        start, stop, shape = U(ends[index, 0]), U(ends[index + U(1), 0]), U(ends[index, 1])
        n, x, y, z = 0.0, 0.0, 0.0, 0.0
        for i in range(start, stop):
            n, x, y, z = n + means[i, COUNT], x + means[i, 0], y + means[i, 1], z + means[i, 2]
        x, y, z = x / n, y / n, z / n
        nx, ny, nz = normals[index, 0], normals[index, 1], normals[index, 2]
        variance = (n - 1.0) * values[index, 0] / max(n - 3.0, 1.0)
        mixed = variance > thickness * thickness
        variance = max(variance, noise * noise)
        for i in range(start, start if mixed else stop):
            m = means[i, COUNT]
            means[i, 0], means[i, 1], means[i, 2] = (
                means[i, 0] / m,
                means[i, 1] / m,
                means[i, 2] / m,
            )
            means[i, ERROR] = -1.0
            across = (means[i, 0] - x) * nx + (means[i, 1] - y) * ny + (means[i, 2] - z) * nz
            mixed |= is_beyond(across, variance / m, offset)
            if m >= CHILD_POINTS:
                f1, f2 = child_values[shape, 1], child_values[shape, 2]
                own = max((m - 1.0) * child_values[shape, 0] / (m - 3.0), noise * noise)
                first, second = f1 - own, f2 - own
                error_sq = own / m * (f1 / (first * first) + f2 / (second * second))
                if f1 > max(spread_sq, own):
                    means[i, ERROR] = error_sq
                    dot = child_normals[shape, 0] * nx + child_normals[shape, 1] * ny
                    dot += child_normals[shape, 2] * nz
                    mixed |= is_beyond(math.sqrt(max(1.0 - dot * dot, 0.0)), error_sq, MAX_SINE)
                shape += U(1)
        shape = U(ends[index, 1])
        for i in range(start, start if mixed else stop):
            if means[i, ERROR] >= 0.0:
                nx, ny, nz = (
                    child_normals[shape, 0],
                    child_normals[shape, 1],
                    child_normals[shape, 2],
                )
                for j in range(start, stop):
                    if means[j, ERROR] >= 0.0:
                        dx, dy = means[j, 0] - means[i, 0], means[j, 1] - means[i, 1]
                        dz = means[j, 2] - means[i, 2]
                        across = (dx * nx + dy * ny) + dz * nz
                        if abs(across) > offset:
                            error_sq = ((dx * dx + dy * dy) + dz * dz) * means[i, ERROR]
                            error_sq += variance / means[i, COUNT] + variance / means[j, COUNT]
                            mixed |= is_beyond(across, error_sq, offset)
            shape += U(means[i, COUNT] >= CHILD_POINTS)
        is_plane = n >= MIN_POINTS and values[index, 1] >= MIN_SPREAD * size * size
        is_plane &= stop - start > U(1)
        stamps[summed[index], STAMP] = MIXED if mixed else PLANE * is_plane


@inlined()
def is_beyond(value, error_sq, tolerance):
    """Return whether a value, of a squared standard error, is beyond a tolerance about 0."""
    excess = abs(value) - tolerance
    return excess > 0.0 and excess * excess > SIGMAS * SIGMAS * error_sq


@kernel()
def mark(chosen, nodes, cell_links, children, new, dirty, gone):
    """
    Mark changed nodes and their parents as dirty, and unlink rows that hold another node now.

    chosen  (K,) int64, rows
    new     (K,) int64, out: rows without a link
    dirty   (K,) int64, out: rows of the parents that were clean
    gone    (K,) int64, out: keys of the unlinked nodes that were in the cut

    Returns the numbers of outputs.
    """
    flat, links, parent_links = nodes[0].ravel(), nodes[2].ravel(), cell_links.ravel()
    num_new, num_dirty, num_gone, last = 0, 0, 0, len(chosen) - 1
    for index in range(len(chosen)):
        later = chosen[min(index + 4 * AHEAD, last)]
        prefetch(flat, later * ROW)
        prefetch(links, later * 2)
        later = links[U(chosen[min(index + 2 * AHEAD, last)]) * U(2) + U(LINK)] >> LINK_BITS
        prefetch(parent_links, max(later - 1, 0) * 2)
        row = chosen[index]
        at = U(row) * U(2)
        key, link = links[at + U(LINKED)], links[at + U(LINK)]
        parent = (link >> LINK_BITS) - 1
        is_linked = parent >= 0
        if is_linked:
            dirty[num_dirty] = parent
            num_dirty += cell_links[parent, LINK] & DIRTY == 0
            cell_links[parent, LINK] |= DIRTY
            links[at + U(LINK)] = link | DIRTY
            if flat[first_word(row) + U(KEY)] != key:
                gone[num_gone] = key
                num_gone += link & SHOWN
                links[at + U(LINK)] = 0
                for octant in range(8):
                    children[parent, octant] *= children[parent, octant] != row + 1
                is_linked = False
        new[num_new] = row
        num_new += not is_linked
    return num_new, num_dirty, num_gone


@kernel()
def compare(roots, levels, min_points, voxels, cells, children, outputs):
    """
    Compare the cut below dirty roots with the one reported last; return the numbers of outputs.

    roots       (K,) int32, dirty cells of the highest level
    min_points  nodes of fewer points are left out
    outputs     changed voxels (V,) int32, changed cells (C,) int32, both rows; gone voxels (V,)
                int64, gone cells (C,) int64, both keys; the first num_gone of the former exist
    """
    rows, _, links = voxels
    cell_rows, stamps, cell_links = cells
    changed_voxels, changed_cells, gone_voxels, gone_cells, numbers = outputs
    flat, cell_flat = rows.ravel(), cell_rows.ravel()
    stack = np.empty((8 * levels + 8, 3), np.int64)
    for root in roots:
        depth = 1
        stack[0, 0], stack[0, 1], stack[0, 2] = root, levels, 0
        while depth:
            depth -= 1
            cell, level, is_hidden = stack[depth, 0], stack[depth, 1], stack[depth, 2]
            link, at = cell_links[cell, LINK], first_word(cell)
            is_plane = np.int64(stamps[cell, STAMP]) & PLANE
            shown = is_plane & (1 - is_hidden) & (count_of(cell_flat, at) >= min_points)
            if shown and link & (SHOWN | DIRTY) != SHOWN:
                changed_cells[numbers[1]] = cell
                numbers[1] += 1
            if link & SHOWN and not shown:
                gone_cells[numbers[3]] = cell_flat[at + U(KEY)]
                numbers[3] += 1
            hid, hides = 1 - (link & OPEN) // OPEN, is_plane | is_hidden
            cell_links[cell, LINK] = (link & ~(SHOWN | OPEN)) | shown | (1 - hides) * OPEN
            if hid & hides:
                continue
            for octant in range(8):
                child = np.int64(children[cell, octant]) - 1
                if child < 0:
                    continue
                if level > 1:
                    if hid != hides or cell_links[child, LINK] & DIRTY:
                        stack[depth, 0], stack[depth, 1] = child, level - 1
                        stack[depth, 2] = hides
                        depth += 1
                    continue
                link = links[child, LINK]
                if hid == hides and not link & DIRTY:
                    continue
                n = count_of(flat, first_word(child))
                shown = (1 - hides) & (n >= min_points)
                if shown and link & (SHOWN | DIRTY) != SHOWN:
                    changed_voxels[numbers[0]] = child
                    numbers[0] += 1
                if link & SHOWN and not shown:
                    gone_voxels[numbers[2]] = flat[first_word(child) + U(KEY)]
                    numbers[2] += 1
                links[child, LINK] = (link & ~SHOWN) | shown


@kernel()
def clean(chosen, links):
    """Mark nodes as clean."""
    for row in chosen:
        links[row, LINK] &= ~DIRTY
