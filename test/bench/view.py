# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Time until ``surfel-mapper view`` has sent a city of more than 5 million surfels.

The city is drawn at random: 100 blocks of 36 m, ground and four walls each, in voxels of 0.2 m.
The command runs once before it is timed, so kernels are compiled and the file is in memory.
"""

from __future__ import annotations

from pathlib import Path
import resource
import subprocess
import sys
import tempfile
import time

import numpy as np

from surfel_mapper import SurfelMap
from test.bench.options import Options
from test.bench.report import Row

BLOCKS, BLOCK_M = 10, 36.0

BUDGET_S = 5.0


def city(seed: int = 1, blocks: int = BLOCKS) -> SurfelMap:
    """Return the map of blocks x blocks houses with the streets between them."""
    surfel_map = SurfelMap(0.2)
    rng = np.random.default_rng(seed)
    num = 300_000
    for corner in np.ndindex(blocks, blocks):
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
    """Return a row for each format of a map."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        surfel_map = city()
        surfels = surfel_map.num_surfels(5)
        for name in ('npz', 'parquet'):
            path = Path(folder) / f'city.{name}'
            surfel_map.save(path)
            command = [sys.executable, '-m', 'surfel_mapper.cli.main', 'view', str(path)]
            command += ['--rrd', f'{folder}/city.rrd']
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            before, begin = used_s(), time.perf_counter()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            shown_s = time.perf_counter() - begin
            rows.append(
                {
                    'what': f'view {name}',
                    'surfels': surfels,
                    'megabytes': path.stat().st_size / 1e6,
                    'shown_s': shown_s,
                    'cpu_s': used_s() - before,
                    **({'budget_shown_s': BUDGET_S} if name == 'npz' else {}),
                }
            )
    return rows


def used_s() -> float:
    """Return the processor time of all commands so far, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
