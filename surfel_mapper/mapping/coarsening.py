# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Coarser maps: the exact moments of voxels 2^level times larger.

Coarsening has two passes. The first finds the larger voxel of each voxel, from the keys alone;
with their counts that decides the level of detail of each tile of a picture. The second sums the
moments, only of the voxels asked for.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from surfel_mapper.kernels.layout import COUNT, KEY, PRODUCT, ROW, SUM, VIEW
from surfel_mapper.mapping.kernels.voxels import coarse_rows, sum_coarse
from surfel_mapper.mapping.moments import ScanMoments


def coarse_moments(moments: ScanMoments, level: int) -> ScanMoments:
    """
    Return the moments of voxels 2^level times larger, exactly.

    Parameters
    ----------
    moments : ScanMoments
        Moments of a map, with summed views.
    level : int
        0 or more.

    """
    slab, channels = coarse_slab(moments, np.arange(len(moments)), level)
    return replace(
        moments,
        voxel_size_m=moments.voxel_size_m * 2**level,
        level=moments.level + level,
        key=slab[:, KEY].copy(),
        count=slab[:, COUNT].copy(),
        total=slab[:, SUM : SUM + 3].copy(),
        product=slab[:, PRODUCT : PRODUCT + 6].copy(),
        view=slab[:, VIEW : VIEW + 3].copy(),
        channels=channels,
    )


def coarse_keys(
    key: npt.NDArray[np.int64], level: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int32]]:
    """Return the keys (C,) of the voxels 2^level times larger, and that of each voxel, (K,)."""
    table = np.full(1 << max(2 * len(key) - 1, 1).bit_length(), -1, np.int32)
    keys, rows = np.empty_like(key), np.empty(len(key), np.int32)
    num = coarse_rows(key, level, table, keys, rows)
    return keys[:num], rows


def coarse_slab(
    moments: ScanMoments, chosen: npt.NDArray[np.int64], level: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """
    Return the exact sums of some voxels in voxels 2^level times larger.

    Parameters
    ----------
    moments : ScanMoments
        Moments of a map, with summed views.
    chosen : (K,) int64
        The voxels, of those of the moments.
    level : int
        0 or more.

    Returns
    -------
    (C, 16) int64
        Rows in the layout of kernels/layout.py, in the order of first appearance.
    (C, number of channels) int64
        Sums of the channels.

    """
    keys, rows = coarse_keys(moments.key[chosen], level)
    slab = np.zeros((len(keys), ROW), np.int64)
    slab[:, KEY] = keys
    sum_coarse(moments.arrays, chosen, rows, moments.level, level, slab)
    channels = np.zeros((len(keys), moments.channels.shape[1]), np.int64)
    if channels.size:
        np.add.at(channels, rows, moments.channels[chosen])
    return slab, channels
