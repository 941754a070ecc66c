# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reduction of scans to the exact moments that enter the map and the window, and that leave it.

With ``map.threads`` another thread deskews, filters and reduces the next two scans while the map
takes the one before them. None of these reads anything of the map, so the order changes no bit.
Work that was begun is used only for the same scan at the same pose; otherwise it is done again.
The other thread decodes the scans too. If it is behind, this one decodes, instead of waiting.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from time import perf_counter, sleep
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.geometry import Transform
from surfel_mapper.helpers import Job
from surfel_mapper.kernels.lanes import FULL
from surfel_mapper.mapping.channels import CHANNELS, summed_columns
from surfel_mapper.mapping.moments import LEAST_SHARED, point_keys, ScanMoments
from surfel_mapper.mapping.reducer import within
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import WindowedScan
from surfel_mapper.pipeline.prepared import FilteredScan
from surfel_mapper.scan import Scan
from surfel_mapper.threads import pool

Step = Callable[[], object]

AHEAD = 2
"""Scans that are begun ahead: after the first, the thread has work while the next is decoded."""

LONG_WAIT_S = 0.0008
"""
Wait for the other thread after which this one decodes scans, s. Decoding 500,000 points takes 0.7
ms; if it took longer than the wait, this thread would be the one behind.
"""


class WarmUpSteps(NamedTuple):
    """
    The steps that compile all kernels, in the order of need.

    Attributes
    ----------
    first_scan : list of callable
        Compile the kernels that insert a scan by the settings.
    every_scan : list of callable
        Compile those that remove a scan from the window, and derive the surfels that changed.
    rare : list of callable
        Compile all others: for points of another type, and voxels of 65536 points.

    """

    first_scan: list[Step]
    every_scan: list[Step]
    rare: list[Step]


class Ahead(NamedTuple):
    """Result of the other thread: the points of a scan, and their moments or the error."""

    points: FilteredScan
    windowed: WindowedScan | Exception


class Begun(NamedTuple):
    """A scan that another thread prepares and reduces, and the arguments of both."""

    scan: Scan
    T_map_sensor: Transform
    config: Config
    result: Job[Ahead]

    def is_of(self, scan: Scan, T_map_sensor: Transform, config: Config) -> bool:
        """Return whether a scan is this one, at the same pose and with the same settings."""
        if self.scan is not scan or self.config is not config:
            return False
        return self.T_map_sensor is T_map_sensor or np.array_equal(self.T_map_sensor, T_map_sensor)


class Reduction:
    """
    Reduces scans, ahead of time if there is a thread for it.

    Parameters
    ----------
    surfel_map : SurfelMap
        The map that the scans are inserted into.
    threads : int
        With fewer than two no reduction is begun ahead of time.

    Attributes
    ----------
    scans_ahead : int
        Number of scans that may be begun before they are reduced; 0 without another thread.

    """

    def __init__(self, surfel_map: SurfelMap, threads: int) -> None:
        self._map = surfel_map
        self._pool = pool(threads)
        self.scans_ahead = AHEAD if self._pool is not None else 0
        self._begun: deque[Begun] = deque(maxlen=AHEAD)
        self._waited_s = 0.0
        self._decodes = False

    def begin(
        self,
        scan: Scan,
        T_map_sensor: Transform,
        config: Config,
        prepare: Callable[[Scan, Transform], Callable[[], FilteredScan]],
    ) -> None:
        """
        Begin to prepare and reduce a scan in the other thread, unless that was begun before.

        ``prepare`` is called here, the function that it returns in the other thread. The results
        of the last ``AHEAD`` scans are kept.
        """
        if self._pool is None:
            return
        if any(begun.is_of(scan, T_map_sensor, config) for begun in self._begun):
            return
        is_behind = bool(self._begun) and not self._begun[-1].result.is_done
        self._decodes = is_behind and (self._decodes or self._waited_s > LONG_WAIT_S)
        if self._decodes:
            with suppress(Exception):  # the other thread tries again, and has it reported
                _ = scan.points
        work = prepare(scan, T_map_sensor)
        result = self._pool.submit(run_ahead, work, T_map_sensor, self._map, config)
        self._begun.append(Begun(scan, T_map_sensor, config, result))
        if not self._decodes:
            sleep(0.0)  # release Python's lock: else the job waits 0.3 ms, for our next kernel

    def begun(
        self, scan: Scan, T_map_sensor: Transform, config: Config
    ) -> Callable[[], FilteredScan] | None:
        """
        Return a function that waits for the points of a scan that was begun, or None.

        Work that was begun before it, for another scan, pose or settings, is forgotten.
        """
        while self._begun and not self._begun[0].is_of(scan, T_map_sensor, config):
            self._begun.popleft()
        if not self._begun:
            return None
        return partial(self._wait_for, self._begun[0].result)

    def _wait_for(self, result: Job[Ahead]) -> FilteredScan:
        """Return the points of a scan that was begun, and note how long that took."""
        start = perf_counter()
        try:
            return result.result().points
        finally:
            self._waited_s = perf_counter() - start

    def reduce(self, scan: Scan, T_map_sensor: Transform, config: Config) -> WindowedScan:
        """
        Return a prepared scan as its moments at a pose; see ``reduced``.

        Raises
        ------
        MapLimitError
            If a voxel gets more than 2^23 points, or a point is out of the reach of the map.

        """
        if self._begun:
            ahead = self._begun.popleft().result.result()
            if ahead.points.filtered is scan:
                if isinstance(ahead.windowed, Exception):
                    raise ahead.windowed
                return ahead.windowed
        return reduced(scan, T_map_sensor, self._map, config)


def run_ahead(
    work: Callable[[], FilteredScan],
    T_map_sensor: Transform,
    surfel_map: SurfelMap,
    config: Config,
) -> Ahead:
    """Prepare and reduce a scan; errors of reduction wait until its moments are asked for."""
    points = work()
    try:
        return Ahead(points, reduced(points.filtered, T_map_sensor, surfel_map, config))
    except Exception as error:
        return Ahead(points, error)


def reduced(
    scan: Scan, T_map_sensor: Transform, surfel_map: SurfelMap, config: Config
) -> WindowedScan:
    """Return a scan as its moments at a pose, with its points if the window keeps them."""
    limits = config.input
    moments = surfel_map.reduce(
        scan.points,
        T_map_sensor,
        origin=viewpoint(T_map_sensor, config),
        min_range_m=limits.min_range_m,
        max_range_m=limits.max_range_m or np.inf,
        columns=scan.columns,
    )
    windowed = WindowedScan(
        moments=moments,
        stamp_ns=scan.stamp_ns,
        T_map_sensor=T_map_sensor,
        frame_id=scan.frame_id,
    )
    if not config.window.keep_points:
        return windowed
    stay = within(scan.points, limits.min_range_m, limits.max_range_m)
    if 'beyond_map' in moments.left_out:
        stay &= point_keys(scan.points, T_map_sensor, surfel_map.voxel_size_m) >= 0
    entered = scan.select(stay)
    columns = summed_columns(entered.columns, surfel_map.columns)
    return replace(windowed, points=entered.points, columns=columns)


def moments_at(
    scan: WindowedScan, T_map_sensor: Transform, surfel_map: SurfelMap, config: Config
) -> ScanMoments:
    """Return the moments of a scan of the window, whose points are kept, at another pose."""
    assert scan.points is not None, 'only scans with points are moved'
    seen_from = viewpoint(T_map_sensor, config)
    return surfel_map.reduce(scan.points, T_map_sensor, origin=seen_from, columns=scan.columns)


def viewpoint(T_map_sensor: Transform, config: Config) -> Transform | None:
    """Return the position of the sensor; None if unknown, and normals stay as they are."""
    if config.pose.source != 'identity':
        return T_map_sensor[:3, 3]
    place = standing_sensor(config)
    if place is None:
        return None
    moved: npt.NDArray[np.float64] = (T_map_sensor[:3, :3] * place).sum(axis=1)
    return moved + T_map_sensor[:3, 3]


def standing_sensor(config: Config) -> npt.NDArray[np.float64] | None:
    """
    Return where the sensor stands with ``pose.source: identity``, (3,) m in the fixed frame.

    Only ``frames.base_to_sensor`` tells: clouds in the fixed frame may be those of a sensor that
    stands in its origin, or made of the scans of one that moves.
    """
    values = config.frames.base_to_sensor
    if config.pose.source != 'identity' or config.frames.sensors or not values:
        return None
    return np.array(values[:3])


def warm_up_steps(config: Config) -> WarmUpSteps:
    """Return the steps that compile reduction, insertion and removal."""
    expected: npt.DTypeLike = np.float32
    other: npt.DTypeLike = np.float64
    if config.deskew.enabled:  # which moves points in double precision
        expected, other = other, expected
    return WarmUpSteps(
        first_scan=[partial(compile_adding, config, expected)],
        every_scan=[
            partial(compile_removing, config, expected),
            partial(compile_deriving, config, expected),
        ],
        rare=[
            partial(compile_wide_sums, config, expected),
            partial(compile_adding, config, other),
            partial(compile_removing, config, other),
            partial(compile_wide_sums, config, other),
        ],
    )


def compile_adding(config: Config, dtype: npt.DTypeLike) -> SurfelMap:
    """Compile reducing and adding points of a type, by the threads set; return the map of some."""
    settings, threads = config.map, config.map.threads or 1
    surfel_map = SurfelMap(settings.voxel_size_m, columns=settings.columns, threads=threads)
    num = 1 if threads == 1 else LEAST_SHARED  # in voxels of their own
    points = np.zeros((num, 3), dtype)
    points[:, 0] = settings.voxel_size_m * np.arange(num)
    columns = {name: np.zeros(num) for name in CHANNELS}
    surfel_map.insert(surfel_map.reduce(points, columns=columns))  # add might warn of their unit
    return surfel_map


def compile_deriving(config: Config, dtype: npt.DTypeLike) -> None:
    """Compile deriving surfels, of coarser maps too if they are published."""
    surfel_map = compile_adding(config, dtype)
    surfel_map.surfels_changed(since=0)
    if config.publish.levels:
        surfel_map.coarsen(1).surfels()


def compile_removing(config: Config, dtype: npt.DTypeLike) -> None:
    """Compile removing points of a type, the digest, and checks."""
    surfel_map = SurfelMap(config.map.voxel_size_m, columns=config.map.columns)
    columns = {n: np.zeros(1) for n in CHANNELS}
    moments = surfel_map.add(np.zeros((1, 3), dtype), columns=columns)
    surfel_map.insert(replace(moments))  # a copy is checked
    surfel_map.digest()
    surfel_map.remove(moments)


def compile_wide_sums(config: Config, dtype: npt.DTypeLike) -> None:
    """Compile adding and removing voxels whose sums need 64 bits."""
    surfel_map = SurfelMap(config.map.voxel_size_m, columns=config.map.columns)
    columns = {n: np.zeros(FULL + 1) for n in CHANNELS}
    moments = surfel_map.add(np.zeros((FULL + 1, 3), dtype), columns=columns)
    surfel_map.remove(moments)
