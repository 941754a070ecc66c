# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LocalMap: the scans of the last metres, in the frame of the poses, for registration.

If loops are to be found, scans must not be registered to a place that was seen before the last
metres: the drift since then would tear it apart or jump. The map of the last metres is in
``frames.fixed``, which does not jump either when the map is corrected.
"""

from __future__ import annotations

from dataclasses import replace

from surfel_mapper.config import Config, WindowConfig
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import SlidingWindow, WindowedScan

MAX_BYTES = 1 << 29
"""Limit of the kept moments, bytes: some 500 scans, for a sensor that stands still."""


class LocalMap:
    """
    The last scans, in the fixed frame.

    Parameters
    ----------
    config : Config
        Voxel size, columns, and ``LoopsConfig.odometry_map_m``.

    Attributes
    ----------
    surfel_map : SurfelMap
        The map of these scans.

    """

    def __init__(self, config: Config) -> None:
        self.surfel_map = SurfelMap(config.map.voxel_size_m, columns=config.map.columns)
        limits = WindowConfig(
            max_scans=0, max_distance_m=config.loops.odometry_map_m, max_bytes=MAX_BYTES
        )
        self._window = SlidingWindow(self.surfel_map, limits)

    def add(self, windowed: WindowedScan) -> None:
        """Add the moments of a scan at its pose in the fixed frame."""
        # a copy: the map of all scans keeps its own hints of rows
        self._window.insert(replace(windowed, moments=replace(windowed.moments), points=None))

    def clear(self) -> None:
        """Drop all scans."""
        self._window.clear()
