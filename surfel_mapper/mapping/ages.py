# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Ages of voxels: the stamp at which a scan of the window last observed each voxel."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from surfel_mapper.kernels.grouping import build_table
from surfel_mapper.mapping.kernels.queries import mark_observed
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.mapping.window import WindowedScan


def last_seen_ns(
    voxel_index: npt.NDArray[np.int32], scans: Iterable[WindowedScan]
) -> npt.NDArray[np.int64]:
    """
    Return the stamp of the newest scan that observed each voxel.

    Parameters
    ----------
    voxel_index : (K, 3) int32
        Voxel indices without duplicates.
    scans : iterable of WindowedScan
        Scans of the window.

    Returns
    -------
    (K,) int64
        Nanoseconds; -1 for voxels that no scan observed.

    """
    keys = pack_keys(voxel_index)
    table = np.empty(1 << max(2 * len(keys) - 1, 1).bit_length(), np.int32)
    build_table(keys, table)
    stamps = np.full(len(keys), -1, np.int64)
    for scan in scans:
        mark_observed(scan.moments.key, keys, table, scan.stamp_ns, stamps)
    return stamps


def ages_s(last_seen_ns: npt.NDArray[np.int64], newest_ns: int) -> npt.NDArray[np.float64]:
    """Return the ages of surfels at a stamp, s; nan for those that no scan has seen."""
    return np.where(last_seen_ns < 0, np.nan, (newest_ns - last_seen_ns) / 1e9)
