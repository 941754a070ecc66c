# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Noise of the sensor that made a cloud, from the residuals of quadrics over cubes of 0.3 m.

Depth cameras do not have white noise. Block matching correlates pixels over centimetres, and
disparities come in steps: neighbouring points of a Kinect are equal. Residuals within a few
centimetres are a fifth of the noise, those over tens of centimetres show it whole.

A quadric removes curvature. If a quartic fits much better, the residual is shape, and the cube
does not count. If too few cubes count, smaller ones are used. A wall that faces the camera may be
one step of disparity. Steps show in the coordinates along its axis, and bound the noise below.

There are at most 128 cubes, with 64 points each.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.frames import eigen, means_and_scatters
from surfel_mapper.models.joining import LEAST_COSINE
from surfel_mapper.models.kernels.noise import RIDGE, trimmed_sigmas
from surfel_mapper.models.kernels.voxel_points import sample_cubes

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

EDGE_M, EDGE_RANGE_M, COARSEST = 0.32, 2.0, 2
"""Edge of cubes up to twice EDGE_RANGE_M; it doubles with the range, up to COARSEST times."""

NEAR_M = 1.0
"""Cubes nearer than this are half as large: objects on a table are smaller than walls."""

CUBES, CUBE_POINTS, LEAST_POINTS = 128, 64, 32
"""Cubes for the estimate, most and least points used in each."""

LEAST_CUBES, LEAST_SHARE = 20, 0.25
"""Number and share of the cubes that are smooth surfaces, for an estimate."""

NOISE_BINS = 4
"""Bins of range."""

MAP_QUANTILE, MAP_SAMPLES = 0.9, 2
"""
If ranges are unknown, quantile of the noise of surfaces, as most are nearer than the noisiest, and
factor of the cubes and of their points, as a high quantile needs more.
"""

LEAST_WIDTH, MOST_THICKNESS = 0.1, 0.1
"""
A cube with a smaller ratio of the tangential variances is a line; one with a larger ratio of the
normal variance to the smaller tangential one is a corner, or folded.
"""

LEAST_KEPT, LEAST_QUARTIC = 0.9, 0.75
"""
A smooth surface with noise keeps this share of its points, and the residual of a quartic is at
least this share of that of a quadric.
"""

LEAST_DISPARITY_NOISE = 3e-4
"""
Sigma by range^2, 1/m, from which on a cloud is of a depth camera: theirs is 1e-3 1/m, of lidars
less than 1e-4 1/m. Layers are separated there, as roads that a lidar sees are cambered. Patches in
voxels of other sizes are not grown: pixels leave no gaps.
"""

STEP_SAMPLES, STEP_POINTS, STEP_SPREAD = 20_000, 8, 2.5
"""
Points for the steps of disparity; each step holds STEP_POINTS on average, and 80 % of the steps
differ by a factor of at most STEP_SPREAD when divided by the squared distance.
"""


@dataclass(frozen=True, slots=True, eq=False)
class NoiseSamples:
    """
    Points by voxel, for an estimate of their noise.

    Attributes
    ----------
    points : (N, 3) float32 or float64, m
    rows : (P,) int
        Rows of the finite ones, voxel by voxel.
    starts : (V + 1,) int64
        First of these rows of each voxel, and P.
    means : (V, 3) float64, m
        Means of the points by voxel; neighbours mostly follow each other.
    weights : (P,) float64, optional
        Weights of the rows; 1 if omitted.
    view : (3,) float64, m, optional
        Position of the sensor. Without it noise is across the surface, at any range.

    """

    points: npt.NDArray[Any]
    rows: npt.NDArray[Any]
    starts: Indices
    means: Array
    weights: Array | None = None
    view: Array | None = None


def estimate_noise(samples: NoiseSamples, least_edge_m: float) -> tuple[float, float]:
    """
    Return the noise of the points as n0, m, and n2, 1/m: sigma is n0 + n2 range^2.

    Both are 0 if there are no smooth surfaces. Cubes have at least the given edge.
    """
    range_sq: Array = np.empty(0)
    sigma: Array = np.empty(0)
    edge_m = max(EDGE_M, least_edge_m)
    while edge_m >= least_edge_m:
        range_sq, sigma, share = cube_noise(samples, edge_m)
        if len(sigma) >= LEAST_CUBES and share >= LEAST_SHARE:
            break
        edge_m *= 0.5
    if not len(sigma):
        return 0.0, 0.0
    bins = NOISE_BINS if len(sigma) >= 5 * NOISE_BINS else 1
    groups = np.array_split(np.argsort(range_sq, kind='stable'), bins)
    x = np.array([quantile(range_sq[group], 0.5) for group in groups])
    typical = MAP_QUANTILE if samples.view is None else 0.5
    y = np.array([quantile(sigma[group], typical) for group in groups])
    return line_above_zero(x, np.maximum(y, step_noise(samples) * x))


def quantile(values: Array, share: float) -> float:
    """Return a quantile of at least one value; np.quantile takes five times as long for 30."""
    ordered, at = np.sort(values), share * (len(values) - 1)
    return float(np.interp(at, np.arange(len(ordered)), ordered))


def cube_noise(samples: NoiseSamples, edge_m: float) -> tuple[Array, Array, float]:
    """Return squared range and sigma along the ray of smooth cubes, (B,), and their share."""
    points, weight, share = sampled_cubes(samples, edge_m)
    starts = np.arange(0, weight.size + 1, weight.shape[1])
    number, mean, scatter = means_and_scatters(points.reshape(-1, 3), weight.ravel(), starts)
    values, axes = eigen(scatter)
    is_sheet = values[:, 1] > LEAST_WIDTH * values[:, 2]
    sheets = np.flatnonzero(is_sheet & (values[:, 0] < MOST_THICKNESS * values[:, 1]))
    scale = np.sqrt(values[sheets, 2] / number[sheets])
    away = points[sheets] - mean[sheets, None]
    local = away @ axes[sheets, ::-1].transpose(0, 2, 1) / scale[:, None, None]
    (sigma, quartic), kept = np.empty((2, len(sheets))), np.empty(len(sheets))
    trimmed_sigmas(local, weight[sheets], sigma, quartic, kept)
    smooth = (quartic >= LEAST_QUARTIC * sigma) | (sigma < math.sqrt(RIDGE))
    smooth &= kept >= LEAST_KEPT
    share *= float(smooth.sum()) / max(len(points), 1)
    if samples.view is None:
        return np.zeros(int(smooth.sum())), (scale * sigma)[smooth], share
    ray = mean[sheets] - samples.view
    range_m = np.sqrt(np.maximum((ray**2).sum(axis=1), 1e-24))
    cosine = np.abs((ray * axes[sheets, 0]).sum(axis=1)) / range_m
    along = scale * sigma / np.maximum(cosine, LEAST_COSINE)
    return range_m[smooth] ** 2, along[smooth], share


def sampled_cubes(samples: NoiseSamples, edge_m: float) -> tuple[Array, Array, float]:
    """Return points (B, n, 3) of cubes, weights (B, n) of mean 1, and the share with enough."""
    means, view = samples.means, samples.view
    more = MAP_SAMPLES if view is None else 1
    seeds = np.arange(0, len(means), -(-len(means) // (more * CUBES)) or 1)
    halves = np.full(len(seeds), 0.5 * edge_m)
    if view is not None:
        range_m = np.sqrt(((means[seeds] - view) ** 2).sum(axis=1))
        level = np.floor(np.log2(np.maximum(range_m / EDGE_RANGE_M, 1.0)))
        halves *= 2.0 ** np.minimum(level, COARSEST)
        halves[range_m < NEAR_M] *= 0.5
    rows = sampled_rows(samples, seeds, halves, more * CUBE_POINTS)
    rows = rows[rows[:, LEAST_POINTS - 1] >= 0]
    weight = (rows >= 0).astype(np.float64)
    if samples.weights is not None:
        counts = samples.weights[rows] * weight
        weight = counts * (weight.sum(axis=1) / counts.sum(axis=1))[:, None]
    points = samples.points[samples.rows[rows]].astype(np.float64)
    return points, weight, len(rows) / max(len(seeds), 1)


def sampled_rows(samples: NoiseSamples, seeds: Indices, halves: Array, most: int) -> Indices:
    """
    Return rows of points (B, most), evenly from the voxels whose means are in cubes; -1 for none.

    Parameters
    ----------
    samples : NoiseSamples
        Points by voxel.
    seeds : (B,) int64
        Voxels in the middle of the cubes.
    halves : (B,) float64, m
        Half the edges of the cubes.
    most : int
        Points of a cube.

    """
    rows: Indices = np.full((len(seeds), most), -1)
    sample_cubes(samples.means, samples.starts, seeds, halves, rows)
    return rows


def step_noise(samples: NoiseSamples) -> float:
    """Return sigma / distance^2, 1/m, of the steps of disparity along an axis; 0 without steps."""
    if samples.view is None:
        return 0.0
    points = samples.points[samples.rows[:: 1 + len(samples.rows) // STEP_SAMPLES]]
    for axis in (2, 1, 0):  # that of a camera is z
        values = np.abs(points[:, axis] - samples.view[axis])
        most = len(values) / STEP_POINTS
        if len(np.unique(values[::4])) > most + 1.0:  # of these one may be 0
            continue
        levels = np.unique(values[values > 0.0])
        if 2 < len(levels) < most:
            low, step, high = np.quantile(np.diff(1.0 / levels[::-1]), [0.1, 0.5, 0.9])
            if high < STEP_SPREAD * low:
                return float(step / math.sqrt(12.0))
    return 0.0


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
