# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Bag of surfels to play beside the input: the messages that the node would have published.

Two topics of PointCloud2 with the names and layout of the node's: ``changed`` after every scan,
and ``normals``, the whole map. Both are recorded and stamped with the stamp of the scan, so that
RViz and Foxglove show them in step with the input. The whole map is written at most once a
second, and only when as many surfels have changed as it has, so the bag grows with the changes
and not with the square of the map.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from surfel_mapper.bags.writer import BagWriter
from surfel_mapper.mapping.surfels import surfel_columns
from surfel_mapper.messages.pointcloud2 import from_columns

if TYPE_CHECKING:
    from surfel_mapper.mapping.surfels import Surfels
    from surfel_mapper.pipeline import Mapper, Update

CHANGED, NORMALS = '/surfel_mapper/changed', '/surfel_mapper/normals'

EVERY_NS = 1_000_000_000
"""Least time between two whole maps."""


class NormalsBag:
    """
    Writes the surfels of a map as it grows.

    Parameters
    ----------
    bag : BagWriter
        Entered; the caller closes it.
    mapper : Mapper
        Makes the updates and holds the map.

    """

    def __init__(self, bag: BagWriter, mapper: Mapper) -> None:
        self._bag = bag
        self._mapper = mapper
        self._min_points = mapper.config.map.min_points
        is_adaptive = mapper.config.publish.adaptive
        self._cut = mapper.map.adaptive_cut(self._min_points) if is_adaptive else None
        self._newest: Update | None = None
        self._written_ns: int | None = None
        self._changed = 0

    def add(self, update: Update) -> None:
        """Write the surfels that a scan changed, and the whole map when it is due."""
        self._newest = update
        changed = self._cut.refresh().surfels if self._cut else update.changed
        if len(changed):
            self._write(CHANGED, update, changed)
        self._changed += len(changed)
        num_surfels = self._mapper.map.num_surfels(self._min_points)
        last_ns = self._written_ns
        is_due = last_ns is None or abs(update.stamp_ns - last_ns) >= EVERY_NS
        if is_due and self._changed >= num_surfels:
            self._write_map(update)

    def finish(self) -> None:
        """Write the map after the last scan."""
        if self._newest is not None and self._changed:
            self._write_map(self._newest)

    def _write_map(self, update: Update) -> None:
        surfels = self._cut.surfels() if self._cut else self._mapper.map.surfels(self._min_points)
        if len(surfels):
            self._write(NORMALS, update, surfels)
        self._written_ns, self._changed = update.stamp_ns, 0

    def _write(self, topic: str, update: Update, surfels: Surfels) -> None:
        cloud = from_columns(surfel_columns(surfels))
        stamp_ns = update.stamp_ns
        self._bag.write_cloud(
            topic, stamp_ns, stamp_ns, update.frame_id, cloud, latched=topic == NORMALS
        )
