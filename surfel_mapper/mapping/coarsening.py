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

from surfel_mapper.kernels.layout import BITS, ROW, SCANS, STAMP_ROW
from surfel_mapper.mapping.channels import means
from surfel_mapper.mapping.kernels.rows import write_rows
from surfel_mapper.mapping.kernels.voxels import coarse_rows, sum_coarse
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.surfels import derive, Surfels


def coarse_moments(
    moments: ScanMoments, level: int, chosen: npt.NDArray[np.int64] | None = None
) -> ScanMoments:
    """
    Return the moments of voxels 2^level times larger, exactly, in the order of first appearance.

    Parameters
    ----------
    moments : ScanMoments
        Moments of a map, with summed views.
    level : int
        0 or more. The number of scans of a larger voxel is the largest of its voxels, as a scan
        has points in several.
    chosen : (K,) int64, optional
        The voxels, of those of the moments; by default all.

    """
    chosen = np.arange(len(moments)) if chosen is None else chosen
    keys, rows = coarse_keys(moments.key[chosen], level)
    shapes = ((), (3,), (6,), (3,), ())
    sums = tuple(np.zeros((len(keys), *shape), np.int64) for shape in shapes)
    fine = *moments.arrays, moments.scans
    sum_coarse(fine, chosen, rows, moments.level, level, sums)
    count, total, product, view, num_scans = sums
    channels = np.zeros((len(keys), moments.channels.shape[1]), np.int64)
    if channels.size:
        np.add.at(channels, rows, moments.channels[chosen])
    coarse = replace(
        moments,
        voxel_size_m=moments.voxel_size_m * 2**level,
        level=moments.level + level,
        key=keys.copy(),
        count=count,
        total=total,
        product=product,
        view=view,
        channels=channels,
        num_scans=num_scans,
    )
    object.__setattr__(coarse, 'num_reduced', int(count.sum()))  # sums of a map need no test
    return coarse


def coarse_surfels(
    moments: ScanMoments, level: int, chosen: npt.NDArray[np.int64], min_points: int
) -> Surfels:
    """Return the surfels of at least min_points points of ``coarse_moments``."""
    coarse = coarse_moments(moments, level, chosen)
    coarse = coarse.select(coarse.count >= min_points)
    slab = np.empty((len(coarse), ROW), np.int64)
    write_rows(coarse.arrays, slab)
    stamps = np.zeros((len(coarse), STAMP_ROW), np.uint32)
    stamps[:, SCANS] = coarse.scans
    chosen_rows = np.arange(len(slab), dtype=np.int32)
    surfels = derive((slab, stamps), chosen_rows, coarse.voxel_size_m, BITS + coarse.level)
    channels = means(coarse.channels, coarse.count, coarse.channel_names)
    return replace(surfels, channels=channels)


def coarse_keys(
    key: npt.NDArray[np.int64], level: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int32]]:
    """Return the keys (C,) of the voxels 2^level times larger, and that of each voxel, (K,)."""
    table = np.full(1 << max(2 * len(key) - 1, 1).bit_length(), -1, np.int32)
    keys, rows = np.empty_like(key), np.empty(len(key), np.int32)
    num = coarse_rows(key, level, table, keys, rows)
    return keys[:num], rows
