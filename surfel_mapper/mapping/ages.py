# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
How old what a map says is: when each voxel was last seen, by the scans of the window.

A window of 100 scans holds three million voxel keys, and going through them takes 15 ms. Where
only some surfels of a map are drawn, they are those whose keys have small hashes (thinning.py),
so of each scan the keys with small hashes are kept aside once, a tenth of them. Of those the ones
that a newer scan saw too are left out, as long as no scan leaves before an older one: on a drive
through a street a quarter is left.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from surfel_mapper.kernels.queries import build_table
from surfel_mapper.mapping.kernels.thinning import keys_within, mark_seen, mix_keys
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.mapping.windowed_scan import WindowedScan

Keys = npt.NDArray[np.int64]

LARGEST_HASH = 2**64 - 1
SLACK = 5 / 4
"""Keys are kept up to this many times the limit, which moves a little between drawings."""


class ThinnedKeys(NamedTuple):
    """The keys of a scan whose hashes are at most a limit, but for some that newer scans saw."""

    all_keys: Keys
    limit: int
    keys: Keys


class Ages:
    """Tells when voxels were last seen; made once, and asked again and again about one window."""

    def __init__(self) -> None:
        """Know no scan."""
        self._thinned: dict[int, ThinnedKeys] = {}

    def last_seen_ns(
        self, voxel_index: npt.NDArray[np.int32], scans: Iterable[WindowedScan]
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
        newest_first = sorted(scans, key=lambda scan: scan.stamp_ns, reverse=True)
        self._forget_unless_behind(newest_first)
        missing, thinned = len(keys), {}
        for scan in newest_first:
            if not missing:
                break
            found = self._thin(scan.moments.key, int(limit))
            left = np.empty_like(found.keys)
            num, num_left = mark_seen(found.keys, limit, keys, table, stamps, scan.stamp_ns, left)
            missing -= num
            thinned[id(found.all_keys)] = found._replace(keys=left[:num_left].copy())
        self._thinned = thinned
        return stamps

    def _forget_unless_behind(self, newest_first: list[WindowedScan]) -> None:
        """Forget what is kept, if a scan has left while an older one, which it may hide, stays."""
        kept = [id(scan.moments.key) for scan in newest_first]
        stay = [number for number in kept if number in self._thinned]
        if stay != list(self._thinned)[: len(stay)]:
            self._thinned = {}

    def _thin(self, keys: Keys, limit: int) -> ThinnedKeys:
        """Return the keys of a scan up to a limit, those kept aside where they reach that far."""
        kept = self._thinned.get(id(keys))
        if kept is not None and kept.all_keys is keys and kept.limit >= limit:
            return kept
        wider = int(limit * SLACK)
        if wider >= LARGEST_HASH:
            return ThinnedKeys(keys, LARGEST_HASH, keys)
        within = np.empty(len(keys), np.int64)
        num = keys_within(keys, np.uint64(wider), within)
        return ThinnedKeys(keys, wider, within[:num].copy())
