# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The changes of the map since the last message on ~/changed and ~/removed.

After a scan these are the changes that the update lists. If the map was cleared, loaded or
aligned, its present voxels are compared with the published ones, which covers any kind of change.
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
"""After this many scans the voxels of the map are listed again, which takes milliseconds."""


@dataclass(frozen=True, slots=True, eq=False)
class MapChange:
    """
    Changes of the map that are not published yet.

    Attributes
    ----------
    surfels : Surfels
        The surfels of changed voxels that have enough points.
    removed : (E, 3) int32
        Indices of voxels that had enough points and no longer do; of adaptive surfels those of
        cells, too.
    removed_size_m : float or (E,) float64
        Their edges, m.

    """

    surfels: Surfels
    removed: npt.NDArray[np.int32]
    removed_size_m: npt.ArrayLike


class ChangeTracker:
    """
    Collects the changes of the map between messages; called in the mapping thread.

    Parameters
    ----------
    mapper : Mapper
        The mapper whose map is published.

    """

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._published: PublishedKeys | None = None
        self._content = self._present_content
        self._version = mapper.map.version
        self._num_resets = mapper.counters.resets
        self._num_mapped = mapper.counters.mapped

    @property
    def min_points(self) -> int:
        """Points that a voxel needs to be published: 1 with ``publish.moments``."""
        config = self._mapper.config
        return 1 if config.publish.moments else config.map.min_points

    @property
    def _present_content(self) -> tuple[int, bool]:
        """Points that a published voxel needs, and whether it comes with its moments."""
        return self.min_points, self._mapper.config.publish.moments

    def reset(self) -> None:
        """Start from the present map; called while there are no subscribers."""
        self._published = None
        self._content = self._present_content
        self._version = self._mapper.map.version
        self._num_resets = self._mapper.counters.resets
        self._num_mapped = self._mapper.counters.mapped

    def after_scan(self, update: Update) -> MapChange:
        """Return the changes of a scan, and all others since the last call."""
        num_resets = self._mapper.counters.resets
        is_only_scan = update.alignment is None and num_resets == self._num_resets
        self._num_resets = num_resets
        num_mapped, self._num_mapped = self._num_mapped, self._mapper.counters.mapped
        if not is_only_scan or self._num_mapped > num_mapped + 1:
            return self.collect()
        if self._published is None:
            self._published = PublishedKeys(self._keys())
        if not self._mapper.config.publish.moments:
            change = self._change(update.changed, update.removed_voxel_index)
        else:
            surfels = self._mapper.map.surfels_changed(self._version, 1)
            change = self._change(surfels, self._emptied(update))
        self._version = self._mapper.map.version
        self._published.append(change)
        if len(self._published) >= LIST_EVERY:
            self._published = PublishedKeys(self._keys())
        return change

    def collect(self) -> MapChange:
        """Return all changes since the last call; all voxels if new settings publish more."""
        surfel_map = self._mapper.map
        (least, had_moments), self._content = self._content, self._present_content
        min_points, has_moments = self._content
        publishes_more = min_points < least or has_moments > had_moments
        since = 0 if publishes_more else self._version
        surfels = surfel_map.surfels_changed(since, min_points)
        keys = self._keys()
        published = np.empty(0, np.int64) if self._published is None else self._published.keys()
        self._published = PublishedKeys(keys)
        self._version = surfel_map.version
        self._num_mapped = self._mapper.counters.mapped
        return self._change(
            surfels, unpack_keys(np.setdiff1d(published, keys, assume_unique=True))
        )

    def _change(self, surfels: Surfels, removed: npt.NDArray[np.int32]) -> MapChange:
        return MapChange(surfels, removed, self._mapper.map.voxel_size_m)

    def _keys(self) -> Keys:
        """Return the keys of all voxels to be published."""
        return self._mapper.map.keys(self.min_points)

    def _emptied(self, update: Update) -> npt.NDArray[np.int32]:
        """Return the voxels that evictions have emptied."""
        keys = [eviction.scan.moments.key for eviction in update.evictions]
        if not keys:
            return np.empty((0, 3), np.int32)
        evicted = np.unique(np.concatenate(keys))
        return unpack_keys(evicted[self._mapper.map.find(evicted) < 0])


class AdaptiveTracker:
    """
    Collects the changes of the adaptive surfels (``publish.adaptive``), as ChangeTracker does.

    Parameters
    ----------
    mapper : Mapper
        The mapper whose map is published.

    """

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._cut = mapper.map.adaptive_cut(self.min_points)
        mapper.derives = False  # surfels of voxels are not published

    @property
    def min_points(self) -> int:
        """Points that a surfel needs to be published."""
        return self._mapper.config.map.min_points

    def reset(self) -> None:
        """Start from the present map, as the next full map does."""

    def after_scan(self, _: Update) -> MapChange:
        """Return the changes of a scan, and all others since the last call."""
        return self.changes()

    def collect(self) -> MapChange:
        """Return all surfels, as the map or its settings have changed otherwise than by a scan."""
        self._cut.min_points = self.min_points
        self._cut.restart()
        return self.changes()

    def surfels(self, at_most: int | None = None) -> Surfels:
        """Return the surfels of the last change, the largest ones if there are too many."""
        surfels = self._cut.surfels(covariance=self._mapper.config.publish.covariance)
        if at_most is None or len(surfels) <= at_most:
            return surfels
        return surfels.select(np.argsort(-surfels.size, kind='stable')[:at_most])

    def changes(self) -> MapChange:
        """Return all changes since the last call."""
        change = self._cut.refresh(covariance=self._mapper.config.publish.covariance)
        return MapChange(change.surfels, change.removed_index, change.removed_size)


class PublishedKeys:
    """
    The keys of the voxels that were published.

    After each scan they equal the voxels of the map. Listing these takes milliseconds, so it is
    done every ``LIST_EVERY`` scans only; the changes in between are kept and applied on demand.

    Parameters
    ----------
    keys : (K,) int64
        The initial keys, unique.

    """

    def __init__(self, keys: Keys) -> None:
        self._keys = keys
        self._changes: list[MapChange] = []

    def __len__(self) -> int:
        """Return the number of changes since the last listing."""
        return len(self._changes)

    def append(self, change: MapChange) -> None:
        """Add a change."""
        self._changes.append(change)

    def keys(self) -> Keys:
        """Return all keys, ascending."""
        keys = self._keys
        for change in self._changes:
            keys = np.setdiff1d(keys, pack_keys(change.removed))
            keys = np.union1d(keys, pack_keys(change.surfels.voxel_index))
        return np.asarray(keys, np.int64)
