# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Cost of a scan in longer windows and larger maps, on one core.

It should be the same. The compared maps take turns, scan by scan, so that other load affects all
equally, and every other scan in the opposite order, so that no map always finds the scan in the
cache. Times are those of the processor. ``ratio`` is between medians, the first being 1. In a
longer window the evicted scan shares fewer voxels with the new one, so more voxels change:
``changed`` is their median number, ``ratio_changed`` the ratio of the times by changed voxel. The
larger maps hold voxels far from the street that no scan touches.

Besides the street, a real scan of an HDL-32 is moved by 0.3 m a step, if SURFEL_MAPPER_TEST_DATA
leads to it. Its largest map takes 2.4 GB.
"""

from __future__ import annotations

from collections.abc import Mapping
from time import process_time

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.surfel_map import SurfelMap
from test.bench.machine import one_core, prefault
from test.bench.options import Options, WARM_SCANS
from test.bench.ours import Ours
from test.bench.real import real_scans, STEP_M
from test.bench.report import Row, spread
from test.bench.street import Street

FAR_INDEX = 20_000
"""Start of the block of filler voxels, far along x."""

BATCH = 10_000
"""Number of voxels added at once; fewer than a scan has, so no more memory is kept."""

REAL = 'HDL-32 street'
"""The real scan, 34,000 points: 1000 of them fit into a window of 1 GB."""

REAL_WINDOW = 20
"""Scans in the window of maps of different sizes."""

Figures = dict[int, list[float]]
"""A figure a scan, by the varied quantity."""


def run(options: Options) -> list[Row]:
    """Return a row for every length of window and every size of map, by voxel size."""
    street = Street(options)
    longest = max(options.windows) + WARM_SCANS
    street.prepare(max(longest, options.untimed) + options.scans)
    rows: list[Row] = []
    with one_core():
        for size_m in options.voxel_sizes_m:
            windows = {window: Ours(size_m, window) for window in options.windows}
            rows += compared(
                size_m, 'window', windows, *in_turns(windows, street, longest, options.scans)
            )
            maps = {voxels: Ours(size_m, options.window) for voxels in options.map_voxels}
            for voxels, ours in maps.items():
                fill(ours.map, voxels)
            rows += compared(
                size_m, 'map', maps, *in_turns(maps, street, options.untimed, options.scans)
            )
            rows += real_rows(options, size_m)
    return rows


def real_rows(options: Options, size_m: float) -> list[Row]:
    """Return the rows of a real scan that moves through windows and maps."""
    scan = dict(real_scans()).get(REAL)
    if scan is None:
        return []
    longest = max(options.real_windows) + WARM_SCANS
    windows = {window: Ours(size_m, window) for window in options.real_windows}
    figures = moved_in_turns(windows, scan, longest, options.scans)
    rows = compared(size_m, f'window, {REAL}', windows, *figures)
    del windows
    maps = {voxels: Ours(size_m, REAL_WINDOW) for voxels in options.real_map_voxels}
    for voxels, ours in maps.items():
        fill(ours.map, voxels)
    figures = moved_in_turns(maps, scan, REAL_WINDOW + WARM_SCANS, options.scans)
    return rows + compared(size_m, f'map, {REAL}', maps, *figures)


def moved_in_turns(
    maps: Mapping[int, Ours], scan: npt.NDArray[np.float32], untimed: int, timed: int
) -> tuple[Figures, Figures]:
    """Return what ``in_turns`` does, of a scan that is moved a step at a time."""
    times: Figures = {name: [] for name in maps}
    changed: Figures = {name: [] for name in maps}
    prefault()
    pose = np.eye(4)
    for number in range(untimed + timed):
        pose[:3, 3] = np.array(STEP_M) * number
        for name in sorted(maps, reverse=number % 2 == 1):
            ours = maps[name]
            start = process_time()
            ours.put(ours.map.reduce(scan, pose, origin=pose[:3, 3]))
            if number >= untimed:
                times[name].append((process_time() - start) * 1e3)
                changed[name].append(ours.num_changed)
    return times, changed


def in_turns(
    maps: Mapping[int, Ours], street: Street, untimed: int, timed: int
) -> tuple[Figures, Figures]:
    """Return times, and numbers of changed voxels, of every map, each given every scan."""
    times: Figures = {name: [] for name in maps}
    changed: Figures = {name: [] for name in maps}
    prefault()
    for number, message, counts in street.drive(untimed, timed):
        pose = street.pose(number)
        for name in sorted(maps, reverse=number % 2 == 1):
            start = process_time()
            maps[name].step(message, pose)
            if counts:
                times[name].append((process_time() - start) * 1e3)
                changed[name].append(maps[name].num_changed)
    return times, changed


def compared(
    size_m: float, varied: str, maps: Mapping[int, Ours], times: Figures, changed: Figures
) -> list[Row]:
    """Return a row for each map, with the ratio to the first."""
    medians = {name: float(np.median(values)) for name, values in times.items()}
    numbers = {name: float(np.median(values)) for name, values in changed.items()}
    first = next(iter(maps))
    return [
        {
            'voxel_m': size_m,
            'varied': varied,
            'window': len(ours.scans),
            'voxels': ours.map.num_voxels,
            **spread(times[name]),
            'changed': int(numbers[name]),
            'ratio': medians[name] / medians[first],
            'ratio_changed': medians[name] / numbers[name] / (medians[first] / numbers[first]),
        }
        for name, ours in maps.items()
    ]


def fill(surfel_map: SurfelMap, num_voxels: int) -> None:
    """Add a number of voxels of one point each, in a block far away."""
    side = int(np.ceil(num_voxels ** (1.0 / 3.0)))
    for start in range(0, num_voxels, BATCH):
        number = np.arange(start, min(start + BATCH, num_voxels))
        index = np.stack([number // side**2 + FAR_INDEX, number // side % side, number % side], 1)
        surfel_map.add((index + 0.5) * surfel_map.voxel_size_m)
