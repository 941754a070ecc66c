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
from surfel_mapper.tsdf.kernels.channels import BINARY, FIRST_K, MAJORITY, vote_single, vote_slot
from surfel_mapper.tsdf.kernels.lookup import (
    DROPOFF,
    EXTRA,
    MAX_RANGE,
    MIN_RANGE,
    MIN_WEIGHT,
    TAU,
    WEIGHT,
)
from surfel_mapper.tsdf.kernels.queries import find_voxel

CORE = 1.0
"""Samples up to this far from the surface observe the eight voxels about them, voxels."""

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
def weight_at(depth_m, signed_m, settings, power):
    """Return the weight of a measurement at a depth and signed distance, m."""
    weight = np.float64(settings[WEIGHT])
    for _ in range(power):
        weight /= depth_m * depth_m
    tau, start = settings[TAU], settings[DROPOFF]
    if start < tau and signed_m < -start:
        weight *= max(tau + signed_m, 0.0) / (tau - start)
    return max(weight, settings[MIN_WEIGHT])


@njit(cache=True, nogil=True, error_model='numpy')
def sum_surfaces(points, origin, voxel_m, bits, settings, power, lookup, slots, sums):
    """
    Sum the measurements within the truncation of each point.

    points    (N, 3) float64, map frame; those out of range or not finite are skipped
    origin    (3,) float64, the sensor
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
    tau, behind = settings[TAU] / voxel_m, (settings[TAU] + settings[EXTRA]) / voxel_m
    near, far = settings[MIN_RANGE] / voxel_m, settings[MAX_RANGE] / voxel_m
    start_m, least = settings[DROPOFF], settings[MIN_WEIGHT]
    per_metre = 1.0 / (settings[TAU] - start_m) if start_m < settings[TAU] else 0.0
    start_m = start_m if start_m < settings[TAU] else np.inf
    mask = (1 << bits) - 1
    used = 0
    for p in range(len(points)):
        x, y, z = points[p, 0] - origin[0], points[p, 1] - origin[1], points[p, 2] - origin[2]
        measured = np.sqrt(x * x + y * y + z * z)
        if not near <= measured <= far:
            continue
        used += 1
        x, y, z = x / measured, y / measured, z / measured
        start, end = max(measured - tau, near), measured + behind
        i, tx, ix, sx, nx = walk(origin[0], x, start, end, 1)
        j, ty, iy, sy, ny = walk(origin[1], y, start, end, 1)
        k, tz, iz, sz, nz = walk(origin[2], z, start, end, 1)
        for _ in range(nx + ny + nz + 1):
            u, v, w = i + 0.5 - origin[0], j + 0.5 - origin[1], k + 0.5 - origin[2]
            signed = measured - (x * u + y * v + z * w)
            if abs(signed) > CORE:  # nearer voxels follow below
                row, voxel = find_voxel(i, j, k, bits, recent, head, table, depth)
                if row >= 0 and slots[row] >= 0 and signed >= -behind:
                    slot, signed_m = slots[row], min(max(signed, -tau), tau) * voxel_m
                    weight = weight_at((measured - signed) * voxel_m, signed_m, settings, power)
                    sums[slot, voxel, 0] += weight * signed_m
                    sums[slot, voxel, 1] += weight
                    sums[slot, voxel, 2] += 1.0
            if tx <= ty and tx <= tz:
                i += sx
                nx -= 1
                tx = tx + ix if nx > 0 else np.inf
            elif ty <= tz:
                j += sy
                ny -= 1
                ty = ty + iy if ny > 0 else np.inf
            else:
                k += sz
                nz -= 1
                tz = tz + iz if nz > 0 else np.inf
        last_i, last_j, last_k = i - 9, j, k
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
    for p in range(len(points)):
        x, y, z = points[p, 0] - origin[0], points[p, 1] - origin[1], points[p, 2] - origin[2]
        measured = np.sqrt(x * x + y * y + z * z)
        if not (near <= measured and measured < 1e9):
            continue
        x, y, z = x / measured, y / measured, z / measured
        end = min(measured - tau, far)
        if end <= near:
            continue
        u, v, w = origin[0] + end * x, origin[1] + end * y, origin[2] + end * z
        i, tx, ix, sx, nx = walk(u, -x, 0.0, end - near, 1)
        j, ty, iy, sy, ny = walk(v, -y, 0.0, end - near, 1)
        k, tz, iz, sz, nz = walk(w, -z, 0.0, end - near, 1)
        seen = 0
        for _ in range(nx + ny + nz + 1):
            row, voxel = find_voxel(i, j, k, bits, recent, head, table, depth)
            if row >= 0 and slots[row] >= 0 and sums[slots[row], voxel, 2] <= 0.0:
                seen = seen + 1 if sums[slots[row], voxel, 2] < 0.0 else 0
                if seen > MOST_SEEN:
                    break
                u, v, w = i + 0.5 - origin[0], j + 0.5 - origin[1], k + 0.5 - origin[2]
                ahead_m = max((x * u + y * v + z * w) * voxel_m, settings[MIN_RANGE])
                weight = weight_at(ahead_m, settings[TAU], settings, power)
                sums[slots[row], voxel, 0] += weight * settings[TAU]
                sums[slots[row], voxel, 1] += weight
                sums[slots[row], voxel, 2] -= 1.0
            if tx <= ty and tx <= tz:
                i += sx
                nx -= 1
                tx = tx + ix if nx > 0 else np.inf
            elif ty <= tz:
                j += sy
                ny -= 1
                ty = ty + iy if ny > 0 else np.inf
            else:
                k += sz
                nz -= 1
                tz = tz + iz if nz > 0 else np.inf


@njit(cache=True, nogil=True, error_model='numpy')
def fuse_sums(rows, sums, stamp, max_weight, field, stamps, observed):
    """
    Fuse the summed measurements of a scan into blocks: each voxel once, with its mean weight.

    rows      (K,) int64
    sums      (K, N, 3) float32
    stamp     int64 ns
    field     (R, 2, N) float32
    stamps    (R, 2, N) int64, or no rows
    observed  (K,) int64, out: number of voxels fused in each block
    """
    for slot in range(len(rows)):
        row = rows[slot]
        observed[slot] = 0
        for voxel in range(sums.shape[1]):
            if sums[slot, voxel, 2] == 0.0:
                continue
            value = sums[slot, voxel, 0] / sums[slot, voxel, 1]
            weight = sums[slot, voxel, 1] / abs(sums[slot, voxel, 2])
            total = field[row, 1, voxel]
            if stamps.shape[0] > 0:
                if total == 0.0:
                    stamps[row, 0, voxel] = stamp
                stamps[row, 1, voxel] = stamp
            mean = field[row, 0, voxel]
            field[row, 0, voxel] = mean + (value - mean) * (weight / (total + weight))
            field[row, 1, voxel] = min(total + weight, max_weight)
            observed[slot] += 1


@njit(cache=True, nogil=True, error_model='numpy')
def fuse_point_colors(points, colors, bits, weights, max_weight, lookup, slots, color):
    """
    Fuse the colour of each point into the eight voxels about it.

    points   (N, 3) float64, map frame; non-finite points are skipped
    colors   (N, 3 or 4) uint8; points whose fourth channel is 0 have no colour
    weights  (N,) float32, 0 for points out of range
    color    (R, 4, N) float32: red, green, blue and their weight
    """
    head, table, state = lookup
    recent, depth = np.array([1 << 40, 0, 0, -1]), state[DEPTH]
    for p in range(len(points)):
        w = weights[p]
        if w <= 0.0 or (colors.shape[1] > 3 and colors[p, 3] == 0):
            continue
        i = np.int64(np.floor(points[p, 0] - 0.5))
        j = np.int64(np.floor(points[p, 1] - 0.5))
        k = np.int64(np.floor(points[p, 2] - 0.5))
        for corner in range(8):
            a, b, c = i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2)
            row, voxel = find_voxel(a, b, c, bits, recent, head, table, depth)
            if row < 0 or slots[row] < 0:
                continue
            together = color[row, 3, voxel] + w
            for channel in range(3):
                change = np.float32(colors[p, channel]) - color[row, channel, voxel]
                color[row, channel, voxel] += change * (w / together)
            color[row, 3, voxel] = min(together, max_weight)


@njit(cache=True, nogil=True, error_model='numpy')
def fuse_point_labels(points, labels, semantics, bits, weights, lookup, slots, votes):
    """
    Fuse the label of each point into the eight voxels about it; return how many found no slot.

    labels   (N,) int32, -1 for unknown
    votes    (R, V, N) float32, see kernels/channels.py
    """
    head, table, state = lookup
    recent, depth = np.array([1 << 40, 0, 0, -1]), state[DEPTH]
    overflow = 0
    for p in range(len(points)):
        w, label = weights[p], labels[p]
        if w <= 0.0 or label < 0:
            continue
        i = np.int64(np.floor(points[p, 0] - 0.5))
        j = np.int64(np.floor(points[p, 1] - 0.5))
        k = np.int64(np.floor(points[p, 2] - 0.5))
        for corner in range(8):
            a, b, c = i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2)
            row, voxel = find_voxel(a, b, c, bits, recent, head, table, depth)
            if row < 0 or slots[row] < 0:
                continue
            if semantics == MAJORITY:
                if label < votes.shape[1]:
                    votes[row, label, voxel] += np.float32(1.0)
            elif semantics == FIRST_K:
                overflow += vote_slot(np.float32(label + 1), w, votes[row], voxel)
            elif semantics == BINARY:
                votes[row, 1 if label > 0 else 0, voxel] += np.float32(1.0)
            else:
                vote_single(np.float32(label + 1), w, votes[row], voxel)
    return overflow
