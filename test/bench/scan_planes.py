# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes of real single scans of lidars, beside Open3D's planar patches, by voxel size.

For each scan: ``covered``, the share of its points in patches; ``residual_mm``, the root mean
square distance of these points from the planes through the points of their patch; ``patches``; CPU
time.
Open3D's patches contain the points in their boxes, widened by a voxel; ``boxed`` and
``boxed_residual_mm`` are these figures for ours by the same rule: points in the boxes around our
patches, widened likewise, the smallest box that contains a point.
The scans are those of the folder scans in SURFEL_MAPPER_TEST_DATA; without it there are no rows.
"""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
from time import thread_time

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import ModelsConfig
from surfel_mapper.files.scan_files import read_scan
from surfel_mapper.models import fit, MultiModel
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.peers.run import PeerError
from test.bench.report import Row
from test.bench.tabletop import open3d_labels, OPEN3D_TABLETOP

SIZES_M = (0.2, 0.3, 0.5)
SUFFIXES = ('.pcd', '.ply', '.bin')
METHOD = 'planar patches'


def run(options: Options) -> Iterator[Row]:
    """Yield rows for every scan and voxel size, ours and those of Open3D."""
    for name, points in real_scans():
        for size_m in SIZES_M:
            row: Row = {'cloud': name, 'voxel_m': size_m, 'points': len(points)}
            with one_core():
                yield {**row, 'who': 'surfel_mapper', **ours(points, size_m)}
            if options.peers:
                yield {**row, **peer(points, size_m, options.cache)}


def real_scans() -> Iterator[tuple[str, npt.NDArray[np.float32]]]:
    """Yield name and points (N, 3), m, of every scan; those at the sensor are no returns."""
    data = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    for file in sorted((Path(data) / 'data' / 'scans').iterdir()) if data else []:
        if file.suffix in SUFFIXES:
            points = np.asarray(read_scan(file)[0], np.float32).reshape(-1, 3)
            held = np.isfinite(points).all(axis=1) & points.any(axis=1)
            yield file.stem, points[held]


def ours(points: npt.NDArray[np.float32], size_m: float) -> dict[str, float]:
    """Return the figures of one scan."""
    config = ModelsConfig(voxel_size_m=size_m)
    fit(points, config)  # compiles
    start = thread_time()
    model = fit(points, config)
    duration = (thread_time() - start) * 1e3
    patch = np.where(model.labels < len(model.patches), model.labels, -1)
    boxed = figures(points, in_boxes(points, model, size_m))
    return {
        **figures(points, patch),
        'boxed': boxed['covered'],
        'boxed_residual_mm': boxed['residual_mm'],
        'cpu_ms': duration,
    }


def in_boxes(
    points: npt.NDArray[np.floating], model: MultiModel, size_m: float
) -> npt.NDArray[np.int64]:
    """Return the patch with the smallest box around each point (N,), -1 for none."""
    wider = 0.5 * size_m * np.array([1.0, 1.0, 0.0])
    cloud, found = points.astype(np.float64), np.full(len(points), -1)
    by_label = np.argsort(model.labels, kind='stable')
    along_x = np.argsort(cloud[:, 0], kind='stable')
    x, boxes = cloud[along_x, 0], []
    for patch in model.patches:
        ends = np.searchsorted(model.labels[by_label], [patch.id, patch.id + 1])
        own = patch.to_local(cloud[by_label[slice(*ends)]])
        boxes.append((own.min(axis=0) - wider, own.max(axis=0) + wider))
    for k in np.argsort([-(high - low)[:2].prod() for low, high in boxes]):
        (low, high), patch = boxes[k], model.patches[k]
        middle = 0.5 * (low + high) @ patch.R_patch_map[:, 0] + patch.mean[0]
        half = 0.5 * (high - low) @ np.abs(patch.R_patch_map[:, 0]) + 1e-6  # m, for rounding
        near = along_x[slice(*np.searchsorted(x, [middle - half, middle + half]))]
        local = patch.to_local(cloud[near])
        found[near[((local >= low) & (local <= high)).all(axis=1)]] = k
    return found


def figures(points: npt.NDArray[np.floating], patch: npt.NDArray[np.integer]) -> dict[str, float]:
    """Return coverage and residual of points (N, 3) with the index of their patch, -1 for none."""
    squares, held = 0.0, patch >= 0
    for k in np.unique(patch[held]):
        own = points[patch == k].astype(np.float64)
        if len(own) > 3:
            squares += float(np.linalg.eigvalsh(np.cov(own.T, bias=True))[0]) * len(own)
    return {
        'covered': float(held.mean()),
        'residual_mm': 1e3 * float(np.sqrt(squares / max(held.sum(), 1))),
        'patches': float(len(np.unique(patch[held]))),
    }


def peer(points: npt.NDArray[np.float32], size_m: float, cache: Path) -> Row:
    """Return the figures of Open3D for one scan."""
    try:
        patch, duration = open3d_labels(points, METHOD, size_m, cache)
    except PeerError as error:
        return {'who': f'{OPEN3D_TABLETOP.name} {METHOD}, not measured: {error}'}
    name = f'{OPEN3D_TABLETOP.name} {METHOD}'
    return {'who': name, **figures(points, patch), 'cpu_ms': duration}
