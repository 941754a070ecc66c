# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Time from the start of ``surfel-mapper view`` until cities of 5 million surfels are sent.

The cities are drawn at random: 90 and 100 blocks of 36 m, ground and four walls each, in voxels of
0.2 m. The command runs once before it is timed, so kernels are compiled and the file is in memory;
then its whole life is timed five times, from the shell's start of Python until everything that is
drawn has been written for the viewer.
"""

from __future__ import annotations

from pathlib import Path
import resource
import statistics
import subprocess
import sys
import tempfile
import time

import numpy as np

from surfel_mapper import SurfelMap
from test.bench.options import Options
from test.bench.report import Row

CITIES, BLOCK_M = ((10, 9), (10, 10)), 36.0

RUNS = 5

BUDGET_S = 5.0


def city(blocks: tuple[int, int], seed: int = 1) -> SurfelMap:
    """Return the map of a grid of houses with the streets between them."""
    surfel_map = SurfelMap(0.2)
    rng = np.random.default_rng(seed)
    num = 300_000
    for corner in np.ndindex(*blocks):
        place = BLOCK_M * np.array([*corner, 0.0])
        ground = rng.uniform(0.0, [BLOCK_M, BLOCK_M, 0.0], (num, 3))
        ground[:, 2] = 0.05 * np.sin(ground[:, 0])
        wall = rng.uniform([3.0, 3.0, 0.0], [33.0, 33.0, 9.0], (num, 3))
        side = rng.integers(0, 4, num)
        wall[np.arange(num), side // 2] = np.where(side % 2, 33.05, 3.05)
        points = np.concatenate([ground, wall])
        points += rng.normal(0.0, 0.01, points.shape)
        surfel_map.add(points + place, origin=[*place[:2], 2.0])
    return surfel_map


def run(options: Options) -> list[Row]:
    """Return a row for each format of each city."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for blocks in CITIES:
            surfel_map = city(blocks)
            for name in ('npz', 'parquet'):
                path = Path(folder) / f'city.{name}'
                surfel_map.save(path)
                rows.append({'surfels': surfel_map.num_surfels(5), **times(path)})
    return rows


def times(path: Path) -> Row:
    """Return how long the command takes for a map, the median and the worst of some runs."""
    command = [sys.executable, '-m', 'surfel_mapper.cli.main', 'view', str(path)]
    command += ['--rrd', str(path.with_suffix('.rrd'))]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    shown_s = []
    before = used_s()
    for _ in range(RUNS):
        begin = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        shown_s.append(time.perf_counter() - begin)
    return {
        'what': f'view {path.suffix[1:]}',
        'megabytes': path.stat().st_size / 1e6,
        'shown_s': statistics.median(shown_s),
        'worst_s': max(shown_s),
        'cpu_s': (used_s() - before) / RUNS,
        'budget_shown_s': BUDGET_S,
    }


def used_s() -> float:
    """Return the processor time of all commands so far, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
