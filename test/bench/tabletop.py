# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes of labelled Kinect frames of objects on a table (OSD), by voxel size.

Means over the frames of: ``table``, the share of the flat table points in one plane; ``free``, the
share of object points in no patch; ``impure``, the share of points in patches whose label is not
that of most points of their patch; ``pieces``, the patches that are mostly table; ``patches``;
``residual_mm``, the root mean square distance of the points from their planes; CPU time. The flat
table points are those within 1 cm of the plane that most table points lie on.

The frames are those of the folder osd in SURFEL_MAPPER_TEST_DATA; without it there are no rows.
"""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
from time import thread_time

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import ModelsConfig
from surfel_mapper.files.pcd import read_points
from surfel_mapper.models import fit
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.report import Row

SIZES_M = (0.01, 0.02, 0.03)
TABLE = 1
"""Label of the table; objects have higher ones, 0 is unlabelled."""

NEAR_M = 0.01
RUNS = 4


def run(options: Options) -> Iterator[Row]:
    """Yield a row for every voxel size."""
    data = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    files = sorted((Path(data) / 'data' / 'osd').glob('*.pcd')) if data else []
    if not files:
        return
    frames = [frame(file) for file in files]
    with one_core():
        for size_m in SIZES_M:
            found = [ours(points, labels, size_m) for points, labels in frames]
            means = {key: float(np.mean([one[key] for one in found])) for key in found[0]}
            yield {'cloud': 'tabletop', 'voxel_m': size_m, **means}


def frame(file: Path) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """Return points (N, 3), m, and labels (N,) of a frame."""
    table = read_points(file)
    points = np.stack([table['x'], table['y'], table['z']], axis=-1).reshape(-1, 3)
    return points.astype(np.float32), np.asarray(table['label']).reshape(-1).astype(np.int64)


def ours(
    points: npt.NDArray[np.float32], labels: npt.NDArray[np.int64], size_m: float
) -> dict[str, float]:
    """Return the figures of one frame."""
    times = []
    for _ in range(RUNS):
        start = thread_time()
        model = fit(points, ModelsConfig(voxel_size_m=size_m))
        times.append((thread_time() - start) * 1e3)
    number = len(model.patches)
    patch = np.where(model.labels < number, model.labels, -1)
    planes = np.arange(number) < len(model.planes)
    return {**figures(points, labels, patch, planes), 'cpu_ms': min(times)}


def figures(
    points: npt.NDArray[np.float32],
    labels: npt.NDArray[np.int64],
    patch: npt.NDArray[np.integer],
    planes: npt.NDArray[np.bool_],
) -> dict[str, float]:
    """
    Compare patches with labels.

    Parameters
    ----------
    points, labels : (N, 3), (N,)
        The frame.
    patch : (N,) int
        Index of the patch of each point, -1 for none.
    planes : (K,) bool
        Which patches are planes.

    """
    held = np.isfinite(points).all(axis=1) & (labels > 0)
    points, labels, patch = points[held].astype(np.float64), labels[held], patch[held]
    normal, offset = table_plane(points[labels == TABLE])
    flat = (labels == TABLE) & (np.abs(points @ normal + offset) < NEAR_M)
    on_plane = np.append(planes, False)[patch]
    in_planes = np.bincount(patch[flat & on_plane], minlength=1)
    votes = np.zeros((len(planes), int(labels.max()) + 1), np.int64)
    np.add.at(votes, (patch[patch >= 0], labels[patch >= 0]), 1)
    used = votes[votes.sum(axis=1) > 0]
    squares, total = 0.0, 0
    for k in np.flatnonzero(planes):
        own = points[patch == k]
        if len(own) > 3:
            squares += float(np.linalg.eigvalsh(np.cov(own.T))[0]) * len(own)
            total += len(own)
    return {
        'table': float(in_planes.max() / flat.sum()),
        'free': float((patch[labels > TABLE] < 0).mean()),
        'impure': 1.0 - float(used.max(axis=1).sum() / max(used.sum(), 1)),
        'pieces': float((used.argmax(axis=1) == TABLE).sum()),
        'patches': float(len(used)),
        'residual_mm': 1e3 * float(np.sqrt(squares / max(total, 1))),
    }


def table_plane(points: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], float]:
    """Return the plane, of 300 through three points each, that most points lie on."""
    rng, sample = np.random.default_rng(0), points[::20]
    a, b, c = points[rng.integers(len(points), size=(300, 3))].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths >= 1e-6] / lengths[lengths >= 1e-6, None]
    offsets = -(normals * a[lengths >= 1e-6]).sum(axis=1)
    near = (np.abs(sample @ normals.T + offsets) < NEAR_M).sum(axis=0)
    best = int(near.argmax())
    return normals[best], float(offsets[best])
