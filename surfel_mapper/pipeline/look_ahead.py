# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LookAhead: the next scan is reduced by another thread while the map takes the one before it.

Reducing reads nothing of the map, so when it happens changes no bit. What was begun counts only
for the same scan at the same pose; if anything has come between, it is done once more.
"""

from __future__ import annotations

from concurrent.futures import Future
from typing import NamedTuple

import numpy as np

from surfel_mapper.config import Config
from surfel_mapper.geometry import Transform
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import WindowedScan
from surfel_mapper.pipeline.reduction import reduced
from surfel_mapper.scan import Scan
from surfel_mapper.threads import pool


class Begun(NamedTuple):
    """A scan that is being reduced, and what the result holds for."""

    scan: Scan
    T_map_sensor: Transform
    config: Config
    result: Future[WindowedScan]


class LookAhead:
    """
    Reduces scans, ahead of time where a thread is there for it.

    Parameters
    ----------
    surfel_map : SurfelMap
        Where the scans will go.
    threads : int
        With less than two nothing is begun.

    """

    def __init__(self, surfel_map: SurfelMap, threads: int) -> None:
        """Have begun nothing."""
        self._map = surfel_map
        self._pool = pool(threads)
        self._begun: Begun | None = None

    @property
    def is_possible(self) -> bool:
        """Whether there is a thread beside the caller's."""
        return self._pool is not None

    def begin(self, scan: Scan, T_map_sensor: Transform, config: Config) -> None:
        """Begin to reduce a scan, unless that was begun before."""
        if self._pool is None or self._is_begun(scan, T_map_sensor, config):
            return
        result = self._pool.submit(reduced, scan, T_map_sensor, self._map, config)
        self._begun = Begun(scan, T_map_sensor, config, result)

    def reduced(self, scan: Scan, T_map_sensor: Transform, config: Config) -> WindowedScan:
        """
        Return a scan as its moments at a pose; see ``reduction.reduced``.

        Raises
        ------
        MapLimitError
            If a voxel gets more than 2^23 points.

        """
        is_begun = self._is_begun(scan, T_map_sensor, config)
        begun, self._begun = self._begun, None
        if begun is not None and is_begun:
            return begun.result.result()
        return reduced(scan, T_map_sensor, self._map, config)

    def _is_begun(self, scan: Scan, T_map_sensor: Transform, config: Config) -> bool:
        begun = self._begun
        return (
            begun is not None
            and begun.scan is scan
            and begun.config is config
            and np.array_equal(begun.T_map_sensor, T_map_sensor)
        )
