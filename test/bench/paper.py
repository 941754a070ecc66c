# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The table of Gao and Dong 2025: models of frames of depth cameras, by profile and data set.

Means over the frames of a data set of: ``precision_mm`` and ``complete_mm``, root mean square
distances from samples of the models to the points of the frame and back; ``bytes`` of a file of
the models, the numbers of each kind, and ``cpu_ms``, the least of some runs on one core. Rows are
``paper`` (the rules of the paper), ``default``, ``gaussians`` (alone, by the rules of the default)
and, with --peers, the planar patches of Open3D: rectangles of 40 bytes. ``gain`` is the precision
of the Gaussians by that of the row.

Data sets: the folders sevenscenes and slambook2 of SURFEL_MAPPER_TEST_DATA, and those of --data:
folders of TUM RGB-D, 7-Scenes, Replica or ScanNet, and bags of clouds, such as cow_and_lady.
Voxels are those of the paper: 3 cm, and 4 cm, which it takes for fr1_teddy.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
import json
import os
from pathlib import Path
from time import thread_time

import numpy as np
import numpy.typing as npt

from surfel_mapper.bags.reader import BagReader
from surfel_mapper.bags.topics import CLOUD
from surfel_mapper.config import ModelsConfig
from surfel_mapper.messages.compressed_image import pixels_of
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.models import evaluate, fit, MultiModel
from surfel_mapper.models.evaluation import nearest, rms
from surfel_mapper.models.thinning import thin
from surfel_mapper.offline.depth_folders import find_depth_folder
from surfel_mapper.sensors.depth import depth_points, PinholeCamera
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.peers import OPEN3D, PeerSpec
from test.bench.peers.run import PeerError, run_peer
from test.bench.report import Row

Points = npt.NDArray[np.float32]

PATCHES = PeerSpec(name='Open3D', module='test.bench.peers.open3d_patches', requires=OPEN3D)

RECTANGLE_BYTES = 40
"""Centre, quaternion and three edges as float32."""

CAMERAS = {
    'sevenscenes': PinholeCamera(640, 480, 585.0, 585.0, 320.0, 240.0),
    'slambook2': PinholeCamera(640, 480, 518.0, 519.0, 325.5, 253.5),
}
"""Cameras of the test data, as its README states them."""

PROFILES = {'paper': {'profile': 'paper'}, 'default': {}, 'gaussians': {'kinds': 'gaussians'}}

VOXELS_M = (0.03, 0.04)
"""Voxels of the paper."""

NO_DEPTH = 65535


def run(options: Options) -> Iterator[Row]:
    """Yield the rows of each data set."""
    runs = 1 if options.scans < Options().scans else 3
    with one_core():
        for name, frames in data_sets(options):
            clouds = list(frames)
            for size_m in VOXELS_M:
                yield from rows_of(name, clouds, size_m, (options, runs))


def data_sets(options: Options) -> Iterator[tuple[str, Iterator[Points]]]:
    """Yield the name and the frames of each data set."""
    data = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    for name, camera in CAMERAS.items() if data else ():
        files = sorted((Path(data or '') / 'data' / 'rgbd' / name).glob('*depth*.png'))
        if files:
            yield name, (points_of(file, camera) for file in evenly(files, options.frames))
    for path in options.data:
        yield path.name, frames_of(path, options.frames)


def evenly(files: list[Path], number: int) -> list[Path]:
    """Return some files, evenly spaced."""
    return files[:: -(-len(files) // number)]


def points_of(file: Path, camera: PinholeCamera) -> Points:
    """Return the points of a depth image in mm."""
    _, pixels = pixels_of(file.read_bytes(), str(file), ('PNG',), None)
    depth = pixels.astype(np.float32) / np.float32(1000.0)
    depth[pixels == NO_DEPTH] = np.nan
    return finite(depth_points(depth, camera))


def frames_of(path: Path, number: int) -> Iterator[Points]:
    """Yield the points of frames of a folder of depth images, or of a bag of clouds."""
    folder = find_depth_folder(path)
    if folder is not None:
        step = -(-len(folder.files) // number)
        for k in range(0, len(folder.files), step):
            yield finite(folder.depth_scan(k, folder.stamps_ns[k], '').points)
        return
    with BagReader(path) as reader:
        topic = next(topic for topic in reader.topics if topic.type == CLOUD and topic.count)
        messages = reader.messages([topic.name])
        for message in islice(messages, 0, None, -(-topic.count // number)):
            yield finite(to_scan(reader.decode(message), topic.name).points)


def finite(points: npt.NDArray[np.floating]) -> Points:
    """Return the finite points (N, 3)."""
    points = points.reshape(-1, 3)
    return np.asarray(points[np.isfinite(points).all(axis=1)], np.float32)


def rows_of(
    name: str, frames: list[Points], size_m: float, how: tuple[Options, int]
) -> Iterator[Row]:
    """Yield the rows of a data set."""
    options, runs = how
    config = ModelsConfig(voxel_size_m=size_m)
    means = {
        profile: mean([ours(points, replace(config, **changes), runs) for points in frames])
        for profile, changes in PROFILES.items()
    }
    note: Row = {}
    if options.peers:
        try:
            means['Open3D'] = mean([open3d(points, size_m, options) for points in frames])
        except PeerError as error:
            note = {'data': name, 'models': 'Open3D', 'note': f'not measured: {error}'}
    for profile, row in means.items():
        gain = means['gaussians']['precision_mm'] / row['precision_mm']
        share = row['bytes'] / means['gaussians']['bytes']
        facts = {'data': name, 'frames': len(frames), 'voxel_m': size_m, 'models': profile}
        yield {**facts, **row, 'gain': gain, 'x_bytes': share}
    if note:
        yield note


def mean(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the means of rows."""
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def ours(points: Points, config: ModelsConfig, runs: int) -> dict[str, float]:
    """Return the figures of our models of a frame; they are those of a file."""
    fit(points, config)  # compiles, and fills caches
    times = []
    for _ in range(runs):
        start = thread_time()
        model = fit(points, config)
        times.append((thread_time() - start) * 1e3)
    figures = evaluate(MultiModel.from_bytes(model.to_bytes()), points)
    return {
        'precision_mm': 1e3 * figures.precision_rms_m,
        'complete_mm': 1e3 * figures.completeness_rms_m,
        'bytes': figures.size_bytes,
        'planes': figures.num_planes,
        'surfaces': figures.num_surfaces,
        'gaussians': figures.num_gaussians,
        'cpu_ms': min(times),
    }


def open3d(points: Points, size_m: float, options: Options) -> dict[str, float]:
    """
    Return the figures of the planar patches of Open3D of the thinned points.

    Raises
    ------
    PeerError
        If it cannot be had.

    """
    thinned = thin(points, size_m).means.astype(np.float64)
    said = json.loads(run_peer(PATCHES, thinned, [], options.cache))
    samples = [rectangle(box, size_m) for box in said['patches']]
    cloud = np.concatenate([*samples, np.empty((0, 3))])
    raw = points.astype(np.float64)
    return {
        'precision_mm': 1e3 * rms(nearest(cloud, raw)),
        'complete_mm': 1e3 * rms(nearest(raw, cloud)),
        'bytes': float(RECTANGLE_BYTES * len(samples)),
        'planes': float(len(samples)),
        'surfaces': 0.0,
        'gaussians': 0.0,
        'cpu_ms': said['cpu_ms'],
    }


def rectangle(box: list[list[float]], size_m: float) -> npt.NDArray[np.float64]:
    """Return points on the middle plane of a box, given its centre, its axes and its edges."""
    centre, x, y, _, edges = np.array(box)
    numbers = np.maximum(np.round(edges / size_m), 1)
    u, v = np.meshgrid(
        *((np.arange(numbers[k]) + 0.5) / numbers[k] * edges[k] - 0.5 * edges[k] for k in (0, 1)),
        indexing='ij',
    )
    return np.asarray(centre + u.reshape(-1, 1) * x + v.reshape(-1, 1) * y, np.float64)
