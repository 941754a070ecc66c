# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Fuse the cells of a scan into voxels; see kernels/point_cells.py for cells.

Near a surface the distance of a voxel is its distance from the plane of a cell, not the distance
along the ray: at an angle of incidence of 60 deg the latter is twice as long. A cell observes the
voxels in a cylinder about its mean: DISC voxels to the sides, in front of the surface up to the
truncation, and behind it as far as marching cubes needs, no farther: |nx| + |ny| + |nz| voxels.
So both faces of a wall of two voxels are right, however large the truncation is.

Free space is known one bit a voxel. Rays are walked from the truncation before the surface towards
the sensor. A free voxel becomes known as free, and loses a surface behind which it was, but a
voxel in front of a surface keeps its distance: a ray that passes does not tell how far the next
surface is. Its weight fades, and with it the surface, unless later scans meet it again. Voxels
near a surface of the same scan are not freed, so thin objects survive the rays that pass them.

The blocks of a scan have numbers of their own, in a table as those of cells. All lengths are in
voxels except where m is stated; a block has 2^bits voxels a side.

Sources: Oleynikova et al. 2017 (voxblox) for merged rays, Pan et al. 2022 (Voxfield) for distances
from planes, Amanatides and Woo 1987 for the traversal.
"""

import math

from numba import njit
import numpy as np

from surfel_mapper.kernels.hashing import DEPTH
from surfel_mapper.kernels.quantisation import pack
from surfel_mapper.tsdf.kernels.block_marks import walk
from surfel_mapper.tsdf.kernels.channels import vote
from surfel_mapper.tsdf.kernels.integration import (
    INSIDE,
    JUMP,
    MOVED,
    NEAR,
    OBSERVED,
    OPPOSED,
    prefetch_block,
    SOLID,
)
from surfel_mapper.tsdf.kernels.lookup import CONTRADICTS, MAX_WEIGHT, MIN_WEIGHT, TAU
from surfel_mapper.tsdf.kernels.point_cells import (
    COSINE,
    entry_of,
    number_of,
    RANGE,
    WEIGHT,
)
from surfel_mapper.tsdf.kernels.queries import find_voxel

DISC = 0.85
"""Voxels up to this far beside the mean of a cell are observed: half the diagonal of a voxel."""

EDGE = 0.8
"""Share of its weight that a measurement has lost at the edge of the disc."""

LEAST_SHARE = np.float32(0.02)
"""Least share of the weight of a cell at the ends of its cylinder."""

MOST_FREED = 2
"""A ray ends after more voxels in a row that other rays of the scan have freed."""

FADING = 4
"""Ratio of the rates at which the weight in front of a surface fades and its distance moves. A
weight of MEMORY scans at 1 m falls to the least weight within forget_s."""

MEMORY = np.float32(16.0)
"""Largest weight of a voxel, in scans like the last, if surfaces are forgotten."""

_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)


@njit(cache=True, nogil=True)
def enter_keys(keys, table):
    """Enter the keys of blocks into an empty table, numbered in order."""
    for number in range(len(keys)):
        entry = entry_of(keys[number], table)
        table[entry, 0], table[entry, 1] = keys[number], number


@njit(cache=True, nogil=True)
def cylinder(cell, tau, low, high):
    """
    Find the voxels about the cylinder of a cell.

    cell       (CELL,) float64
    low, high  (3,) int64, out: first and last index along each axis

    Returns how far behind the surface voxels are observed.
    """
    behind = abs(cell[3]) + abs(cell[4]) + abs(cell[5])
    for axis in range(3):
        along = cell[3 + axis]
        aside = DISC * math.sqrt(max(0.0, 1.0 - along * along))
        first, last = cell[axis] - behind * along, cell[axis] + tau * along
        low[axis] = np.int64(math.ceil(min(first, last) - aside - 0.5))
        high[axis] = np.int64(math.floor(max(first, last) + aside - 0.5))
    return behind


@njit(cache=True, nogil=True)
def list_pairs(cells, start, tau, bits, table, keys, number, pairs, num_pairs):
    """
    List the blocks that each cell observes.

    cells      (K, CELL) float64
    start      the first cell to take
    table      (T, 2) int64, in and out: numbers of blocks
    keys       (T / 2,) int64, in and out: of the blocks
    number     of blocks so far
    pairs      (P, 2) int32, out: block and cell
    num_pairs  of pairs so far

    Returns the numbers of blocks and of pairs, and the first cell that is not done: enlarge table
    and pairs then.
    """
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for cell in range(start, len(cells)):
        cylinder(cells[cell], tau, low, high)
        more = 1
        for axis in range(3):
            more *= (high[axis] >> bits) - (low[axis] >> bits) + 1
        if number + more > len(keys) or num_pairs + more > len(pairs):
            return number, num_pairs, cell
        for c in range(low[2] >> bits, (high[2] >> bits) + 1):
            for b in range(low[1] >> bits, (high[1] >> bits) + 1):
                for a in range(low[0] >> bits, (high[0] >> bits) + 1):
                    block, number = number_of(pack(a, b, c), table, keys, number)
                    pairs[num_pairs, 0], pairs[num_pairs, 1] = block, cell
                    num_pairs += 1
    return number, num_pairs, len(cells)


@njit(cache=True, nogil=True)
def group_pairs(pairs, first, grouped):
    """
    Group cells by block.

    pairs    (P, 2) int32
    first    (B + 1,) int64, in: zeros; out: first place of each block in grouped
    grouped  (P,) int32, out: cells, in order
    """
    for p in range(len(pairs)):
        first[pairs[p, 0] + 1] += 1
    for block in range(len(first) - 1):
        first[block + 1] += first[block]
    for p in range(len(pairs)):
        block = pairs[p, 0]
        grouped[first[block]] = pairs[p, 1]
        first[block] += 1
    for block in range(len(first) - 1, 0, -1):
        first[block] = first[block - 1]
    first[0] = 0


@njit(cache=True, nogil=True, error_model='numpy')
def free_rays(cells, start, origin, limits, bits, table, keys, number, freed):
    """
    Free the voxels between the cells and the sensor.

    cells   (K, CELL) float64
    start   the first cell to take
    origin  (3,) float64, the sensor
    limits  (near, far, tau): ranges between which voxels are freed, and the truncation
    table   (T, 2) int64, in and out: numbers of blocks
    keys    (T / 2,) int64, in and out: of the blocks
    number  of blocks so far
    freed   (T / 2, N / 64) int64, in and out: one bit a voxel

    Returns the number of blocks, and the first cell that is not done: enlarge the table then.
    """
    near, far, tau = limits
    mask, most = (1 << bits) - 1, len(keys)
    for cell in range(start, len(cells)):
        row = cells[cell]
        measured = row[RANGE]
        end = min(measured - tau / row[COSINE], far)
        if end <= near:
            continue
        x, y, z = row[0] - origin[0], row[1] - origin[1], row[2] - origin[2]
        x, y, z = x / measured, y / measured, z / measured
        px, py, pz = origin[0] + end * x, origin[1] + end * y, origin[2] + end * z
        i, tx, ux, sx, nx = walk(px, -x, 0.0, end - near, 1)
        j, ty, uy, sy, ny = walk(py, -y, 0.0, end - near, 1)
        k, tz, uz, sz, nz = walk(pz, -z, 0.0, end - near, 1)
        if number + (nx + ny + nz) // (1 << bits) + 4 > most:
            return number, cell
        num_freed, block = 0, -1
        a, b, c = i >> bits, j >> bits, (k >> bits) + 1
        for _ in range(nx + ny + nz + 1):
            if i >> bits != a or j >> bits != b or k >> bits != c:
                a, b, c = i >> bits, j >> bits, k >> bits
                block, number = number_of(pack(a, b, c), table, keys, number)
            voxel = (i & mask) | (j & mask) << bits | (k & mask) << 2 * bits
            word, bit = freed[block, voxel >> 6], np.int64(1) << (voxel & 63)
            num_freed = num_freed + 1 if word & bit else 0
            if num_freed > MOST_FREED:
                break
            freed[block, voxel >> 6] = word | bit
            if tx <= ty and tx <= tz:
                i += sx
                nx -= 1
                tx = tx + ux if nx > 0 else np.inf
            elif ty <= tz:
                j += sy
                ny -= 1
                ty = ty + uy if ny > 0 else np.inf
            else:
                k += sz
                nz -= 1
                tz = tz + uz if nz > 0 else np.inf
    return number, len(cells)


@njit(cache=True, nogil=True, error_model='numpy')
def sum_cells(grouped, cells, corner, tau, layer_xy, sums, row):
    """
    Sum the distances that cells give to the voxels of a block, and prefetch those voxels.

    grouped  (P,) int32, the cells that observe the block
    cells    (K, CELL) float64
    corner   (3,) int64, index of the block's first voxel
    layer_xy   (2, M^2) float32, index along x and y of the voxels of a layer
    sums     (2, M, M^2) float32, in: 0; out: weighted distances, voxels, and weights, by layer
    row      (2 N,) float32, the field of the block

    All voxels of a layer between two lines are computed without branches, which is vectorised:
    half of them are in the cylinder, so branches would be mispredicted. Prefetching whole blocks
    takes twice as many lines of the cache, and a sixth more time at 0.1 m.
    """
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    most, per_square = np.float32(DISC * DISC), np.float32(EDGE / (DISC * DISC))
    side, tau = sums.shape[1], np.float32(tau)
    per_front = _ONE / tau
    for n in range(len(grouped)):
        cell = cells[grouped[n]]
        behind = -np.float32(cylinder(cell, tau, low, high))
        nx, ny, nz = np.float32(cell[3]), np.float32(cell[4]), np.float32(cell[5])
        first_x = np.float32(corner[0] + 0.5 - cell[0])
        first_y = np.float32(corner[1] + 0.5 - cell[1])
        first_z = np.float32(corner[2] + 0.5 - cell[2])
        full, per_behind = np.float32(cell[WEIGHT]), _ONE / behind
        first = max(low[1] - corner[1], 0) * side
        last = (min(high[1] - corner[1], side - 1) + 1) * side
        across, along = layer_xy[0, first:last], layer_xy[1, first:last]
        for k in range(max(low[2] - corner[2], 0), min(high[2] - corner[2], side - 1) + 1):
            distances, weights = sums[0, k, first:last], sums[1, k, first:last]
            z = first_z + np.float32(k)
            for start in (k * side * side, len(row) // 2 + k * side * side):
                prefetch_block(row, start + first, last - first)
            for i in range(len(distances)):
                x, y = first_x + across[i], first_y + along[i]
                signed = nx * x + ny * y + nz * z
                aside = x * x + y * y + z * z - signed * signed
                share = _ONE - max(signed * per_front, signed * per_behind)
                weight = full * max(share, LEAST_SHARE) * (_ONE - aside * per_square)
                observed = (aside <= most) & (signed <= tau) & (signed >= behind)
                weight = weight if observed else _ZERO
                distances[i] += weight * signed
                weights[i] += weight


@njit(cache=True, nogil=True, error_model='numpy')
def fuse_blocks(blocks, cells, origin, settings, voxel_m, bits, field, figures):
    """
    Fuse a scan into blocks, each voxel once.

    blocks    (rows, corners, rates, ends, freed): (B,) int64, rows in the map; (B, 3) int64, index
              of the first voxel; (B,) float32, least share of contradicting measurements; (B, 2)
              int64, first and last place of its cells in grouped; (B, N / 64) int64, one bit a
              free voxel, changed
    cells     (grouped, cells): (P,) int32 and (K, CELL) float64
    origin    (3,) float64, the sensor
    settings  (NUM_SETTINGS,) float32, see kernels/lookup.py
    field     (R, 2, N) float32
    figures   (B, NUM_FOUND) int64, in and out: as of integrate_blocks; INSIDE is that so far,
              SOLID 0 if nothing changed
    """
    rows, corners, rates, ends, freed = blocks
    grouped, cells = cells
    num_voxels, tau = field.shape[2], settings[TAU] / voxel_m
    side = 1 << bits
    layer = np.arange(side * side)
    layer_xy = np.stack((layer & (side - 1), layer >> bits)).astype(np.float32)
    by_layer = np.zeros((2, side, side * side), np.float32)
    sums = by_layer.reshape(2, num_voxels)
    observed = np.empty(num_voxels + 1, np.int64)
    flat, block_size = field.ravel(), 2 * num_voxels
    for b in range(len(rows)):
        if b + 1 < len(rows) and ends[b + 1, 0] == ends[b + 1, 1]:
            prefetch_block(flat, block_size * rows[b + 1], block_size)
        content = field[rows[b], 0], field[rows[b], 1], figures[b]
        figures[b, OBSERVED] = figures[b, MOVED] = figures[b, SOLID] = figures[b, NEAR] = 0
        near = grouped[ends[b, 0] : ends[b, 1]]
        if len(near):
            sums[:] = 0.0
            row = flat[block_size * rows[b] : block_size * (rows[b] + 1)]
            sum_cells(near, cells, corners[b], tau, layer_xy, by_layer, row)
            fuse_sums(sums, observed, settings, voxel_m, rates[b], freed[b], content)
        free_voxels(freed[b], corners[b], origin, settings, voxel_m, bits, rates[b], content)


@njit(cache=True, nogil=True, error_model='numpy')
def fuse_sums(sums, observed, settings, voxel_m, rate, freed, content):
    """Fuse the distances of a scan into the voxels of a block; observed has room for N + 1."""
    mean, total, figures = content
    least, tau, contradicts = settings[MIN_WEIGHT], settings[TAU], settings[CONTRADICTS]
    voxel_m, keeps = np.float32(voxel_m), _ONE - rate
    number = largest = inside = 0
    for n in range(len(mean)):  # without branches
        observed[number] = n
        number += sums[1, n] > _ZERO
    for n in observed[:number]:
        freed[n >> 6] &= ~(np.int64(1) << (n & 63))
        weight, last, so_far = sums[1, n], mean[n], total[n]
        value = sums[0, n] / weight * voxel_m
        most = max(so_far, MEMORY * weight) if rate > _ZERO else settings[MAX_WEIGHT]
        weight = max(weight, least)
        opposed = ((value < _ZERO) != (last < _ZERO)) & (last < tau) & (so_far > _ZERO)
        if opposed & (abs(value) > abs(last)) & (abs(value - last) > contradicts):
            figures[OPPOSED] += 1
            so_far = total[n] = max(so_far * keeps, least)
            if so_far > np.float32(0.25) * weight:
                continue
        moved = last + (value - last) * (weight / (so_far + weight))
        together = min(so_far + weight, most, settings[MAX_WEIGHT])
        step, change = replace(n, moved, together, least, mean, total)
        largest, inside = max(largest, step), inside + change
    figures[NEAR] = figures[OBSERVED] = figures[SOLID] = number
    figures[MOVED], figures[INSIDE] = largest, figures[INSIDE] + inside


@njit(cache=True, nogil=True, error_model='numpy')
def free_voxels(freed, corner, origin, settings, voxel_m, bits, rate, content):
    """
    Fuse that rays have crossed voxels.

    freed    (N / 64,) int64, one bit a voxel
    content  (mean, total, figures): (N,) float32, in and out, distances and weights of the block;
             (NUM_FOUND,) int64, in and out
    """
    mean, total, figures = content
    tau_m, least = settings[TAU], settings[MIN_WEIGHT]
    for start in range(0, 64 * len(freed), 64):
        word = freed[start >> 6]
        if word == 0:
            continue
        signed, weights = mean[start : start + 64], total[start : start + 64]
        num_new = num_near = num_freed = 0
        for n in range(len(signed)):  # loops without branches are vectorised
            is_freed = word >> n & 1
            num_freed += is_freed
            num_new += is_freed & (weights[n] == 0.0)
            num_near += is_freed & (weights[n] > 0.0) & (signed[n] < tau_m)
        figures[OBSERVED] += num_freed
        if num_new > 0:
            for n in range(len(signed)):
                signed[n] = tau_m if (word >> n & 1) & (weights[n] == 0.0) else signed[n]
            for n in range(len(signed)):
                weights[n] = least if (word >> n & 1) & (weights[n] == 0.0) else weights[n]
            figures[MOVED], figures[SOLID] = JUMP, 1
        if num_near > 0:
            fade(word, start, corner, origin, settings, voxel_m, bits, rate, content)


@njit(cache=True, nogil=True, error_model='numpy')
def fade(word, start, corner, origin, settings, voxel_m, bits, rate, content):
    """Fuse that rays have crossed voxels near surfaces, of one word; see free_voxels."""
    mean, total, figures = content
    tau_m, least, mask = settings[TAU], settings[MIN_WEIGHT], (1 << bits) - 1
    keeps = np.float32(1.0) - rate
    for voxel in range(start, min(start + 64, len(mean))):
        if word >> (voxel & 63) & 1 == 0 or mean[voxel] >= tau_m:
            continue
        x = corner[0] + (voxel & mask) + 0.5 - origin[0]
        y = corner[1] + (voxel >> bits & mask) + 0.5 - origin[1]
        z = corner[2] + (voxel >> 2 * bits) + 0.5 - origin[2]
        new = np.float32(1.0 / ((x * x + y * y + z * z) * voxel_m * voxel_m))
        weight, moved = total[voxel], mean[voxel]
        faded = max(weight * keeps**FADING, least)
        if moved < 0.0:
            moved += (tau_m - moved) * max(new / (weight + new), rate)
        elif faded == least and rate > 0.0:
            moved = tau_m
        step, change = replace(voxel, moved, faded, least, mean, total)
        figures[MOVED], figures[SOLID] = max(figures[MOVED], step), 1
        figures[INSIDE] += change


@njit(cache=True, nogil=True, inline='always')
def replace(voxel, moved, weight, least, mean, total):
    """Write distance and weight of a voxel; return its step, see MOVED, and change of INSIDE."""
    last = mean[voxel]
    flips = ((moved < 0.0) != (last < 0.0)) | ((total[voxel] < least) & (least <= weight))
    step = np.int64(JUMP) if flips else np.int64(abs(moved - last) * 1e6)
    mean[voxel], total[voxel] = moved, weight
    return step, np.int64(moved < 0.0) - np.int64(last < 0.0)


@njit(cache=True, nogil=True, error_model='numpy')
def fuse_point_channels(points, weights, rates, max_weight, bits, lookup, slots, images, channels):
    """
    Fuse colour and label of each point into the eight voxels about it.

    points      (N, 3) float64, map frame
    weights     (N,) float32, 0 for points out of range
    rates       (K,) float32, least share of a measurement in a block
    max_weight  float32, largest weight of a colour, or of a vote
    images      (colors, labels): (N, 3 or 4) uint8, those whose fourth value is 0 have no colour;
                (N,) int32, -1 for unknown; no rows if not given
    channels    (color, votes), see kernels/channels.py; no rows if not kept
    """
    head, table, state = lookup
    colors, labels = images
    color, votes = channels
    recent, depth = np.array([1 << 40, 0, 0, -1]), state[DEPTH]
    for p in range(len(points)):
        w = weights[p]
        has_color = color.shape[0] > 0 and colors.shape[0] > 0
        has_color = has_color and (colors.shape[1] == 3 or colors[p, 3] != 0)
        has_label = votes.shape[0] > 0 and labels.shape[0] > 0 and labels[p] >= 0
        if w <= 0.0 or not (has_color or has_label):
            continue
        i = np.int64(np.floor(points[p, 0] - 0.5))
        j = np.int64(np.floor(points[p, 1] - 0.5))
        k = np.int64(np.floor(points[p, 2] - 0.5))
        for corner in range(8):
            a, b, c = i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2)
            row, voxel = find_voxel(a, b, c, bits, recent, head, table, depth)
            if row < 0 or slots[row] < 0:
                continue
            rate = rates[slots[row]]
            if has_color:
                together = color[row, 3, voxel] + w
                gain = max(w / together, rate)
                for channel in range(3):
                    change = np.float32(colors[p, channel]) - color[row, channel, voxel]
                    color[row, channel, voxel] += change * gain
                color[row, 3, voxel] = min(together, max_weight)
            if has_label:
                vote(labels[p], max_weight, rate, votes[row], voxel)
