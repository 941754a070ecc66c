# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LUM on one core, beside PCL's; then how it grows with the edges.

``compute`` is one call of all iterations from clouds and pairs just given, sums over the pairs
included; an iteration is the time of each further one. PCL is compiled from peers/pcl_lum.cpp,
where a compiler and Debian's libpcl-dev are there, and gets the same graph; else its figures are
those stated for that package on another machine, and marked so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import os
from pathlib import Path
import subprocess
from time import perf_counter

import numpy as np

from surfel_mapper.alignment import LUM
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.peers.pcl import compiled
from test.bench.report import Row

PCL_LIBRARIES = ('registration', 'search', 'kdtree', 'octree', 'common')

REPEATS = 5


@dataclass(frozen=True)
class Case:
    """A graph, the goal for this package, and the time stated for PCL, ms."""

    name: str
    vertices: int
    ends: tuple[tuple[int, int], ...]
    pairs: int
    iterations: int
    budget_ms: float | None = None
    pcl_stated_ms: float | None = None


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
    Case('20 scans', 20, chain(20, range(1, 20), 100), 5000, 5, 60.0, 187.0),
    Case('200 scans, 10 loops', 200, loops(200, 10), 200, 1, 100.0, 288.0),
    *(
        Case(f'{num} scans, 5 edges each', num, chain(num, range(1, 6), 5 * num), 200, 1)
        for num in (100, 200, 400, 800, 1600)
    ),
)


def run(options: Options) -> list[Row]:
    """Return a row for every graph."""
    program = compiled('pcl_lum', PCL_LIBRARIES, options)
    rows: list[Row] = []
    with one_core():
        for case in CASES:
            clouds = points(case)
            compute_ms, iteration_ms = ours(case, clouds)
            rows.append(
                {
                    'graph': case.name,
                    'edges': len(case.ends),
                    'pairs': case.pairs,
                    'iterations': case.iterations,
                    'compute_ms': compute_ms,
                    'budget_ms': case.budget_ms,
                    'iteration_ms': iteration_ms,
                    'us_edge': 1e3 * iteration_ms / len(case.ends),
                    **pcl(case, clouds, program),
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


def ours(case: Case, clouds: np.ndarray) -> tuple[float, float]:
    """Return milliseconds of compute, and of an iteration more; the least of some repeats."""
    pairs = np.repeat(np.arange(case.pairs)[:, None], 2, axis=1)
    compute, more = [], []
    for _ in range(REPEATS):
        lum = LUM(max_iterations=case.iterations)
        for cloud in clouds:
            lum.add_point_cloud(cloud)
        for source, target in case.ends:
            lum.set_correspondences(source, target, pairs)
        start = perf_counter()
        lum.compute()
        compute.append((perf_counter() - start) * 1e3)
        times = []
        for iterations in (1, 3):
            lum.max_iterations = iterations
            start = perf_counter()
            lum.compute()
            times.append((perf_counter() - start) * 1e3)
        more.append((times[1] - times[0]) / 2.0)
    return min(compute), min(more)


def pcl(case: Case, clouds: np.ndarray, program: Path | None) -> Row:
    """Return milliseconds of PCL, measured or stated, and how many times ours they are."""
    if program is None:
        if case.pcl_stated_ms is None:
            return {}
        return {'pcl_ms': case.pcl_stated_ms, 'pcl': 'as stated, not measured'}
    if case.vertices > 200:
        return {'pcl': 'left out: minutes'}
    repeats = REPEATS if case.vertices < 100 else 2
    numbers = [case.vertices, len(case.ends), case.pairs, case.iterations, repeats]
    text = '\n'.join(
        [' '.join(map(str, numbers)), ' '.join(f'{s} {t}' for s, t in case.ends)]
        + [' '.join(f'{value:.7g}' for value in cloud.ravel()) for cloud in clouds]
    )
    done = subprocess.run(
        [program], input=text, capture_output=True, text=True, check=True, env=os.environ
    )
    return {'pcl_ms': min(float(line) for line in done.stdout.split()), 'pcl': 'measured'}
