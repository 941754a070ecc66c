# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
MapMirror: a client's exact copy of the map of a node, kept up by its messages.

``~/changed`` states all voxels that a scan changed, as they are now and not by how much, so that
a message applied twice, or again after a newer full map, does no harm. ``~/normals`` states the
full map from time to time: it starts a copy, and mends one that has missed a change. Both carry
the moments where ``publish.moments`` asks for them.
"""

from __future__ import annotations

from collections import deque
from itertools import dropwhile
from typing import Any

import numpy as np

from surfel_mapper.mapping.channels import channel_names
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.messages.map_cloud import moments_in
from surfel_mapper.messages.pointcloud2 import to_scan

MAX_RECENT = 100
"""So many changes are kept for when a full map of before them arrives late: 5 s at 20 Hz."""


RESET_NS = 10**9
"""A stamp that goes back by more means that time was set back; by less, another sensor."""


class MapMirror:
    """
    A copy of a map that follows another.

    Parameters
    ----------
    voxel_size_m : float
        ``map.voxel_size_m`` of the node.
    columns : tuple of str
        What else its map sums: ``intensity``, ``rgb``.

    Attributes
    ----------
    map : SurfelMap
        The copy, to be read only.
    stamp_ns : int
        Stamp of the newest scan in it; 0 at first.
    is_complete : bool
        Whether a full map has come; until then only what changed meanwhile is there.

    """

    def __init__(self, voxel_size_m: float, columns: tuple[str, ...] = ()) -> None:
        """Mirror an empty map."""
        self.map = SurfelMap(voxel_size_m, columns=columns)
        self.stamp_ns = 0
        self.is_complete = False
        self._channels = channel_names(columns)
        self._recent: deque[tuple[int, ScanMoments]] = deque(maxlen=MAX_RECENT)

    def replace(self, msg: Any) -> None:
        """
        Take the full map of a message on ~/normals; changes since then are applied to it.

        Parameters
        ----------
        msg : sensor_msgs/PointCloud2
            Of any library.

        Raises
        ------
        CloudFormatError
            If it holds no moments, or those of other voxels. Nothing has changed then.

        """
        stamp_ns, moments = self._read(msg)
        self.map.clear()
        self.map.insert(moments)
        self.stamp_ns = stamp_ns
        for changed_ns, changed in dropwhile(lambda it: it[0] < stamp_ns, self._recent):
            self._put(changed)
            self.stamp_ns = changed_ns
        self.is_complete = True

    def change(self, msg: Any) -> None:
        """Apply a message on ~/changed; see replace."""
        stamp_ns, moments = self._read(msg)
        if stamp_ns < self.stamp_ns - RESET_NS:
            self._recent.clear()
        self._recent.append((stamp_ns, moments))
        self._put(moments)
        self.stamp_ns = stamp_ns

    def _read(self, msg: Any) -> tuple[int, ScanMoments]:
        """Return the stamp and the moments in a message."""
        scan = to_scan(msg)
        if not len(scan):
            return scan.stamp_ns, self.map.moments(np.empty((0, 3), np.int32))
        columns = {**dict(zip('xyz', scan.points.T, strict=True)), **scan.columns}
        return scan.stamp_ns, moments_in(columns, self.map.voxel_size_m, self._channels)

    def _put(self, moments: ScanMoments) -> None:
        """Put voxels in the place of what the copy has of them."""
        self.map.remove(self.map.moments(moments.voxel_index))
        self.map.insert(moments.select(moments.count > 0))
