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
import numpy.typing as npt

from surfel_mapper.kernels.layout import BITS
from surfel_mapper.mapping.moments import pack_keys, ScanMoments

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Axes of the products, in the order of ``ScanMoments.product``."""


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
    index = moments.voxel_index.astype(np.int64)
    fine = 1 << (BITS + moments.level)
    shift = (index & ((1 << level) - 1)) * fine + fine // 2 - (fine << level) // 2
    count, total = moments.count.astype(np.int64), moments.total.astype(np.int64)
    product = np.stack(
        [
            moments.product[:, pair]
            + shift[:, i] * total[:, j]
            + shift[:, j] * total[:, i]
            + count * shift[:, i] * shift[:, j]
            for pair, (i, j) in enumerate(PAIRS)
        ],
        axis=1,
    )
    key = pack_keys(index >> level)
    order = np.argsort(key, kind='stable')
    first = np.flatnonzero(np.diff(key[order], prepend=-1))

    def by_voxel(values: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        sums = np.add.reduceat(values[order], first) if len(first) else values[:0]
        return np.asarray(sums, np.int64)

    return replace(
        moments,
        voxel_size_m=moments.voxel_size_m * 2**level,
        level=moments.level + level,
        key=key[order][first],
        count=by_voxel(count),
        total=by_voxel(total + count[:, None] * shift),
        product=by_voxel(product),
        view=by_voxel(moments.view.astype(np.int64)),
        channels=by_voxel(moments.channels) if moments.channel_names else moments.channels,
    )
