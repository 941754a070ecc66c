# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The noise of the sensor, estimated from the surfels of a map as from the points of a cloud.

Eight points stand for the points of a voxel: one standard deviation from their mean along each
principal axis, to either side. They have the mean and the covariance of all, so residuals over
many voxels are as thick as those of the points.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.models.frames import PACKED
from surfel_mapper.models.noise import estimate_noise, NoiseSamples

LEAST_EDGE_VOXELS = 3.0
"""Edge of the cubes in voxels, at least: a surfel resolves nothing within its voxel."""

MOST_M = 0.02
"""Largest estimate, m: rougher surfaces are vegetation or rubble in large voxels, not noise."""

MOST_VOXELS = 1 << 15
"""Voxels that are looked at, those added first: neighbours are mostly added together."""

CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
"""Signs of the axes of the eight points."""


def map_noise(surfel_map: SurfelMap) -> float:
    """
    Return the standard deviation of the points across the smooth surfaces of a map, m.

    It is at most MOST_M, and 0 for too few voxels.
    """
    rows = surfel_map.rows_changed(-1)[:MOST_VOXELS]
    rows = rows[surfel_map.keys_of(rows) >= 0]
    surfels = surfel_map.surfels_of(rows, covariance=True)
    order, number = np.argsort(surfels.position[:, 2], kind='stable'), len(rows)
    means, counts = surfels.position[order], surfels.num_points[order].astype(np.float64)
    assert surfels.covariance is not None
    covariances = np.where(counts[:, None] > 1.0, surfels.covariance[order], 0.0)
    values, axes = np.linalg.eigh(covariances[:, PACKED])
    signs = np.random.default_rng(0).permuted(np.tile(CORNERS, (number, 1, 1)), axis=1)
    away = np.einsum('kcj,kj,kij->kci', signs, np.sqrt(np.maximum(values, 0.0)), axes)
    samples = NoiseSamples(
        points=(means[:, None] + away).reshape(-1, 3),
        rows=np.arange(8 * number),
        starts=8 * np.arange(number + 1),
        means=means,
        weights=np.repeat(counts, 8),
    )
    return min(estimate_noise(samples, LEAST_EDGE_VOXELS * surfel_map.voxel_size_m)[0], MOST_M)
