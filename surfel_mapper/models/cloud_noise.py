# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Noise of the sensor that made a cloud, from the points of blocks of voxels about quadrics.

A quadric removes curvature, so that only noise remains. All blocks are fitted together by numpy:
there are at most 240, with 100 points each.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.growth import VoxelPoints
from surfel_mapper.models.joining import LEAST_COSINE

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

BLOCKS, BLOCK_POINTS = 120, 100
"""Blocks for the estimate of the noise, up to twice as many, and most points used in each."""

NOISE_BINS, NOISE_QUANTILE = 4, 0.3
"""Bins of range; the quantile is below the median, as edges add to the noise of a block."""

LEAST_ALONE, CLIPPED_VOXELS = 0.25, 0.1
"""Share of the voxels with enough points for an estimate of their own, and the most they tell."""

CLIPPING = 2.0
"""Correction of sigma by this times its square in voxels, for 5 to 15 mm at 3 cm within 10 %."""

LEAST_BLOCK = 20
"""Fewer points do not determine the noise of a block."""

TRIMMING_ROUNDS = 2
"""Fits of a block without its outliers; one leaves a tenth of outliers half of their effect."""

MEDIAN_TO_SIGMA = 1.4826
"""Sigma of normally distributed values by the median of their absolute values."""

LEAST_WIDTH = 0.1
"""A block with a smaller ratio of the tangential variances is a line."""

RIDGE = 1e-12
"""Added to the normal equations of a quadric, relative to the weight, for points in one line."""


def estimate_noise(
    voxels: VoxelPoints, means: Array, core: npt.NDArray[np.bool_], size_m: float, view: Array
) -> tuple[float, float]:
    """
    Return the noise of the points as n0, m, and n2, 1/m: sigma is n0 + n2 range^2.

    Single voxels clip noise of more than a tenth of a voxel. Blocks of three clip noise of more
    than a third (see CLIPPING), but they contain edges and corners, which are no noise.
    """
    rows = np.flatnonzero(core)
    seeds = rows[:: max(len(rows) // BLOCKS, 1)]
    range_sq = ((means[seeds] - view) ** 2).sum(axis=1)
    for alone in (True, False):
        blocks = seeds[:, None] if alone else neighbourhoods(voxels, seeds)
        sigma = block_noise(voxels, blocks, view)
        valid = sigma >= 0.0
        enough = valid.sum() >= max(LEAST_ALONE * len(seeds), 1.0)
        if alone and enough and np.median(sigma[valid]) < CLIPPED_VOXELS * size_m:
            break
    range_sq, sigma = range_sq[valid], sigma[valid]
    if not len(sigma):
        return 0.0, 0.0
    bins = NOISE_BINS if len(sigma) >= 10 * NOISE_BINS else 1
    groups = np.array_split(np.argsort(range_sq, kind='stable'), bins)
    x = np.array([np.median(range_sq[group]) for group in groups])
    y = np.array([np.quantile(sigma[group], NOISE_QUANTILE) for group in groups])
    y *= 1.0 + CLIPPING * (y / size_m) ** 2
    return line_above_zero(x, y)


def neighbourhoods(voxels: VoxelPoints, seeds: Indices) -> Indices:
    """Return the voxels around each seed and itself, (B, W) int64, -1 behind the last."""
    first, near = voxels.adjacent
    numbers = first[seeds + 1] - first[seeds]
    column = np.arange(int(numbers.max(initial=0)) + 1)
    index = np.minimum(first[seeds][:, None] + column, max(len(near) - 1, 0))
    blocks = np.where(column < numbers[:, None], near[index], -1).astype(np.int64)
    blocks[np.arange(len(seeds)), numbers] = seeds
    return blocks


def block_noise(
    voxels: VoxelPoints, blocks: Indices, view: Array, most: int = BLOCK_POINTS
) -> Array:
    """
    Estimate the noise of the points of each block, about a quadric.

    Parameters
    ----------
    voxels : VoxelPoints
        The points.
    blocks : (B, W) int64
        Voxels of each block, -1 for none.
    view : (3,) float64, m
        Position of the sensor.
    most : int
        Points used in a block.

    Returns
    -------
    (B,) float64, m
        Sigma along the ray; -1 for too few points and for lines.

    """
    points, weight = sampled(voxels, blocks, most)
    number = weight.sum(axis=1)
    mean = (weight[:, :, None] * points).sum(axis=1) / np.maximum(number, 1.0)[:, None]
    away = (points - mean[:, None]) * weight[:, :, None]
    values, axes = np.linalg.eigh(away.transpose(0, 2, 1) @ away)
    sigma = np.full(len(blocks), -1.0)
    wide = np.flatnonzero(
        (number >= LEAST_BLOCK) & (values[:, 1] > LEAST_WIDTH * values[:, 2]) & (values[:, 2] > 0)
    )
    scale = np.sqrt(values[wide, 2] / number[wide])
    local = away[wide] @ axes[wide][:, :, ::-1] / scale[:, None, None]
    ray, normal = mean[wide] - view, axes[wide, :, 0]
    range_m = np.sqrt(np.maximum((ray**2).sum(axis=1), 1e-24))
    cosine = np.maximum(np.abs((ray * normal).sum(axis=1)) / range_m, LEAST_COSINE)
    sigma[wide] = scale * trimmed_sigma(local, weight[wide]) / cosine
    return sigma


def sampled(voxels: VoxelPoints, blocks: Indices, most: int) -> tuple[Array, Array]:
    """Return evenly chosen points (B, most, 3) of each block, and their weights, 1 or 0."""
    is_voxel, starts = blocks >= 0, voxels.starts
    counts = np.where(is_voxel, starts[blocks + 1] - starts[blocks], 0)
    ends = counts.cumsum(axis=1)
    total = ends[:, -1:]
    stride = 1 + (total - 1) // most
    rank = np.minimum(np.arange(most) * stride, np.maximum(total - 1, 0))
    column = (rank[:, :, None] >= ends[:, None, :]).sum(axis=2)
    row = np.arange(len(blocks))[:, None]
    column = np.minimum(column, blocks.shape[1] - 1)
    rows = starts[blocks[row, column]] + rank - (ends - counts)[row, column]
    weight = (np.arange(most) * stride < total).astype(np.float64)
    return voxels.points[rows].astype(np.float64), weight


def trimmed_sigma(points: Array, weight: Array) -> Array:
    """
    Return the residuals (B,) of quadrics without the points beyond three sigma.

    Parameters
    ----------
    points : (B, n, 3) float64
        Height over x and y.
    weight : (B, n) float64
        1 for points, 0 for none.

    """
    x, y, z = np.moveaxis(points, 2, 0)
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=2)
    counts = weight.sum(axis=1).astype(np.int64)
    middle = np.stack([(counts - 1) // 2, counts // 2], axis=1)
    used = weight
    for turn in range(TRIMMING_ROUNDS + 1):
        weighted = basis * used[:, :, None]
        number = used.sum(axis=1)
        matrix = basis.transpose(0, 2, 1) @ weighted
        matrix += RIDGE * number[:, None, None] * np.eye(6)
        right = (weighted * z[:, :, None]).sum(axis=1)
        terms = np.linalg.solve(matrix, right[:, :, None])
        away = np.abs(z - (basis @ terms)[:, :, 0])
        if turn == TRIMMING_ROUNDS:
            break
        ascending = np.sort(np.where(weight > 0.0, away, np.inf), axis=1)
        median = np.take_along_axis(ascending, middle, axis=1).mean(axis=1)
        inside = weight * (away <= 3.0 * MEDIAN_TO_SIGMA * median[:, None])
        enough = inside.sum(axis=1) >= LEAST_BLOCK
        used = np.where(enough[:, None], inside, used)
    sigma: Array = np.sqrt((used * away**2).sum(axis=1) / (number - 6.0))
    return sigma


def line_above_zero(x: Array, y: Array) -> tuple[float, float]:
    """
    Return a and b of a + b x, neither negative, nearest to y relative to y.

    If x does not determine b, b is 0: noise at one range says nothing of other ranges.
    """
    weight = 1.0 / np.maximum(y, 1e-9)
    design = np.stack([np.ones_like(x), x], axis=1) * weight[:, None]
    best, least = (0.0, 0.0), math.inf
    for used in ([0], [0, 1], [1]):
        terms = np.zeros(2)
        terms[used] = np.linalg.lstsq(design[:, used], y * weight, rcond=None)[0]
        error = float(((design @ terms - y * weight) ** 2).sum())
        if (terms >= 0.0).all() and error < least - 1e-12:
            best, least = (float(terms[0]), float(terms[1])), error
    return best
