# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Maintain the cells of the adaptive cut: link voxels to cells, judge cells, report the changes.

A cell of level l holds the voxels of equal index >> l. Its key is the packed index of the voxel
above its centre, ((index >> l) << l) + 2^(l - 1), which names level and cell. Its row has the
layout of a voxel, with moments about the centre of the cell, so the same kernel derives surfels
of both.

A ``node`` is a voxel or a cell, and a tuple of arrays: rows (R, 12) int64 and stamps (R, 2)
uint32 (kernels/layout.py), links (R, 2) int64 and channels (R, C) int64. A link is the key of a
voxel, and the row of the parent + 1, shifted by LINK_BITS, with the flags SHOWN and DIRTY.
Stamps of cells hold flags instead of a stamp. ``children`` (R, 8) int32 has the rows + 1 of the
children of each cell, by octant.

The planarity of a cell is judged from its moments and those of its children, in lattice units.
Only additions, products, divisions and square roots are used, so every machine gives the same
cut.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel, U
from surfel_mapper.kernels.hashing import (
    DEPTH,
    find_row,
    FREE_ROW,
    hash_key,
    insert_row,
    is_full,
    makes_room,
    remove_row,
    SEGMENT,
)
from surfel_mapper.kernels.layout import BITS, KEY, MAX_MAP_COUNT, PRODUCT, ROW, SCANS, STAMP, VIEW
from surfel_mapper.kernels.prefetch import prefetch
from surfel_mapper.kernels.quantisation import pack, unpack
from surfel_mapper.kernels.symmetric3 import decompose_one
from surfel_mapper.mapping.kernels.rows import (
    add_to_row,
    count_of,
    first_word,
    prefetch_row,
    sum_of,
    view_of,
)
from surfel_mapper.mapping.kernels.surfels import center
from surfel_mapper.mapping.kernels.voxels import clear_row, free_row, take_row

SHOWN, DIRTY, LINK_BITS = 1, 2, 2
"""Flags of a link: the node is in the cut; it or a voxel in it changed."""

PLANE, MIXED, HIDES = 1, 2, 4
"""Flags of a cell: its points lie on one plane; they do not; nothing below it is in the cut."""

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
"""Columns of a link."""

CELLS, COLUMNS = 16, 9 * 16
"""Cells judged at once, with shapes of 8 children each, which stay in the first-level cache."""

# Rows of a chunk of shapes.
MEAN, N, E0, NORMAL, ERROR, SHAPE = 0, 3, 4, 7, 10, 11


@njit(cache=True, nogil=True, inline='always')
def parent_key(key, level):
    """Return the key of the cell of the next level around a node of a level, 0 for a voxel."""
    x, y, z = unpack(key)
    half = np.int64(1) << level
    up = level + 1
    return pack(((x >> up) << up) + half, ((y >> up) << up) + half, ((z >> up) << up) + half)


@njit(cache=True, nogil=True, inline='always')
def octant_of(key, level):
    """Return the octant of a node of a level in its parent: 4 x + 2 y + z, each 0 or 1."""
    x, y, z = unpack(key)
    return (((x >> level) & 1) << 2) | (((y >> level) & 1) << 1) | ((z >> level) & 1)


@njit(cache=True, nogil=True, inline='always')
def mark(cell, links, dirty, num):
    """Append a cell to the dirty ones unless it is one; return their number."""
    if links[cell, LINK] & DIRTY == 0:
        links[cell, LINK] |= DIRTY
        dirty[num] = cell
        num += 1
    return num


@kernel()
def detach(changed, voxels, cells, children, dirty, gone, new):
    """
    Mark the cells above changed rows, and unlink the rows that hold their voxel no longer.

    changed  (K,) int32, the changed rows of the map, each once
    dirty    (D,) int32, out: cells of level 1 above them
    gone     (K,) int64, out: keys of unlinked voxels of the cut
    new      (K,) int32, out: rows that hold a voxel without a link

    Returns the numbers of dirty, gone and new ones.
    """
    rows, _, links, _ = voxels
    cell_links = cells[2]
    flat, flat_links = rows.ravel(), links.ravel()
    num_dirty = num_gone = num_new = 0
    for index in range(len(changed)):
        ahead = np.int64(changed[min(index + AHEAD, len(changed) - 1)])
        prefetch(flat, ahead * ROW)
        prefetch(flat_links, ahead * 2)
        row = changed[index]
        key, link = links[row, LINKED], links[row, LINK]
        at = first_word(row)
        present = flat[at + U(KEY)]
        if link:
            cell = (link >> LINK_BITS) - 1
            num_dirty = mark(cell, cell_links, dirty, num_dirty)
            if present == key:
                links[row, LINK] = link | DIRTY
                continue
            children[cell, octant_of(key, 0)] = 0
            links[row, LINK] = 0
            gone[num_gone] = key
            num_gone += link & SHOWN
        new[num_new] = row
        num_new += present >= 0
    return num_dirty, num_gone, num_new


@kernel()
def attach(chosen, start, level, nodes, cells, children, table, state, dirty, num_dirty):
    """
    Link changed nodes of a level to their parents, which become dirty.

    chosen  (K,) int32, rows of the nodes
    start   the first of them to link
    dirty   (D,) int32, in and out: dirty cells of the next level

    Returns K, and the number of dirty cells. Less than K if there is no room for a cell: make
    room and continue from there.
    """
    rows, _, links, _ = nodes
    cell_rows, stamps, cell_links, _ = cells
    flat, cell_flat = rows.ravel(), cell_rows.ravel()
    directory, _, counts, _ = table
    entries = np.empty(SEGMENT, np.int64)
    for index in range(start, len(chosen)):
        row = chosen[index]
        at = first_word(row)
        link = links[row, LINK]
        if link >> LINK_BITS == 0:
            key = flat[at + U(KEY)]
            above = parent_key(key, level)
            parent = np.int64(find_row(above, cell_rows, table, state[DEPTH]))
            if parent < 0:
                hashed = hash_key(above)
                full = is_full(hashed, directory, counts, state[DEPTH])
                if not full or makes_room(hashed, table, state, entries):
                    parent = np.int64(take_row(cell_flat, state))
                if parent < 0:
                    return index, num_dirty
                insert_row(hashed, parent, table, state[DEPTH])
                clear_row(cell_flat, first_word(parent), above)
                stamps[parent, STAMP] = HIDES
                cell_links[parent, LINK] = 0
                children[parent, :] = 0
            children[parent, octant_of(key, level)] = row + 1
            link |= (parent + 1) << LINK_BITS
            links[row, LINKED] = key
        links[row, LINK] = link | DIRTY
        num_dirty = mark((link >> LINK_BITS) - 1, cell_links, dirty, num_dirty)
    return len(chosen), num_dirty


@kernel(error_model='numpy')
def judge(dirty, level, bits, thickness, nodes, cells, children):
    """
    Sum the children of dirty cells of a level, and judge which cells are planes.

    dirty      (K,) int32
    bits       a voxel is 2^bits lattice units wide
    thickness  float64, ``max_thickness_m`` in lattice units
    nodes      the children: voxels or cells

    Shapes of cells and their children are derived in chunks, with vector instructions. The sums
    of a cell with a mixed child are left out: it and those above it are mixed.
    """
    flat, stamps, channels = nodes[0].ravel(), nodes[1], nodes[3]
    cell_flat, cell_stamps, cell_channels = cells[0].ravel(), cells[1], cells[3]
    flat_children = children.ravel()
    half, size = np.int64(1) << (bits + level - 2), np.float64(np.int64(1) << (bits + level))
    limit = MAX_MAP_COUNT >> (2 * (bits - BITS + level))
    ends, summed = np.zeros((CELLS + 1, 2), np.int64), np.empty(CELLS, np.int64)
    below, octants = np.empty(8, np.int64), np.empty(8, np.int64)
    moments, shapes = np.empty((10, COLUMNS)), np.empty((SHAPE, COLUMNS))
    mean, scatter = np.empty((3, COLUMNS)), np.empty((6, COLUMNS))
    few = np.empty((4, COLUMNS))
    done = 0
    while done < len(dirty):
        num = 0
        while done < len(dirty) and num < CELLS:
            prefetch_children(dirty, done, flat_children, flat)
            cell = np.int64(dirty[done])
            done += 1
            num_below, num_points, flags = 0, np.int64(0), np.uint32(0)
            most_scans = np.uint32(0)
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
            hides = cell_stamps[cell, STAMP] & HIDES
            cell_stamps[cell, STAMP], cell_stamps[cell, SCANS] = hides, most_scans
            if (level > 1 and flags & MIXED) or num_points > limit:
                cell_stamps[cell, STAMP] = hides | MIXED
                cell_flat[at + U(VIEW)] = 1  # one point: not empty
            elif num_points:
                summed[num] = cell
                ends[num + 1, 0], ends[num + 1, 1] = sum_children(
                    flat, below, octants, num_below, half, cell_flat, at, moments, few, ends[num]
                )
                num += 1
                for channel in range(channels.shape[1]):
                    cell_channels[cell, channel] = 0
                    for i in range(num_below):
                        cell_channels[cell, channel] += channels[below[i], channel]
        derive_shapes(moments, ends[num, 0], mean, scatter, shapes)
        for i in range(num):
            cell_stamps[summed[i], STAMP] |= verdict(shapes, few, ends, i, thickness, size)


@inlined()
def prefetch_children(dirty, index, flat_children, flat):
    """Prefetch the rows of the children of a later dirty cell, and the row numbers of another."""
    last = len(dirty) - 1
    prefetch(flat_children, np.int64(dirty[min(index + 2 * AHEAD, last)]) * 8)
    first = U(dirty[min(index + AHEAD, last)]) * U(8)
    for octant in range(U(8)):
        prefetch_row(flat, max(np.int64(flat_children[first + octant]) - 1, 0))


@inlined(error_model='numpy')
def sum_children(flat, below, octants, num_below, half, cell_flat, at, moments, few, start):
    """
    Sum the children of a cell to its row, which begins at a word and is zero.

    moments  (10, COLUMNS) float64, out: count, sums and products of the children with enough
             points for a plane and then of the cell, about the centre of the cell
    few      (4, COLUMNS) float64, out: mean and count of the other children
    start    the first columns to write

    Returns the columns after those written.
    """
    last, num_few = start[0], start[1]
    n, vx, vy, vz = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    sx, sy, sz = np.int64(0), np.int64(0), np.int64(0)
    xx, xy, xz = np.int64(0), np.int64(0), np.int64(0)
    yy, yz, zz = np.int64(0), np.int64(0), np.int64(0)
    for i in range(num_below):
        first = first_word(below[i])
        pairs = first + U(PRODUCT)
        m = count_of(flat, first)
        dx = half if octants[i] & 4 else -half
        dy = half if octants[i] & 2 else -half
        dz = half if octants[i] & 1 else -half
        ux, uy, uz = view_of(flat, first)
        px, py, pz = sum_of(flat, first, 0), sum_of(flat, first, 1), sum_of(flat, first, 2)
        qx, qy, qz = px + m * dx, py + m * dy, pz + m * dz
        pxx = flat[pairs] + dx * (px + qx)
        pxy = flat[pairs + U(1)] + dx * qy + dy * px
        pxz = flat[pairs + U(2)] + dx * qz + dz * px
        pyy = flat[pairs + U(3)] + dy * (py + qy)
        pyz = flat[pairs + U(4)] + dy * qz + dz * py
        pzz = flat[pairs + U(5)] + dz * (pz + qz)
        n, vx, vy, vz = n + m, vx + ux, vy + uy, vz + uz
        sx, sy, sz = sx + qx, sy + qy, sz + qz
        xx, xy, xz, yy, yz, zz = xx + pxx, xy + pxy, xz + pxz, yy + pyy, yz + pyz, zz + pzz
        if m >= CHILD_POINTS:
            moments[0, last], moments[1, last], moments[2, last], moments[3, last] = m, qx, qy, qz
            moments[4, last], moments[5, last], moments[6, last] = pxx, pxy, pxz
            moments[7, last], moments[8, last], moments[9, last] = pyy, pyz, pzz
            last += 1
        else:
            few[0, num_few], few[1, num_few], few[2, num_few] = qx / m, qy / m, qz / m
            few[3, num_few] = m
            num_few += 1
    add_to_row(cell_flat, at, n, (sx, sy, sz), (vx, vy, vz))
    pairs = at + U(PRODUCT)
    cell_flat[pairs], cell_flat[pairs + U(1)], cell_flat[pairs + U(2)] = xx, xy, xz
    cell_flat[pairs + U(3)], cell_flat[pairs + U(4)], cell_flat[pairs + U(5)] = yy, yz, zz
    moments[0, last], moments[1, last], moments[2, last], moments[3, last] = n, sx, sy, sz
    moments[4, last], moments[5, last], moments[6, last] = xx, xy, xz
    moments[7, last], moments[8, last], moments[9, last] = yy, yz, zz
    return last + 1, num_few


@inlined(error_model='numpy')
def derive_shapes(moments, num, mean, scatter, shapes):
    """
    Derive mean, count, eigenvalues and normal of the first num columns of moments.

    mean, scatter  (3, COLUMNS) and (6, COLUMNS) float64, overwritten
    shapes         (SHAPE, COLUMNS) float64, out, in lattice units
    """
    center(moments, num, mean, scatter)
    for i in range(num):
        xx, xy, xz = scatter[0, i], scatter[1, i], scatter[2, i]
        yy, yz, zz = scatter[3, i], scatter[4, i], scatter[5, i]
        (e0, e1, e2), (nx, ny, nz) = decompose_one(xx, xy, xz, yy, yz, zz)
        scale = 1.0 / max(moments[0, i] - 1.0, 1.0)
        shapes[E0, i], shapes[E0 + 1, i], shapes[E0 + 2, i] = e0 * scale, e1 * scale, e2 * scale
        shapes[NORMAL, i], shapes[NORMAL + 1, i], shapes[NORMAL + 2, i] = nx, ny, nz
    for i in range(num):
        shapes[MEAN, i], shapes[MEAN + 1, i], shapes[MEAN + 2, i] = (
            mean[0, i],
            mean[1, i],
            mean[2, i],
        )
        shapes[N, i] = moments[0, i]


@njit(cache=True, nogil=True, error_model='numpy')
def verdict(shapes, few, ends, index, thickness, size):
    """
    Return PLANE, MIXED or, of a cell with too few points or children or too little spread, 0.

    shapes, few  of the children of all cells of a chunk; the last shape of each is of the cell
    ends         (CELLS + 1, 2) int64, where the columns of each cell begin in both

    The points must be near the plane of the cell, and so must the mean of each child. Children
    with a plane of their own must have the same normal, and their planes must contain the means of
    each other: a step at the border of two children tilts the plane of the cell, but not theirs.
    Tolerances add SIGMAS standard errors.
    """
    start, stop = ends[index, 0], ends[index + 1, 0] - 1
    n, e0, e1 = shapes[N, stop], shapes[E0, stop], shapes[E0 + 1, stop]
    variance = (n - 1.0) * e0 / max(n - 3.0, 1.0)
    if variance > thickness * thickness:
        return MIXED
    offset, noise = MAX_OFFSET * thickness, MIN_NOISE * thickness
    variance = max(variance, noise * noise)
    for i in range(ends[index, 1], ends[index + 1, 1]):
        mean = few[0, i], few[1, i], few[2, i]
        if is_beyond(shapes, stop, mean, variance / few[3, i], offset):
            return MIXED
    for i in range(start, stop):
        mean = shapes[MEAN, i], shapes[MEAN + 1, i], shapes[MEAN + 2, i]
        if is_beyond(shapes, stop, mean, variance / shapes[N, i], offset):
            return MIXED
    spread_sq = CHILD_SPREAD * 0.25 * size * size
    for i in range(start, stop):
        m, f1, f2 = shapes[N, i], shapes[E0 + 1, i], shapes[E0 + 2, i]
        own = max((m - 1.0) * shapes[E0, i] / (m - 3.0), noise * noise)
        first, second = f1 - own, f2 - own
        error_sq = own / m * (f1 / (first * first) + f2 / (second * second))
        has_plane = f1 > max(spread_sq, own)
        shapes[ERROR, i] = error_sq if has_plane else -1.0
        dot = shapes[NORMAL, i] * shapes[NORMAL, stop]
        dot += shapes[NORMAL + 1, i] * shapes[NORMAL + 1, stop]
        dot += shapes[NORMAL + 2, i] * shapes[NORMAL + 2, stop]
        sine = math.sqrt(max(1.0 - dot * dot, 0.0)) - MAX_SINE
        if has_plane and sine > 0.0 and sine * sine > SIGMAS * SIGMAS * error_sq:
            return MIXED
    for i in range(start, stop):
        for j in range(start, stop):
            if i != j and shapes[ERROR, i] >= 0.0 and shapes[ERROR, j] >= 0.0:
                mean = shapes[MEAN, j], shapes[MEAN + 1, j], shapes[MEAN + 2, j]
                dx, dy, dz = (
                    shapes[MEAN, i] - mean[0],
                    shapes[MEAN + 1, i] - mean[1],
                    shapes[MEAN + 2, i] - mean[2],
                )
                error_sq = ((dx * dx + dy * dy) + dz * dz) * shapes[ERROR, i]
                error_sq += variance / shapes[N, i] + variance / shapes[N, j]
                if is_beyond(shapes, i, mean, error_sq, offset):
                    return MIXED
    num_children = stop - start + ends[index + 1, 1] - ends[index, 1]
    is_plane = n >= MIN_POINTS and e1 >= MIN_SPREAD * size * size and num_children > 1
    return PLANE if is_plane else 0


@njit(cache=True, nogil=True, inline='always')
def is_beyond(shapes, plane, mean, error_sq, offset):
    """Return whether a mean, of a squared standard error, is off the plane of a column."""
    x = (mean[0] - shapes[MEAN, plane]) * shapes[NORMAL, plane]
    y = (mean[1] - shapes[MEAN + 1, plane]) * shapes[NORMAL + 1, plane]
    z = (mean[2] - shapes[MEAN + 2, plane]) * shapes[NORMAL + 2, plane]
    distance = abs((x + y) + z) - offset
    return distance > 0.0 and distance * distance > SIGMAS * SIGMAS * error_sq


@kernel()
def compare(roots, levels, min_points, voxels, cells, children, outputs):
    """
    Compare the cut below dirty roots with the one reported last; return the numbers of outputs.

    roots       (K,) int32, dirty cells of the highest level
    min_points  nodes of fewer points are left out
    outputs     changed voxels (V,) int32, changed cells (C,) int32, both rows; gone voxels (V,)
                int64, gone cells (C,) int64, both keys; the first num_gone of the former exist
    """
    rows, _, links, _ = voxels
    cell_rows, stamps, cell_links, _ = cells
    changed_voxels, changed_cells, gone_voxels, gone_cells, numbers = outputs
    flat, cell_flat = rows.ravel(), cell_rows.ravel()
    stack = np.empty((8 * levels + 8, 3), np.int64)
    for root in roots:
        depth = 1
        stack[0, 0], stack[0, 1], stack[0, 2] = root, levels, 0
        while depth:
            depth -= 1
            cell, level, is_hidden = stack[depth, 0], stack[depth, 1], stack[depth, 2]
            flags, link, at = (
                np.int64(stamps[cell, STAMP]),
                cell_links[cell, LINK],
                first_word(cell),
            )
            is_plane = flags & PLANE
            shown = is_plane & (1 - is_hidden) & (count_of(cell_flat, at) >= min_points)
            if shown and link & (SHOWN | DIRTY) != SHOWN:
                changed_cells[numbers[1]] = cell
                numbers[1] += 1
            if link & SHOWN and not shown:
                gone_cells[numbers[3]] = cell_flat[at + U(KEY)]
                numbers[3] += 1
            cell_links[cell, LINK] = (link & ~SHOWN) | shown
            hid, hides = (flags & HIDES) // HIDES, is_plane | is_hidden
            stamps[cell, STAMP] = (flags & ~HIDES) | hides * HIDES
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
def clean(dirty, level, cells, children, table, state):
    """Mark dirty cells of a level as clean, and free the empty ones."""
    cell_rows, stamps, links, _ = cells
    flat = cell_rows.ravel()
    for cell in dirty:
        links[cell, LINK] &= ~DIRTY
        at = first_word(cell)
        if count_of(flat, at) > 0:
            continue
        key, parent = flat[at + U(KEY)], (links[cell, LINK] >> LINK_BITS) - 1
        if parent >= 0:
            children[parent, octant_of(key, level)] = 0
        links[cell, LINK] = 0
        stamps[cell, STAMP] = stamps[cell, SCANS] = 0
        remove_row(key, np.int64(cell), table, state[DEPTH])
        free_row(flat, at, state[FREE_ROW], np.int64(-1))
        state[FREE_ROW] = cell


@kernel()
def clean_voxels(changed, links):
    """Mark changed voxels as clean."""
    for row in changed:
        links[row, LINK] &= ~DIRTY


@kernel()
def shown_rows(links, num):
    """Return the rows of the first num whose nodes are in the cut, (K,) int32."""
    kept = np.empty(num, np.int32)
    number = 0
    for row in range(num):
        kept[number] = row
        number += links[row, LINK] & SHOWN
    return kept[:number].copy()


@kernel()
def copy_rows(rows, chosen, level, copies):
    """Copy rows of a level, 0 for voxels, to (K, 12) int64, cells keyed by index >> level."""
    for index in range(len(chosen)):
        for column in range(ROW):
            copies[index, column] = rows[chosen[index], column]
        if level:
            x, y, z = unpack(copies[index, KEY])
            copies[index, KEY] = pack(x >> level, y >> level, z >> level)
