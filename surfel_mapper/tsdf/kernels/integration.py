# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Fuse a range image into blocks of a truncated signed distance field.

Voxels are projected into the image, not pixels into the voxels: each voxel is written once, so
blocks can be divided among threads and the result does not depend on their number. A block is
processed in passes over all of its voxels, plain loops over a few rows of float32 that compile to
vector instructions; only the look-up in the image is scalar. The rows of one block fit the L1
cache.

The field of a block is two rows of float32: the distance, positive in front of a surface and
negative behind it, and the weight, 0 for voxels never observed.

A measurement that contradicts a voxel (it differs by half a voxel or more: a wall is gone, or an
object has come) counts at least the share ``rate``, however heavy the voxel is; colours and
labels always count that share. 0 never forgets.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.prefetch import prefetch
from surfel_mapper.tsdf.kernels.channels import (
    apply_mask,
    fuse_color,
    fuse_labels,
    SKIP,
    vote_labels,
)
from surfel_mapper.tsdf.kernels.lookup import (
    CONTRADICTS,
    DROPOFF,
    gather,
    locate,
    MAX_RANGE,
    MAX_WEIGHT,
    MIN_WEIGHT,
    mix,
    TAU,
)
from surfel_mapper.tsdf.kernels.projection import project

_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_MICROMETRES = np.float32(1e6)

# Columns of the figures that the fusion of a block returns.
OBSERVED = 0
"""Voxels fused."""
MOVED = 1
"""Largest change of a distance, micrometres, or JUMP."""
SOLID = 2
"""Observed voxels whose distance is below the truncation; set if any was fused."""
INSIDE = 3
"""Observed voxels behind a surface; set if any was fused."""
OPPOSED = 4
"""Measurements of another, farther surface on the other side; of points only."""
NEAR = 5
"""Voxels near surfaces; of points only."""
NUM_FOUND = 6

FLOATS_PER_LINE = 16
"""float32 numbers in a line of the cache."""

JUMP = np.int32(2**31 - 1)
"""Change of a block whose triangles differ in number."""


@njit(cache=True, nogil=True, error_model='numpy')
def integrate_blocks(blocks, offsets, field, sensor, images, settings, channels, figures):
    """
    Fuse a range image into blocks.

    blocks    (rows, corners, rates) of K blocks: (K,) int64, their rows; (K, 3) float32 m,
              centres of their first voxels in the sensor's frame; (K,) float32, least shares of
              contradicting measurements, in [0, 1)
    offsets   (3, N) float32 m, from the first voxel to every voxel, x fastest
    field     (R, 2, N) float32, distance and weight of all blocks
    sensor    (6,) float32, see tsdf/kernels/projection.py
    images    (pairs, color, label, mask): pairs, as gather takes them, with their BORDER; see
              fuse_color, vote_labels, apply_mask; missing images have
              no rows
    settings  (NUM_SETTINGS,) float32
    channels  (color, votes): rows of all blocks, no rows for channels not kept
    figures   (K, NUM_FOUND) int64, out: see OBSERVED, MOVED, SOLID, INSIDE
    """
    num_voxels = offsets.shape[1]
    scratch = np.empty((10, num_voxels), np.float32)
    x, y, z, distance = scratch[0], scratch[1], scratch[2], scratch[3]
    u, v, signed, weight = scratch[4], scratch[5], scratch[6], scratch[7]
    value, fused = scratch[8], scratch[9]
    upper, lower = np.empty(num_voxels, np.int64), np.empty(num_voxels, np.int64)
    pixel = np.empty(num_voxels, np.int32)
    mixed, label = np.empty(num_voxels, np.uint8), np.empty(num_voxels, np.int32)
    pairs, color_image, label_image, mask = images
    stride = pairs.shape[1]
    color, votes = channels
    rows, corners, rates = blocks
    tau, most = settings[TAU], settings[MAX_WEIGHT]
    for b in range(len(rows)):
        row, rate = rows[b], rates[b]
        if b + 1 < len(rows):
            prefetch_block(field.ravel(), field[0].size * rows[b + 1], field[0].size)
        shift(offsets[0], corners[b, 0], x)
        shift(offsets[1], corners[b, 1], y)
        shift(offsets[2], corners[b, 2], z)
        project(x, y, z, sensor, distance, u, v)
        locate(distance, u, v, stride, settings, pixel)
        gather(pairs.ravel(), stride, pixel, upper, lower)
        mix(upper.view(np.float32), lower.view(np.float32), u, v, settings, value)
        subtract(value, distance, settings, signed)
        count = count_observed(signed)
        if count > 0 and mask.shape[0] > 0:
            flag_mixed(value, mixed)
            count -= apply_mask(mask, tau, u, v, mixed, signed)
        if count > 0 and label_image.shape[0] > 0:
            flag_mixed(value, mixed)
            vote_labels(label_image, tau, u, v, mixed, signed, label)
        figures[b, OBSERVED] = count
        if count == 0:
            figures[b, MOVED] = 0
            continue
        weigh(z, signed, settings, weight)
        if label_image.shape[0] > 0 and votes.shape[0] > 0:
            fuse_labels(tau, most, rate, label, signed, weight, votes[row])
        if color.shape[0] > 0 and color_image.shape[0] > 0:
            flag_mixed(value, mixed)
            bounds = tau, most, rate
            fuse_color(color_image, bounds, u, v, mixed, signed, weight, color[row])
        mean, total = field[row, 0], field[row, 1]
        fuse(signed, weight, settings[CONTRADICTS], rate, mean, total, fused)
        figures[b, MOVED] = largest_step(mean, fused, total, weight, settings[MIN_WEIGHT])
        replace(fused, weight, most, mean, total)
        figures[b, SOLID], figures[b, INSIDE] = count_solid(mean, total, tau)


@njit(cache=True, nogil=True, error_model='numpy')
def prefetch_block(flat, first, size):
    """Prefetch the field of a block while the one before is fused."""
    for n in range(first, first + size, FLOATS_PER_LINE):
        prefetch(flat, n)


@njit(cache=True, nogil=True, error_model='numpy')
def shift(values, by, shifted):
    """Add a number to all values."""
    for n in range(len(values)):
        shifted[n] = values[n] + by


@njit(cache=True, nogil=True, error_model='numpy')
def subtract(value, distance, settings, signed):
    """Find the signed distance of every voxel, (N,) float32 m; SKIP if it is not observed."""
    tau, reach = settings[TAU], settings[MAX_RANGE]
    for n in range(len(value)):
        range_m, d = abs(value[n]), distance[n]
        s = range_m - d
        # A clearing pixel says nothing beyond the range of the sensor.
        observed = (range_m > _ZERO) & (s >= -tau) & ((range_m <= reach) | (d <= reach))
        signed[n] = min(max(s, -tau), tau) if observed else SKIP


@njit(cache=True, nogil=True, error_model='numpy')
def count_observed(signed):
    """Return the number of observed voxels."""
    count = np.int32(0)
    for n in range(len(signed)):
        count += np.int32(signed[n] > SKIP)
    return np.int64(count)


@njit(cache=True, nogil=True, error_model='numpy')
def flag_mixed(value, mixed):
    """Flag the voxels whose range was interpolated from four pixels."""
    for n in range(len(value)):
        mixed[n] = value[n] > _ZERO


@njit(cache=True, nogil=True, error_model='numpy')
def weigh(depth, signed, settings, weight):
    """
    Compute the weight of every measurement, 0 for voxels not observed.

    depth, signed, weight  (N,) float32; weight is written
    """
    least, tau, dropoff = settings[MIN_WEIGHT], settings[TAU], settings[DROPOFF]
    for n in range(len(weight)):
        weight[n] = _ONE / (depth[n] * depth[n])
    per_metre = _ONE / (tau - dropoff)
    for n in range(len(weight)):
        s = signed[n]
        weight[n] = weight[n] * ((tau + s) * per_metre) if s < -dropoff else weight[n]
    for n in range(len(weight)):
        w = weight[n] if weight[n] > least else least
        weight[n] = w if signed[n] > SKIP else _ZERO


@njit(cache=True, nogil=True, error_model='numpy')
def fuse(signed, weight, contradicts, rate, mean, total, fused):
    """
    Find the mean distances after weighted measurements.

    signed, weight, mean, total  (N,) float32
    contradicts, rate            least share of measurements that differ by so much, m, or more
    fused                        (N,) float32, out
    """
    for n in range(len(mean)):
        # In this form a first measurement, or one equal to the mean, is exact.
        gain = weight[n] / (total[n] + weight[n])
        step = signed[n] - mean[n]
        gain = rate if (abs(step) >= contradicts) & (gain < rate) else gain
        value = mean[n] + step * gain
        fused[n] = value if weight[n] > _ZERO else mean[n]


@njit(cache=True, nogil=True, error_model='numpy')
def largest_step(mean, fused, total, weight, least):
    """
    Return the largest change of a distance, micrometres.

    JUMP if a sign changes, or a voxel reaches the least weight of the mesh: the triangles differ.
    """
    largest = np.int32(0)
    for n in range(len(mean)):
        step = np.int32(abs(fused[n] - mean[n]) * _MICROMETRES)
        flips = (mean[n] < _ZERO) != (fused[n] < _ZERO)
        enters = (total[n] < least) & (total[n] + weight[n] >= least)
        step = JUMP if flips | enters else step
        largest = max(largest, step)
    return np.int64(largest)


@njit(cache=True, nogil=True, error_model='numpy')
def replace(fused, weight, max_weight, mean, total):
    """Write the fused distances and add the weights, in place."""
    for n in range(len(mean)):
        mean[n] = fused[n]
    for n in range(len(mean)):
        together = total[n] + weight[n]
        total[n] = together if together < max_weight else max_weight


@njit(cache=True, nogil=True, error_model='numpy')
def count_solid(mean, total, tau):
    """Return the number of observed voxels that are not free, and of those behind a surface."""
    solid, inside = np.int32(0), np.int32(0)
    for n in range(len(mean)):
        solid += np.int32((total[n] > _ZERO) & (mean[n] < tau))
    for n in range(len(mean)):
        inside += np.int32((total[n] > _ZERO) & (mean[n] < _ZERO))
    return np.int64(solid), np.int64(inside)
