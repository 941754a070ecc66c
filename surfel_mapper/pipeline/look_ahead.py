# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LookAhead: another thread deskews, filters and reduces the next scan, with two ``map.threads``.

It reads nothing that the mapping changes: the poses are looked up before, and the voxels of the
map are not accessed. The order changes no bit. Work that was begun is used only for the same scan
at the same pose and with the same settings. Otherwise it is done again.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from surfel_mapper.config import Config
from surfel_mapper.geometry import Transform
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.pipeline.preparation import reduced
from surfel_mapper.pipeline.prepared import Prepared
from surfel_mapper.scan import Scan
from surfel_mapper.threads import pool


class Begun(NamedTuple):
    """A scan that another thread prepares and reduces, and the arguments of both."""

    scan: Scan
    T_map_sensor: Transform
    config: Config
    result: Future[Prepared]

    def is_of(self, scan: Scan, T_map_sensor: Transform, config: Config) -> bool:
        """Return whether a scan is this one, at the same pose and with the same settings."""
        if self.scan is not scan or self.config is not config:
            return False
        return self.T_map_sensor is T_map_sensor or np.array_equal(self.T_map_sensor, T_map_sensor)


class LookAhead:
    """
    Prepares the next scan in another thread.

    Parameters
    ----------
    surfel_map : SurfelMap
        The map that the scans are inserted into.
    threads : int
        Number of threads, two or more.

    """

    def __init__(self, surfel_map: SurfelMap, threads: int) -> None:
        self._map = surfel_map
        self._pool = pool(threads)
        self._begun: Begun | None = None

    def begin(
        self,
        scan: Scan,
        T_map_sensor: Transform,
        config: Config,
        prepare: Callable[[Scan, Transform], Callable[[], Prepared]],
    ) -> None:
        """
        Begin to prepare and reduce a scan in the other thread, unless that was begun before.

        ``prepare`` is called here, the function that it returns in the other thread.
        """
        begun = self._begun
        if begun is not None and begun.is_of(scan, T_map_sensor, config):
            return
        assert self._pool is not None, 'two threads or more'
        work = prepare(scan, T_map_sensor)
        result = self._pool.submit(run_ahead, work, T_map_sensor, self._map, config)
        self._begun = Begun(scan, T_map_sensor, config, result)

    def take(
        self, scan: Scan, T_map_sensor: Transform, config: Config
    ) -> Callable[[], Prepared] | None:
        """Return the function that waits for a scan that was begun, and None for another scan."""
        begun, self._begun = self._begun, None
        if begun is None or not begun.is_of(scan, T_map_sensor, config):
            return None
        return begun.result.result


def run_ahead(
    work: Callable[[], Prepared],
    T_map_sensor: Transform,
    surfel_map: SurfelMap,
    config: Config,
) -> Prepared:
    """Prepare and reduce a scan; errors of reduction wait until its moments are asked for."""
    prepared = work()
    try:
        return replace(
            prepared, windowed=reduced(prepared.filtered, T_map_sensor, surfel_map, config)
        )
    except Exception as error:
        return replace(prepared, windowed=error)
