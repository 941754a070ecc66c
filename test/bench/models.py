# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes, surfaces and Gaussians of a depth camera's clouds of 640 x 480, by voxel size.

A room of analytic surfaces without noise, and the same with that of a Kinect; on one core, from
the organised points to the models, thinning included. Precision and completeness are against the
points themselves, also of Gaussians alone (gmm_). Frames per second follow from the least
processor time (cpu_ms), as the machine may be shared. Open3D gets normals and finds planes only,
from the cloud thinned to 1 cm and from the whole cloud.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import json
import os
from pathlib import Path
import tempfile
from time import perf_counter, thread_time
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models import evaluate, fit, MultiModel
from test.bench import scan_planes, tabletop
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.peers import OPEN3D, PeerSpec
from test.bench.peers.run import environment, output, PeerError, ROOT
from test.bench.report import Row, spread
from test.models.scenes import room, VIEW

OPEN3D_PLANES = PeerSpec(
    name='Open3D detect_planar_patches',
    module='test.bench.peers.open3d_planes',
    requires=OPEN3D,
    less='planes only; no labels',
)

KINECT = 1.425e-3
"""Its sigma by range^2, 1/m."""

SIZES_M = (0.01, 0.015, 0.02, 0.025, 0.03, 0.04, 0.06)
WARM = 2
MOST_RUNS = 15
PEER_RUNS = 3


PEER_SIZES_M = (0.01, 0.0)
"""Thinning of the cloud for Open3D; 0: none."""


def run(options: Options) -> Iterator[Row]:
    """Yield rows of labelled frames of a table, scans of lidars, and rooms."""
    yield from tabletop.run(options)
    yield from scan_planes.run(options)
    yield from rooms(options)


def rooms(options: Options) -> Iterator[Row]:
    """Yield rows of rooms, ours and those of Open3D."""
    runs = max(min(options.scans, MOST_RUNS), 5)
    for name, noise in (('room', 0.0), ('room, Kinect noise', KINECT)):
        points, _ = room(noise_per_range_sq=noise)
        with one_core():
            for size_m in SIZES_M:
                yield case(name, points, size_m, noise, runs)
            for size_m in PEER_SIZES_M if options.peers else ():
                yield peer(name, points, size_m, options.cache)


def case(
    name: str, points: npt.NDArray[np.float32], voxel_size_m: float, noise: float, runs: int
) -> Row:
    """Return one row of ours."""
    config = ModelsConfig(voxel_size_m=voxel_size_m, noise_per_range_sq=noise)
    models, times, processor = [], [], []
    for _ in range(WARM + runs):
        start, busy = perf_counter(), thread_time()
        models.append(fit(points, config, VIEW))
        processor.append((thread_time() - busy) * 1e3)
        times.append((perf_counter() - start) * 1e3)
    figures = spread(times[WARM:])
    return {
        'cloud': name,
        'who': 'surfel_mapper',
        'voxel_m': voxel_size_m,
        **figures,
        'least_ms': min(times),
        'cpu_ms': min(processor),
        'fps': 1e3 / min(processor),
        **{f'{n}_ms': value for n, value in fastest_stages(models[WARM:]).items()},
        'thinned': models[-1].num_thinned,
        **accuracy(points, config),
    }


def fastest_stages(models: Sequence[MultiModel]) -> dict[str, float]:
    """Return the least time of every stage."""
    return {
        name: min(model.milliseconds[name] for model in models) for name in models[0].milliseconds
    }


def accuracy(points: npt.NDArray[np.float32], config: ModelsConfig) -> dict[str, Any]:
    """Return precision and completeness of the models, and of Gaussians alone."""
    found = evaluate(fit(points, config, VIEW), points)
    alone = ModelsConfig(
        voxel_size_m=config.voxel_size_m,
        noise_per_range_sq=config.noise_per_range_sq,
        kinds='gaussians',
    )
    theirs = evaluate(fit(points, alone, VIEW), points)
    return {
        'planes': found.num_planes,
        'surfaces': found.num_surfaces,
        'gaussians': found.num_gaussians,
        'bytes': found.size_bytes,
        'precision_mm': 1e3 * found.precision_rms_m,
        'gmm_precision_mm': 1e3 * theirs.precision_rms_m,
        'complete_mm': 1e3 * found.completeness_rms_m,
        'gmm_complete_mm': 1e3 * theirs.completeness_rms_m,
    }


def peer(name: str, points: npt.NDArray[np.float32], voxel_size_m: float, cache: Path) -> Row:
    """Return one row of Open3D."""
    row: dict[str, Any] = {'cloud': name, 'who': OPEN3D_PLANES.name, 'voxel_m': voxel_size_m}
    try:
        python = environment(OPEN3D_PLANES, cache)
        with tempfile.TemporaryDirectory() as scratch:
            file = Path(scratch) / 'points.npy'
            np.save(file, points)
            module = ('-m', OPEN3D_PLANES.module, str(file), str(voxel_size_m), str(PEER_RUNS))
            one_thread = {**os.environ, 'OMP_NUM_THREADS': '1'}
            said = output([str(python), *module], cwd=ROOT, env=one_thread)
    except PeerError as error:
        return {**row, 'who': f'{OPEN3D_PLANES.name}, not measured: {error}'}
    times, planes = json.loads(said.splitlines()[-1])
    return {**row, **spread(times), 'least_ms': min(times), 'planes': planes}
