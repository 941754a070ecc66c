# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What has changed in the map since clients were told last.

After a scan that is what the scan did. But a map changes in other ways too: it is cleared,
wholly or in part, another one is loaded, its scans are aligned. Then the voxels there are now are
compared with those that clients know of, so that nothing in the way a map may change has to be
foreseen here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.moments import pack_keys, unpack_keys
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.pipeline import Mapper, Update

Keys = npt.NDArray[np.int64]

LIST_EVERY = 30
"""Scans between two listings of the voxels of the map."""


@dataclass(frozen=True, slots=True, eq=False)
class MapChange:
    """
    What clients do not know yet.

    Attributes
    ----------
    surfels : Surfels
        Of every voxel that changed and holds enough points.
    removed : (E, 3) int32
        Voxels that held enough points and do no longer.

    """

    surfels: Surfels
    removed: npt.NDArray[np.int32]


class ChangeTracker:
    """
    Follows the map for clients.

    Parameters
    ----------
    mapper : Mapper
        Whose map it is; all is called in the mapping thread.

    """

    def __init__(self, mapper: Mapper) -> None:
        """Begin with clients who know nothing, of whom there are none."""
        self._mapper = mapper
        self._known: PublishedKeys | None = None
        self._version = mapper.map.version
        self._num_resets = mapper.counters.resets

    @property
    def min_points(self) -> int:
        """From how many points on clients are told of a voxel: where moments are asked for, 1."""
        config = self._mapper.config
        return 1 if config.publish.moments else config.map.min_points

    def forget(self) -> None:
        """Have no clients any more."""
        self._known = None
        self._version = self._mapper.map.version
        self._num_resets = self._mapper.counters.resets

    def of(self, update: Update) -> MapChange:
        """Return what a scan changed, and whatever else happened since the last call."""
        num_resets = self._mapper.counters.resets
        is_usual = update.alignment is None and num_resets == self._num_resets
        self._num_resets = num_resets
        if not is_usual:
            return self.since_last()
        if self._known is None:
            self._known = PublishedKeys(self._held())
        if not self._mapper.config.publish.moments:
            change = MapChange(update.changed, update.removed_voxel_index)
        else:
            surfels = self._mapper.map.surfels_changed(self._version, 1)
            change = MapChange(surfels, self._emptied(update))
        self._version = self._mapper.map.version
        self._known.note(change)
        if len(self._known) >= LIST_EVERY:
            self._known = PublishedKeys(self._held())
        return change

    def since_last(self) -> MapChange:
        """Return what has changed since the last call, in whatever way."""
        surfel_map = self._mapper.map
        surfels = surfel_map.surfels_changed(self._version, self.min_points)
        keys = self._held()
        before = np.empty(0, np.int64) if self._known is None else self._known.keys()
        self._known = PublishedKeys(keys)
        self._version = surfel_map.version
        return MapChange(surfels, unpack_keys(np.setdiff1d(before, keys, assume_unique=True)))

    def _held(self) -> Keys:
        """Return the voxels that clients should know of."""
        return self._mapper.map.keys(self.min_points)

    def _emptied(self, update: Update) -> npt.NDArray[np.int32]:
        """Return the voxels that hold no point since evictions."""
        keys = [eviction.scan.moments.key for eviction in update.evictions]
        if not keys:
            return np.empty((0, 3), np.int32)
        evicted = np.unique(np.concatenate(keys))
        return unpack_keys(evicted[self._mapper.map.find(evicted) < 0])


class PublishedKeys:
    """
    The voxels that clients know of.

    Right after a scan these are the voxels that the map holds. To list them takes milliseconds,
    so that is done now and then, and what scans change in between is only remembered.

    Parameters
    ----------
    keys : (K,) int64
        At first, each once.

    """

    def __init__(self, keys: Keys) -> None:
        """Know of some voxels."""
        self._keys = keys
        self._changes: list[MapChange] = []

    def __len__(self) -> int:
        """Return how many changes are remembered."""
        return len(self._changes)

    def note(self, change: MapChange) -> None:
        """Remember a change."""
        self._changes.append(change)

    def keys(self) -> Keys:
        """Return all, in ascending order."""
        known = self._keys
        for change in self._changes:
            known = np.setdiff1d(known, pack_keys(change.removed))
            known = np.union1d(known, pack_keys(change.surfels.voxel_index))
        return np.asarray(known, np.int64)
