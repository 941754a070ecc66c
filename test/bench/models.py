# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes, surfaces and Gaussians of a depth camera's clouds of 640 x 480, by voxel size.

A room of analytic surfaces without noise, and the same with that of a Kinect; on one core, from
the organised points to the models, thinning included. Precision and completeness are against the
points themselves, also of Gaussians alone (gmm_). Frames per second follow from the least
processor time (cpu_ms), as the machine may be shared.
"""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter, thread_time
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models import evaluate, fit
from test.bench import tabletop
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.report import Row, spread
from test.models.scenes import room, VIEW

KINECT = 1.425e-3
"""Its sigma by range^2, 1/m."""

SIZES_M = (0.01, 0.02, 0.03, 0.04)
WARM = 2
MOST_RUNS = 15


def run(options: Options) -> Iterator[Row]:
    """Yield rows of labelled frames of a table, and of rooms."""
    yield from tabletop.run(options)
    yield from rooms(options)


def rooms(options: Options) -> Iterator[Row]:
    """Yield rows of rooms."""
    runs = max(min(options.scans, MOST_RUNS), 5)
    for name, noise in (('room', 0.0), ('room, Kinect noise', KINECT)):
        points, _ = room(noise_per_range_sq=noise)
        with one_core():
            for size_m in SIZES_M:
                yield case(name, points, size_m, noise, runs)


def case(
    name: str, points: npt.NDArray[np.float32], voxel_size_m: float, noise: float, runs: int
) -> Row:
    """Return one row of ours."""
    config = ModelsConfig(voxel_size_m=voxel_size_m, noise_per_range_sq=noise)
    times, processor = [], []
    for _ in range(WARM + runs):
        start, busy = perf_counter(), thread_time()
        model = fit(points, config, VIEW)
        processor.append((thread_time() - busy) * 1e3)
        times.append((perf_counter() - start) * 1e3)
    figures = spread(times[WARM:])
    return {
        'cloud': name,
        'voxel_m': voxel_size_m,
        **figures,
        'least_ms': min(times),
        'cpu_ms': min(processor),
        'fps': 1e3 / min(processor),
        'thinned': model.num_thinned,
        **accuracy(points, config),
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
