# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Coarser levels: the moments of large voxels from those of small ones, exactly.

A voxel of level L is made of 2^L finer ones an axis and keeps their lattice unit, so a point
that lies at q about the centre of its fine voxel lies at q + d about the coarse centre, with a
whole d: the sum becomes S + n d, the second moment M + d S' + S d' + n d d'.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from surfel_mapper.mapping.kernels.levels import coarsen
from surfel_mapper.mapping.moments import ScanMoments


def coarse_moments(moments: ScanMoments, level: int) -> ScanMoments:
    """
    Return the moments of voxels 2^level times larger.

    Parameters
    ----------
    moments : ScanMoments
        Of a map, views summed.
    level : int
        0 or more.

    """
    num_fine = len(moments)
    table = np.full(1 << max(2 * num_fine - 1, 1).bit_length(), -1, np.int32)
    keys, rows = np.empty(num_fine, np.int64), np.empty(num_fine, np.int64)
    sums = np.zeros((num_fine, 13), np.int64)
    num = coarsen(moments.arrays, moments.level, level, table, keys, sums, rows)
    channels = np.zeros((num, moments.channels.shape[1]), np.int64)
    np.add.at(channels, rows, moments.channels)
    return replace(
        moments,
        voxel_size_m=moments.voxel_size_m * 2**level,
        level=moments.level + level,
        key=keys[:num],
        count=sums[:num, 0].copy(),
        total=sums[:num, 1:4].copy(),
        product=sums[:num, 4:10].copy(),
        view=sums[:num, 10:13].copy(),
        channels=channels,
    )
