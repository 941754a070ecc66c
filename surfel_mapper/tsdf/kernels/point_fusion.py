# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Fuse points into voxels one ray at a time, for clouds without a projection model.

The measurements of one scan are first summed by voxel, then each voxel is fused once, so that a
scan counts as one observation, as in kernels/integration.py. Sums of a voxel:

    sums[slot, voxel, 0]  weighted signed distances, m
    sums[slot, voxel, 1]  weights
    sums[slot, voxel, 2]  number of rays; negative for rays that only pass through free space

Near a surface a ray observes the eight voxels about each of its samples, not only the voxels it
crosses: marching cubes needs all eight corners of a cube, which single rays of a sparse cloud
would never fill. Free rays do not touch voxels that were observed near a surface by the same scan,
so that thin objects survive the rays that pass beside them.

All lengths are in voxels except where m is stated; a block has 2^bits voxels a side.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.hashing import DEPTH
from surfel_mapper.tsdf.kernels.block_marks import walk
from surfel_mapper.tsdf.kernels.channels import vote
from surfel_mapper.tsdf.kernels.integration import INSIDE, JUMP, MOVED, OBSERVED, SOLID
from surfel_mapper.tsdf.kernels.lookup import (
    CONTRADICTS,
    DROPOFF,
    LEAST,
    MAX_RANGE,
    MAX_WEIGHT,
    MIN_RANGE,
    MIN_WEIGHT,
    TAU,
)
from surfel_mapper.tsdf.kernels.queries import find_voxel

CORE = 1.0
"""Samples up to this far from the surface observe the eight voxels about them, voxels."""

ASIDE = 0.87
"""Voxels about thin objects are observed up to this far from the ray: half a diagonal."""

STEP = 0.5
"""Distance of these samples, voxels."""

MOST_SEEN = 2
"""A free ray ends after more voxels in a row that were freed before."""


@njit(cache=True, nogil=True)
def mark_corners(points, origin, low, side, bits, limits, marks):
    """
    Mark the blocks of the voxels about the samples near each point.

    points  (N, 3) float64, map frame
    origin  (3,) float64, the sensor
    low     (3,) int64, block at the lower corner of the cube of marks
    limits  (smallest, largest) range of points that are marked
    marks   (side^3 / 64,) int64, one bit a block, z fastest
    """
    for p in range(len(points)):
        x, y, z = points[p, 0] - origin[0], points[p, 1] - origin[1], points[p, 2] - origin[2]
        measured = np.sqrt(x * x + y * y + z * z)
        if not limits[0] <= measured <= limits[1]:
            continue
        for sample in range(-2, 3):
            t = 1.0 + sample * STEP / measured
            i = np.int64(np.floor(origin[0] + t * x - 0.5))
            j = np.int64(np.floor(origin[1] + t * y - 0.5))
            k = np.int64(np.floor(origin[2] + t * z - 0.5))
            for corner in range(8):
                a = ((i + (corner & 1)) >> bits) - low[0]
                b = ((j + (corner >> 1 & 1)) >> bits) - low[1]
                c = ((k + (corner >> 2)) >> bits) - low[2]
                cell = (a * side + b) * side + c
                marks[cell >> 6] |= np.int64(1) << (cell & 63)


@njit(cache=True, nogil=True, error_model='numpy')
def begin_walk(origin, along, start, end, index, steps, reached, spacing):
    """
    Prepare the traversal of voxels from origin + start along to origin + end along.

    origin, along  (3,) float64
    index          (3,) int64, out: the first voxel
    steps          (2, 3) int64, out: direction and number of steps along each axis
    reached        (3,) float64, out: range at which the next voxel along each axis begins
    spacing        (3,) float64, out: range from voxel to voxel

    Returns the number of voxels.
    """
    number = 1
    for axis in range(3):
        stepping = walk(origin[axis], along[axis], start, end, 1)
        index[axis], reached[axis], spacing[axis], steps[0, axis], steps[1, axis] = stepping
        number += steps[1, axis]
    return number


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def next_voxel(index, steps, reached, spacing):
    """Go to the next voxel of a traversal, see begin_walk."""
    axis = 0 if reached[0] <= reached[1] and reached[0] <= reached[2] else 2
    if axis == 2 and reached[1] <= reached[2]:
        axis = 1
    index[axis] += steps[0, axis]
    steps[1, axis] -= 1
    reached[axis] = reached[axis] + spacing[axis] if steps[1, axis] > 0 else np.inf


@njit(cache=True, nogil=True, error_model='numpy')
def weight_at(depth_m, signed_m, settings, power):
    """Return the weight of a measurement at a depth and signed distance, m."""
    weight = 1.0
    if power > 0:
        weight /= depth_m * depth_m
    tau, start = settings[TAU], settings[DROPOFF]
    if signed_m < -start:
        weight *= max(tau + signed_m, 0.0) / (tau - start)
    return max(weight, settings[MIN_WEIGHT])


@njit(cache=True, nogil=True, error_model='numpy')
def sum_surfaces(points, origin, core_only, voxel_m, bits, settings, power, lookup, slots, sums):
    """
    Sum the measurements within the truncation of each point.

    points    (N, 3) float64, map frame; those out of range or not finite are skipped
    origin    (3,) float64, the sensor
    core_only whether only voxels about the surface are observed, not all up to the truncation
    voxel_m   float64, edge of a voxel, m
    settings  (NUM_SETTINGS,) float32, see kernels/lookup.py
    power     weights fall by depth^-(2 power)
    lookup    (head, table, state) of the map
    slots     (R,) int64, slot of each row in sums, -1 for none
    sums      (K, N, 3) float32, in and out

    Returns the number of points used.
    """
    head, table, state = lookup
    recent, depth = np.array([1 << 40, 0, 0, -1]), state[DEPTH]
    tau = settings[TAU] / voxel_m
    near, far = settings[MIN_RANGE] / voxel_m, settings[MAX_RANGE] / voxel_m
    start_m, least = settings[DROPOFF], settings[MIN_WEIGHT]
    per_metre = 1.0 / (settings[TAU] - start_m)
    mask = (1 << bits) - 1
    index, steps = np.empty(3, np.int64), np.empty((2, 3), np.int64)
    along, reached, spacing = np.empty(3), np.empty(3), np.empty(3)
    used = 0
    for p in range(len(points)):
        x, y, z = points[p, 0] - origin[0], points[p, 1] - origin[1], points[p, 2] - origin[2]
        measured = np.sqrt(x * x + y * y + z * z)
        if not near <= measured <= far:
            continue
        used += 1
        x, y, z = x / measured, y / measured, z / measured
        start, end = max(measured - tau, near), measured + tau
        if core_only:
            start = end = measured
        along[0], along[1], along[2] = x, y, z
        for _ in range(begin_walk(origin, along, start, end, index, steps, reached, spacing)):
            i, j, k = index[0], index[1], index[2]
            u, v, w = i + 0.5 - origin[0], j + 0.5 - origin[1], k + 0.5 - origin[2]
            signed = measured - (x * u + y * v + z * w)
            if abs(signed) > CORE:  # nearer voxels follow below
                row, voxel = find_voxel(i, j, k, bits, recent, head, table, depth)
                if row >= 0 and slots[row] >= 0 and signed >= -tau:
                    slot, signed_m = slots[row], min(max(signed, -tau), tau) * voxel_m
                    weight = weight_at((measured - signed) * voxel_m, signed_m, settings, power)
                    sums[slot, voxel, 0] += weight * signed_m
                    sums[slot, voxel, 1] += weight
                    sums[slot, voxel, 2] += 1.0
            next_voxel(index, steps, reached, spacing)
        last_i, last_j, last_k = index[0] - 9, 0, 0
        full = weight_at(measured * voxel_m, 0.0, settings, power)
        for sample in range(-2, 3):
            t = measured + sample * STEP
            i = np.int64(np.floor(origin[0] + t * x - 0.5))
            j = np.int64(np.floor(origin[1] + t * y - 0.5))
            k = np.int64(np.floor(origin[2] + t * z - 0.5))
            if i == last_i and j == last_j and k == last_k:
                continue
            last_i, last_j, last_k = i, j, k
            u, v, w = i + 0.5 - origin[0], j + 0.5 - origin[1], k + 0.5 - origin[2]
            first = measured - (x * u + y * v + z * w)
            row, number = find_voxel(i, j, k, bits, recent, head, table, depth)
            within = (i & mask) < mask and (j & mask) < mask and (k & mask) < mask
            for corner in range(8):
                a, b, c = corner & 1, corner >> 1 & 1, corner >> 2
                signed = first - (x * a + y * b + z * c)
                if abs(signed) > tau:
                    continue
                if core_only:
                    ahead = measured - signed
                    away = (u + a) ** 2 + (v + b) ** 2 + (w + c) ** 2 - ahead * ahead
                    if away > ASIDE * ASIDE:
                        continue
                voxel = number + a + (b << bits) + (c << 2 * bits)
                if not within:
                    row, voxel = find_voxel(i + a, j + b, k + c, bits, recent, head, table, depth)
                if row >= 0 and slots[row] >= 0:
                    slot, signed_m = slots[row], signed * voxel_m
                    weight = full
                    if signed_m < -start_m:
                        weight *= (settings[TAU] + signed_m) * per_metre
                    weight = max(weight, least)
                    sums[slot, voxel, 0] += weight * signed_m
                    sums[slot, voxel, 1] += weight
                    sums[slot, voxel, 2] += 1.0
    return used


@njit(cache=True, nogil=True, error_model='numpy')
def sum_free(points, origin, voxel_m, bits, settings, power, lookup, slots, sums):
    """
    Sum the observations of free space in front of each point; arguments as of sum_surfaces.

    Rays are walked from their end towards the sensor, where they are dense, and stop after
    MOST_SEEN voxels in a row that earlier rays of the scan have freed, as the fast integrator of
    voxblox does.
    """
    head, table, state = lookup
    recent, depth = np.array([1 << 40, 0, 0, -1]), state[DEPTH]
    tau = settings[TAU] / voxel_m
    near, far = settings[MIN_RANGE] / voxel_m, settings[MAX_RANGE] / voxel_m
    index, steps = np.empty(3, np.int64), np.empty((2, 3), np.int64)
    along, ends = np.empty(3), np.empty(3)
    reached, spacing = np.empty(3), np.empty(3)
    for p in range(len(points)):
        x, y, z = points[p, 0] - origin[0], points[p, 1] - origin[1], points[p, 2] - origin[2]
        measured = np.sqrt(x * x + y * y + z * z)
        if not (near <= measured and measured < 1e9):
            continue
        x, y, z = x / measured, y / measured, z / measured
        end = min(measured - tau, far)
        if end <= near:
            continue
        along[0], along[1], along[2] = -x, -y, -z
        for axis in range(3):
            ends[axis] = origin[axis] - end * along[axis]
        num_freed = 0
        for _ in range(begin_walk(ends, along, 0.0, end - near, index, steps, reached, spacing)):
            i, j, k = index[0], index[1], index[2]
            row, voxel = find_voxel(i, j, k, bits, recent, head, table, depth)
            if row >= 0 and slots[row] >= 0 and sums[slots[row], voxel, 2] <= 0.0:
                num_freed = num_freed + 1 if sums[slots[row], voxel, 2] < 0.0 else 0
                if num_freed > MOST_SEEN:
                    break
                u, v, w = i + 0.5 - origin[0], j + 0.5 - origin[1], k + 0.5 - origin[2]
                ahead_m = max((x * u + y * v + z * w) * voxel_m, settings[MIN_RANGE])
                weight = weight_at(ahead_m, settings[TAU], settings, power)
                sums[slots[row], voxel, 0] += weight * settings[TAU]
                sums[slots[row], voxel, 1] += weight
                sums[slots[row], voxel, 2] -= 1.0
            next_voxel(index, steps, reached, spacing)


@njit(cache=True, nogil=True, error_model='numpy')
def fuse_sums(rows, sums, rates, settings, field, figures):
    """
    Fuse the summed measurements of a scan into blocks: each voxel once, with its mean weight.

    rows      (K,) int64
    sums      (K, N, 3) float32
    rates     (K,) float32, least share of contradicting measurements
    settings  (NUM_SETTINGS,) float32, see kernels/lookup.py
    field     (R, 2, N) float32
    figures   (K, NUM_FOUND) int64, out: as of integrate_blocks
    """
    tau, least = settings[TAU], settings[LEAST]
    for slot in range(len(rows)):
        row = rows[slot]
        figures[slot] = 0
        for voxel in range(sums.shape[1]):
            mean, total = field[row, 0, voxel], field[row, 1, voxel]
            if sums[slot, voxel, 2] != 0.0:
                value = sums[slot, voxel, 0] / sums[slot, voxel, 1]
                weight = sums[slot, voxel, 1] / abs(sums[slot, voxel, 2])
                gain = weight / (total + weight)
                if abs(value - mean) >= settings[CONTRADICTS]:
                    gain = max(gain, rates[slot])
                fused = mean + (value - mean) * gain
                flips = (fused < 0.0) != (mean < 0.0) or total < least <= total + weight
                moved = JUMP if flips else np.int64(abs(fused - mean) * 1e6)
                figures[slot, MOVED] = max(figures[slot, MOVED], moved)
                figures[slot, OBSERVED] += 1
                mean, total = fused, min(total + weight, settings[MAX_WEIGHT])
                field[row, 0, voxel], field[row, 1, voxel] = mean, total
            if total > 0.0:
                figures[slot, SOLID] += mean < tau
                figures[slot, INSIDE] += mean < 0.0


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
                vote(labels[p], w, max_weight, rate, votes[row], voxel)
