# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Ages of voxels: the stamp at which a scan of the window last observed each voxel.

A window of 100 scans holds three million voxel keys, and a pass over them takes 15 ms. If only
some surfels of a map are drawn, they are those with small mixed keys (mapping/kernels/queries.py),
so the small keys of each scan, a tenth of all, are cached. Keys that a newer scan observed too are
dropped from the cache as long as scans leave the window in order: on a drive through a street a
quarter remains.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from surfel_mapper.kernels.grouping import build_table
from surfel_mapper.mapping.kernels.queries import keys_within, mark_seen, mix_keys
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.mapping.window import WindowedScan

Keys = npt.NDArray[np.int64]

LARGEST_HASH = 2**64 - 1

SLACK = 5 / 4
"""Factor between cached and requested limit, since the limit varies between drawings."""


class ThinnedKeys(NamedTuple):
    """The cached keys of a scan: mixed key at most limit, without keys of newer scans."""

    all_keys: Keys
    limit: int
    keys: Keys


class Ages:
    """Stamps at which voxels were last observed, cached between calls for the same window."""

    def __init__(self) -> None:
        self._thinned: dict[int, ThinnedKeys] = {}

    def last_seen_ns(
        self, voxel_index: npt.NDArray[np.int32], scans: Iterable[WindowedScan]
    ) -> npt.NDArray[np.int64]:
        """
        Return the stamp of the newest scan that observed each voxel.

        Parameters
        ----------
        voxel_index : (K, 3) int32
            Voxel indices without duplicates.
        scans : iterable of WindowedScan
            Scans of the window; searched from the newest on until all voxels are found.

        Returns
        -------
        (K,) int64
            Nanoseconds; -1 for voxels that no scan observed.

        """
        keys = pack_keys(voxel_index)
        table = np.empty(1 << max(2 * len(keys) - 1, 1).bit_length(), np.int32)
        build_table(keys, table)
        mixed = np.zeros(len(keys), np.uint64)
        mix_keys(keys, mixed)
        limit = mixed.max(initial=0)
        stamps = np.full(len(keys), -1, np.int64)
        newest_first = sorted(scans, key=lambda scan: scan.stamp_ns, reverse=True)
        self._clear_if_out_of_order(newest_first)
        missing, thinned = len(keys), {}
        for scan in newest_first:
            if not missing:
                break
            thin = self._thin(scan.moments.key, int(limit))
            kept = np.empty_like(thin.keys)
            num, num_kept = mark_seen(thin.keys, limit, keys, table, stamps, scan.stamp_ns, kept)
            missing -= num
            thinned[id(thin.all_keys)] = thin._replace(keys=kept[:num_kept].copy())
        self._thinned = thinned
        return stamps

    def _clear_if_out_of_order(self, newest_first: list[WindowedScan]) -> None:
        """Clear the cache if a scan left before an older one whose keys it may hide."""
        kept = [id(scan.moments.key) for scan in newest_first]
        stay = [number for number in kept if number in self._thinned]
        if stay != list(self._thinned)[: len(stay)]:
            self._thinned = {}

    def _thin(self, keys: Keys, limit: int) -> ThinnedKeys:
        """Return the keys of a scan up to a limit, from the cache if it suffices."""
        kept = self._thinned.get(id(keys))
        if kept is not None and kept.all_keys is keys and kept.limit >= limit:
            return kept
        wider = int(limit * SLACK)
        if wider >= LARGEST_HASH:
            return ThinnedKeys(keys, LARGEST_HASH, keys)
        within = np.empty(len(keys), np.int64)
        num = keys_within(keys, np.uint64(wider), within)
        return ThinnedKeys(keys, wider, within[:num].copy())


def ages_s(last_seen_ns: npt.NDArray[np.int64], newest_ns: int) -> npt.NDArray[np.float64]:
    """Return the ages of surfels at a stamp, s; nan for those that no scan has seen."""
    return np.where(last_seen_ns < 0, np.nan, (newest_ns - last_seen_ns) / 1e9)
