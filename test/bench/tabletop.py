# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes of labelled Kinect frames of objects on a table (OSD), by voxel size.

Means over the frames of: ``table``, the share of the flat table points in one plane; ``free``, the
share of object points in no patch; ``impure``, the share of points in patches whose label is not
that of most points of their patch; ``pieces``, the patches that are mostly table; ``patches``;
``residual_mm``, the root mean square distance of the points from their planes; ``boundary_mm``,
the mean distance between the boundaries of objects and of their patches in the image; CPU time.
The flat table points are those within 1 cm of the plane that most table points lie on.

Four frames with their patches at 2 cm, beside those of Open3D with ``--peers``, are written to
tabletop.png in the cache.

The frames are those of the folder osd in SURFEL_MAPPER_TEST_DATA; without it there are no rows.
Open3D's planar patches and its RANSAC planes (up to twelve, one after the other) are labelled by
the points within a voxel of their boxes, and within 1 cm of their planes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import contextlib
import json
import os
from pathlib import Path
import tempfile
from time import thread_time

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from surfel_mapper.config import ModelsConfig
from surfel_mapper.files.pcd import read_points
from surfel_mapper.models import fit
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.peers import OPEN3D, PeerSpec
from test.bench.peers.run import environment, output, PeerError, ROOT
from test.bench.report import Row

OPEN3D_TABLETOP = PeerSpec(
    name='Open3D',
    module='test.bench.peers.open3d_tabletop',
    requires=OPEN3D,
    less='planes only; labels are ours, from the boxes of its patches',
)

SIZES_M = (0.01, 0.02, 0.03)
TABLE = 1
"""Label of the table; objects have higher ones, 0 is unlabelled."""

NEAR_M = 0.01
SHAPE = 480, 640
PICTURE_SIZE_M, PICTURE_FRAMES = 0.02, 4
RUNS = 4


def run(options: Options) -> Iterator[Row]:
    """Yield a row for every voxel size, ours and those of Open3D."""
    data = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    files = sorted((Path(data) / 'data' / 'osd').glob('*.pcd')) if data else []
    if not files:
        return
    frames = [frame(file) for file in files]
    with one_core():
        for size_m in SIZES_M:
            found = [ours(points, labels, size_m) for points, labels in frames]
            yield mean_row('surfel_mapper', size_m, found)
        if options.peers:
            yield from peer_rows(frames, options.cache)
        picture(frames[:PICTURE_FRAMES], options)


def picture(
    frames: Sequence[tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]], options: Options
) -> None:
    """Write the patches of frames to tabletop.png in the cache."""
    rows: list[tuple[npt.NDArray[np.integer], ...]] = []
    for points, _ in frames:
        model = fit(points, ModelsConfig(voxel_size_m=PICTURE_SIZE_M))
        own = np.where(model.labels < len(model.patches), model.labels, -1)
        others: tuple[npt.NDArray[np.integer], ...] = ()
        if options.peers:
            with contextlib.suppress(PeerError):  # told in the rows
                method = 'planar patches'
                others = (open3d_labels(points, method, PICTURE_SIZE_M, options.cache)[0],)
        rows.append((own, *others))
    options.cache.mkdir(parents=True, exist_ok=True)
    write_picture(options.cache / 'tabletop.png', rows)


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
    found = {**figures(points, labels, patch, planes), 'cpu_ms': min(times)}
    return {**found, 'boundary_mm': boundary_error_mm(points, labels, patch)}


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


def boundary_error_mm(
    points: npt.NDArray[np.float32],
    labels: npt.NDArray[np.int64],
    patch: npt.NDArray[np.integer],
) -> float:
    """
    Return the mean distance between boundaries of objects and of their patches, both ways.

    An object's patches are those with most points on it; one without patches is left out.

    Parameters
    ----------
    points, labels, patch : (N, 3), (N,), (N,)
        An organised frame, of SHAPE; patch is -1 for none.

    """
    votes = np.zeros((int(patch.max(initial=-1)) + 1, int(labels.max()) + 1), np.int64)
    known = (patch >= 0) & (labels > 0)
    np.add.at(votes, (patch[known], labels[known]), 1)
    object_of = np.append(votes.argmax(axis=1), 0)[patch]
    total, number = 0.0, 0
    for label in np.unique(labels[labels > TABLE]):
        trees = []
        for mask in (labels == label, (object_of == label) & (patch >= 0)):
            image = mask.reshape(SHAPE)
            rim = (image & ~binary_erosion(image)).reshape(-1)
            trees.append(points[rim & np.isfinite(points).all(axis=1)])
        if min(map(len, trees)) > 0:
            for one, other in (trees, trees[::-1]):
                distance = cKDTree(other).query(one)[0]
                total, number = total + float(distance.sum()), number + len(distance)
    return 1e3 * total / max(number, 1)


def write_picture(file: Path, frames: Sequence[tuple[npt.NDArray[np.integer], ...]]) -> None:
    """Write patches of frames (labels of one or two methods, (N,) each), a colour each, as PNG."""
    rng = np.random.default_rng(1)
    colours = np.concatenate([rng.integers(60, 256, (4096, 3)), [[0, 0, 0]]]).astype(np.uint8)
    colours[0] = 200
    rows = [
        np.concatenate([colours[by_size(patch)].reshape(*SHAPE, 3) for patch in methods], axis=1)
        for methods in frames
    ]
    Image.fromarray(np.concatenate(rows)[::2, ::2]).save(file)


def by_size(patch: npt.NDArray[np.integer]) -> npt.NDArray[np.integer]:
    """Renumber patches by their points, so that a table has the same colour in all pictures."""
    counts = np.bincount(patch[patch >= 0], minlength=1)
    rank = np.empty(len(counts) + 1, np.int64)
    rank[np.argsort(-counts, kind='stable')] = np.arange(len(counts))
    rank[-1] = -1
    return rank[patch]


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


def mean_row(name: str, size_m: float, found: Sequence[dict[str, float]]) -> Row:
    """Return the means over frames as a row."""
    means = {key: float(np.mean([one[key] for one in found])) for key in found[0]}
    return {'cloud': 'tabletop', 'who': name, 'voxel_m': size_m, **means}


def peer_rows(
    frames: Sequence[tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]], cache: Path
) -> Iterator[Row]:
    """Yield rows of Open3D's planar patches at every voxel size, and of its RANSAC planes."""
    for name, sizes in (('planar patches', SIZES_M), ('RANSAC', (0.01,))):
        for size_m in sizes:
            who = f'{OPEN3D_TABLETOP.name} {name}'
            try:
                found = [peer(points, labels, name, size_m, cache) for points, labels in frames]
            except PeerError as error:
                yield {'cloud': 'tabletop', 'who': f'{who}, not measured: {error}'}
                return
            yield mean_row(who, size_m, found)


def peer(
    points: npt.NDArray[np.float32],
    labels: npt.NDArray[np.int64],
    method: str,
    size_m: float,
    cache: Path,
) -> dict[str, float]:
    """Return the figures of one frame."""
    patch, duration = open3d_labels(points, method, size_m, cache)
    planes = np.ones(int(patch.max(initial=-1)) + 1, np.bool_)
    found = {**figures(points, labels, patch, planes), 'cpu_ms': duration}
    return {**found, 'boundary_mm': boundary_error_mm(points, labels, patch)}


def open3d_labels(
    points: npt.NDArray[np.float32], method: str, size_m: float, cache: Path
) -> tuple[npt.NDArray[np.int32], float]:
    """Return the index of Open3D's patch of each point, -1 for none, and its milliseconds."""
    python = environment(OPEN3D_TABLETOP, cache)
    with tempfile.TemporaryDirectory() as scratch:
        source, result = Path(scratch) / 'points.npy', Path(scratch) / 'patch.npy'
        np.save(source, points)
        arguments = ('-m', OPEN3D_TABLETOP.module, str(source), str(result), method, str(size_m))
        one_thread = {**os.environ, 'OMP_NUM_THREADS': '1'}
        said = output([str(python), *arguments], cwd=ROOT, env=one_thread)
        return np.load(result), float(json.loads(said.splitlines()[-1]))
