# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What a scan costs in longer windows and larger maps, on one core.

It should be the same. The maps that are compared take turns, scan by scan, so that whatever else
the machine does hits all alike, and every other scan in the opposite order, so that none always
finds the scan in the cache. ``ratio`` is between medians, the first being 1. The larger maps hold
voxels far from the street that no scan touches.
"""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter

import numpy as np

from surfel_mapper.mapping.surfel_map import SurfelMap
from test.bench.machine import one_core
from test.bench.options import Options, WARM_SCANS
from test.bench.ours import Ours
from test.bench.report import Row, spread
from test.bench.street import Street

FAR_INDEX = 20_000
"""Where the voxels begin that only fill a map: far along x."""

BATCH = 10_000
"""So many are added at once: fewer than a scan has, for which the map keeps memory to reduce."""


def run(options: Options) -> list[Row]:
    """Return a row for every length of window and every size of map, by voxel size."""
    street = Street(options)
    longest = max(options.windows) + WARM_SCANS
    street.prepare(max(longest, options.untimed) + options.scans)
    rows: list[Row] = []
    with one_core():
        for size_m in options.voxel_sizes_m:
            windows = {window: Ours(size_m, window) for window in options.windows}
            times = in_turns(windows, street, longest, options.scans)
            rows += compared(size_m, 'window', windows, times)
            maps = {voxels: Ours(size_m, options.window) for voxels in options.map_voxels}
            for voxels, ours in maps.items():
                fill(ours.map, voxels)
            times = in_turns(maps, street, options.untimed, options.scans)
            rows += compared(size_m, 'map', maps, times)
    return rows


def in_turns(
    maps: Mapping[int, Ours], street: Street, untimed: int, timed: int
) -> dict[int, list[float]]:
    """Return the times of every map, each given every scan."""
    times: dict[int, list[float]] = {name: [] for name in maps}
    for number, message, counts in street.drive(untimed, timed):
        pose = street.pose(number)
        for name in sorted(maps, reverse=number % 2 == 1):
            start = perf_counter()
            maps[name].step(message, pose)
            if counts:
                times[name].append((perf_counter() - start) * 1e3)
    return times


def compared(
    size_m: float, varied: str, maps: Mapping[int, Ours], times: Mapping[int, list[float]]
) -> list[Row]:
    """Return a row for each map, with the ratio to the first."""
    first = float(np.median(next(iter(times.values()))))
    return [
        {
            'voxel_m': size_m,
            'varied': varied,
            'window': len(ours.scans),
            'voxels': ours.map.num_voxels,
            **spread(times[name]),
            'ratio': float(np.median(times[name])) / first,
        }
        for name, ours in maps.items()
    ]


def fill(surfel_map: SurfelMap, num_voxels: int) -> None:
    """Add so many voxels of one point each, in a block far away."""
    side = int(np.ceil(num_voxels ** (1.0 / 3.0)))
    for start in range(0, num_voxels, BATCH):
        number = np.arange(start, min(start + BATCH, num_voxels))
        index = np.stack([number // side**2 + FAR_INDEX, number // side % side, number % side], 1)
        surfel_map.add((index + 0.5) * surfel_map.voxel_size_m)
