# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""How old what a map says is: when each voxel was last seen, by the scans of the window."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from surfel_mapper.kernels.queries import build_table
from surfel_mapper.kernels.thinning import mark_seen, mix_keys
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.mapping.window import WindowedScan


def last_seen_ns(
    voxel_index: npt.NDArray[np.int32], scans: Iterable[WindowedScan]
) -> npt.NDArray[np.int64]:
    """
    Return the stamp of the newest scan that saw each voxel.

    Parameters
    ----------
    voxel_index : (K, 3) int32
        Each voxel once.
    scans : iterable of WindowedScan
        Those of the window; looked through from the newest on, until all voxels are found.

    Returns
    -------
    (K,) int64
        Nanoseconds; -1 for voxels that none of them saw.

    """
    keys = pack_keys(voxel_index)
    table = np.empty(1 << max(2 * len(keys) - 1, 1).bit_length(), np.int32)
    build_table(keys, table)
    mixed = np.zeros(len(keys), np.uint64)
    mix_keys(keys, mixed)
    limit = mixed.max(initial=0)
    stamps = np.full(len(keys), -1, np.int64)
    missing = len(keys)
    for scan in sorted(scans, key=lambda scan: scan.stamp_ns, reverse=True):
        if not missing:
            break
        missing -= mark_seen(scan.moments.key, limit, keys, table, stamps, scan.stamp_ns)
    return stamps
