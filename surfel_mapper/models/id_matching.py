# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Match new patches to old ids: a patch keeps the id with which it shares most voxels.

The largest overlap is assigned first; ties go to the lower id. A patch without an old id is new,
and part of a split if its voxels had a patch before. An old id without a patch is removed, and
merged if its voxels have a patch now.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Ids = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class IdMatches:
    """
    Ids of new patches, and the fate of old ids.

    Attributes
    ----------
    ids : list of int
        Ids of the new patches, in their order.
    created, removed : list of int
        Ids that no old patch had; ids that no new patch has.
    merged, split : list of (int, int)
        Removed ids and the id of most of their voxels; old ids and the created ones that took most
        of their voxels from them.

    """

    ids: list[int]
    created: list[int]
    removed: list[int]
    merged: list[tuple[int, int]]
    split: list[tuple[int, int]]


def match(old_ids: Ids, labels: Ids, starts: Ids, next_id: int) -> IdMatches:
    """
    Assign ids to patches.

    Parameters
    ----------
    old_ids : (O,) int64
        Candidate ids of old patches, ascending.
    labels : (M,) int64
        Previous ids of their voxels; others than candidates are ignored.
    starts : (K + 1,) int64
        First voxel of each patch, and M.
    next_id : int
        The first unused id.

    """
    num = len(starts) - 1
    of_voxel = np.repeat(np.arange(num), np.diff(starts))
    index = np.searchsorted(old_ids, labels)
    is_old = index < len(old_ids)
    is_old[is_old] = old_ids[index[is_old]] == labels[is_old]
    pairs, shared = np.unique(index[is_old] * max(num, 1) + of_voxel[is_old], return_counts=True)
    best = np.lexsort((pairs, -shared))
    ids, heirs, origins = [-1] * num, dict.fromkeys(old_ids.tolist(), -1), [-1] * num
    ranked = [divmod(pair, max(num, 1)) for pair in pairs[best].tolist()]
    links = [(int(old_ids[old]), new) for old, new in ranked]
    for old, new in links:
        if ids[new] < 0 and heirs[old] < 0:
            ids[new], heirs[old] = old, new
    created: list[int] = []
    for new in range(num):
        if ids[new] < 0:
            ids[new] = next_id + len(created)
            created.append(ids[new])
    removed = [old for old, new in heirs.items() if new < 0]
    merged: dict[int, int] = {}
    split: dict[int, int] = {}
    for old, new in links:
        if heirs[old] < 0:
            merged.setdefault(old, ids[new])
        if origins[new] < 0 and ids[new] >= next_id:
            origins[new] = old
            split[ids[new]] = old
    pairs_split = sorted((old, new) for new, old in split.items() if heirs[old] >= 0)
    return IdMatches(ids, created, removed, sorted(merged.items()), pairs_split)
