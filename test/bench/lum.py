# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LUM on one core, beside PCL's.

``compute`` is one call of all iterations from clouds and pairs just given, sums over the pairs
included; an iteration is the time of each further one. PCL is compiled from peers/pcl_lum.cpp if
a compiler and Debian's libpcl-dev are installed (or CPATH, LIBRARY_PATH and LD_LIBRARY_PATH name
them), and gets the same graph.

All are medians of processor times, on which other load of the machine has less effect than on
clock times. PCL's are taken between two halves of ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import os
from pathlib import Path
import subprocess
from time import process_time

import numpy as np

from surfel_mapper.alignment import LUM
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.peers.pcl import compiled
from test.bench.report import Row

PCL_LIBRARIES = ('registration', 'search', 'kdtree', 'octree', 'common')

REPEATS = 5
"""Number of timed calls in each half of ours, and of PCL."""


@dataclass(frozen=True)
class Case:
    """A graph."""

    name: str
    vertices: int
    ends: tuple[tuple[int, int], ...]
    pairs: int
    iterations: int


def chain(vertices: int, steps: Sequence[int], edges: int) -> tuple[tuple[int, int], ...]:
    """Return ``number`` edges from each vertex to those some steps ahead, shorter steps first."""
    ends = [(v, v + step) for step in steps for v in range(vertices - step)]
    return tuple(ends[:edges])


def loops(vertices: int, num: int) -> tuple[tuple[int, int], ...]:
    """Return a chain with ``number`` loops, one after the other."""
    size = vertices // num
    closing = tuple((size * k, size * k + size - 1) for k in range(num))
    return chain(vertices, (1,), vertices - 1) + closing


CASES = (
    Case('20 scans', 20, chain(20, range(1, 20), 100), 5000, 5),
    Case('200 scans, 10 loops', 200, loops(200, 10), 200, 1),
    *(
        Case(f'{num} scans, 5 edges each', num, chain(num, range(1, 6), 5 * num), 200, 1)
        for num in (200, 1600)
    ),
)


def run(options: Options) -> list[Row]:
    """Return a row for every graph."""
    program = compiled('pcl_lum', PCL_LIBRARIES, options)
    rows: list[Row] = []
    with one_core():
        for case in CASES:
            clouds = points(case)
            times = ours(case, clouds)
            others = pcl(case, clouds, program)
            compute_ms, iteration_ms = np.median(times + ours(case, clouds), axis=0).tolist()
            rows.append(
                {
                    'graph': case.name,
                    'edges': len(case.ends),
                    'pairs': case.pairs,
                    'iterations': case.iterations,
                    'compute_ms': compute_ms,
                    'iteration_ms': iteration_ms,
                    **others,
                    'x_pcl': others['pcl_ms'] / compute_ms if 'pcl_ms' in others else None,
                }
            )
    return rows


def points(case: Case) -> np.ndarray:
    """Return the clouds of a graph, (V, K, 3) float32: one scene, moved a little, with noise."""
    rng = np.random.default_rng(1)
    scene = rng.uniform(-10.0, 10.0, (case.pairs, 3))
    shift = rng.uniform(-0.2, 0.2, (case.vertices, 1, 3))
    noise = rng.normal(0.0, 0.02, (case.vertices, case.pairs, 3))
    return (scene + shift + noise).astype(np.float32)


def ours(case: Case, clouds: np.ndarray) -> list[tuple[float, float]]:
    """Return the milliseconds of compute, and of a further iteration, for each repeat."""
    pairs = np.repeat(np.arange(case.pairs)[:, None], 2, axis=1)
    found = []
    for _ in range(REPEATS):
        lum = LUM(max_iterations=case.iterations)
        for cloud in clouds:
            lum.add_point_cloud(cloud)
        for source, target in case.ends:
            lum.set_correspondences(source, target, pairs)
        compute_ms = milliseconds(lum)
        times = []
        for lum.max_iterations in (1, 6):
            times.append(milliseconds(lum))
        found.append((compute_ms, (times[1] - times[0]) / 5.0))
    return found


def milliseconds(lum: LUM) -> float:
    """Return the processor time of a call of compute."""
    start = process_time()
    lum.compute()
    return (process_time() - start) * 1e3


def pcl(case: Case, clouds: np.ndarray, program: Path | None) -> Row:
    """Return the median milliseconds of PCL, if it was compiled; they grow with the cube."""
    if program is None or case.vertices > 200:
        return {}
    repeats = REPEATS if case.vertices < 100 else 2
    numbers = [case.vertices, len(case.ends), case.pairs, case.iterations, repeats]
    text = '\n'.join(
        [' '.join(map(str, numbers)), ' '.join(f'{s} {t}' for s, t in case.ends)]
        + [' '.join(f'{value:.7g}' for value in cloud.ravel()) for cloud in clouds]
    )
    done = subprocess.run(
        [program], input=text, capture_output=True, text=True, check=True, env=os.environ
    )
    times = [float(line) for line in done.stdout.split()]
    return {'pcl_ms': float(np.median(times))}
