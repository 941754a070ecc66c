# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The noise of the sensor, estimated from the surfels of a map.

A voxel on a plane is as thick as the noise; edges, corners and vegetation only add to that, so the
estimate is a low quantile of the thickness. A voxel clips noise of more than a tenth of its edge,
so larger voxels, which the map sums exactly, are taken until they do not. The constants are those
of the estimate from points (growth.py).
"""

from __future__ import annotations

import numpy as np

from surfel_mapper.kernels import layout
from surfel_mapper.mapping.coarsening import coarse_surfels
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.models.cloud_noise import CLIPPED_VOXELS, CLIPPING, NOISE_QUANTILE

LEVELS = 4
"""Voxels of up to 8 times the size are tried."""

LEAST_POINTS, LEAST_VOXELS = 20, 30
"""Points of a voxel, and voxels, for an estimate."""

LEAST_WIDTH = 0.15
"""Least standard deviation of the points of a voxel along its surface, in voxels: half of that
of a surface that fills it."""

SPREAD = 1.15
"""Noise over the quantile: voxels of LEAST_POINTS points scatter, and a plane only grazes some."""

MOST_M = 0.02
"""Largest estimate, m: rougher surfaces are vegetation or rubble in large voxels, not noise."""

MOST_VOXELS = 1 << 17
"""Voxels that are looked at, those added first: neighbours are mostly added together."""


def estimate_noise(surfel_map: SurfelMap) -> float:
    """
    Return the standard deviation of the points about the flat surfaces of a map, m.

    It is at most MOST_M, and 0 if fewer than LEAST_VOXELS voxels have the points and the width for
    an estimate.
    """
    moments = surfel_map.moments().select(slice(MOST_VOXELS))
    noise_m = 0.0
    for level in range(LEVELS):
        size_m = surfel_map.voxel_size_m * 2**level
        # 8^level voxels in one have to stay within its limit of points, which 4^level divides
        most = layout.MAX_MAP_COUNT >> (5 * level + 2 * surfel_map.level)
        chosen = np.flatnonzero(moments.count <= most)
        thin, wide, _ = coarse_surfels(moments, level, chosen, LEAST_POINTS).eigenvalues.T
        sigma = np.sqrt(thin[wide > (LEAST_WIDTH * size_m) ** 2])
        if len(sigma) < LEAST_VOXELS:
            continue
        low = float(np.quantile(sigma, NOISE_QUANTILE))
        noise_m = SPREAD * low * (1.0 + CLIPPING * (low / size_m) ** 2)
        if low < CLIPPED_VOXELS * size_m:
            break
    return min(noise_m, MOST_M)
