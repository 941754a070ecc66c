# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Adaptive surfels of real scans: their number, normals and edges; and what following a map costs.

Normals are compared at some points of the scans with planes fitted robustly to all points within
``REACH`` base voxels. ``median_deg`` is the median angle, ``plane_deg`` that of the points
of which one plane has 80 % of the neighbours. ``off_%`` is the share of the surfels that
``is_flat`` selects (``good_%``) that are more than 10 deg from both of two planes fitted to the
points in their own cell.
``edge_mm`` is the distance of points near a second plane from their surfel that 90 % are within.
Each of these is of adaptive surfels, and with ``base_`` and ``coarse_`` of voxels of the base and
of four times its size. Surfels have 5 points or more. ``add_ms`` is the time to add a scan,
``map_mb`` the size of the map, ``cut_ms`` the time of a whole cut.

The rows of the job are the window job of ``real``, 20 scans of the simulated street, followed by
an adaptive cut every ``every`` scans: ``job_ms`` without it, ``x_time`` and ``x_memory`` with it.
As in the node, the surfels of changed voxels are not derived then.

The scans come from SURFEL_MAPPER_TEST_DATA; without it there is only the job.
"""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from surfel_mapper import Config, replay, SurfelMap, Surfels
from surfel_mapper.files.scan_files import read_scan
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.offline.replay import ReplayOptions
from test.bench.machine import one_core, prefault
from test.bench.options import Options
from test.bench.ours import Ours
from test.bench.paper import CAMERAS, points_of
from test.bench.report import Row
from test.bench.street import Street

Points = npt.NDArray[np.float64]
Scans = list[tuple[Points, Points]]
"""Points in the map, (N, 3) m, and the position of the sensor, of each scan."""

MIN_POINTS, REACH, SHARE, OFF_DEG = 5, 2.8, 0.8, 10.0

TRIALS, MOST, PLANE_M = 50, 500, 0.05
"""Random planes of a fit, points of a fit, and their distance from its plane."""

WINDOW = 20


def run(options: Options) -> Iterator[Row]:
    """Yield the rows of the data sets and of the job."""
    number = 1000 if options.scans >= Options().scans else 100
    with one_core():
        for name, base_m, scans in data_sets():
            yield {'data': name, 'base_m': base_m, **quality_row(scans, base_m, number)}
        for every in (1, 10):
            yield {'data': 'job', 'base_m': 0.2, 'every': every, **job_row(options, every)}


def data_sets() -> Iterator[tuple[str, float, Scans]]:
    """Yield name, size of the base voxels and scans of each data set."""
    root = Path(os.environ.get('SURFEL_MAPPER_TEST_DATA') or '/nonexistent') / 'data'
    recordings = {'hall': 'bags/hall_os0_full', 'KITTI city': 'folders/kitti_city'}
    for name, path in recordings.items():
        if (root / path).exists():
            scans = recorded(root / path)
            for base_m in (0.5, 0.2, 0.125):
                yield name, base_m, scans
    files = {
        'nuScenes': 'scans/nuscenes_hdl32_1532402927647951.pcd.bin',
        'RELLIS': 'scans/rellis3d_os1_64_offroad_000104.bin',
    }
    for name, path in files.items():
        if (root / path).exists():
            points = np.asarray(read_scan(root / path)[0], np.float64)
            valid = np.isfinite(points).all(axis=1) & points.any(axis=1)
            yield name, 0.125, [(points[valid], np.zeros(3))]
    if (root / 'rgbd' / 'sevenscenes_poses.npz').exists():
        yield '7-Scenes', 0.05, depth_frames(root / 'rgbd')


def recorded(path: Path) -> Scans:
    """Return the scans of a recording at the poses of a replay."""
    config = Config.from_mapping({'window.keep_points': True, 'window.max_scans': 0})
    with TemporaryDirectory() as directory:
        options = ReplayOptions(formats=(), window=True)
        result = replay(path, output=Path(directory) / 'out', config=config, options=options)
    scans = []
    for scan in result.mapper.window:
        pose = scan.T_map_sensor
        scans.append((scan.points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3], pose[:3, 3]))
    return scans


def depth_frames(folder: Path) -> Scans:
    """Return every fifth depth image of 7-Scenes, one pixel of four, up to 3.5 m."""
    poses = np.load(folder / 'sevenscenes_poses.npz')['T_world_cam']
    files = sorted((folder / 'sevenscenes').glob('*depth*.png'))
    scans = []
    for file, pose in list(zip(files, poses, strict=True))[::5]:
        points = points_of(file, CAMERAS['sevenscenes'])[::4].astype(np.float64)
        points = points[(points[:, 2] > 0.0) & (points[:, 2] < 3.5)]
        scans.append((points @ pose[:3, :3].T + pose[:3, 3], pose[:3, 3]))
    return scans


def map_of(scans: Scans, voxel_size_m: float) -> SurfelMap:
    """Return the map of scans."""
    surfel_map = SurfelMap(voxel_size_m)
    for points, origin in scans:
        surfel_map.add(points, origin)
    return surfel_map


def quality_row(scans: Scans, base_m: float, number: int) -> Row:
    """Return number of surfels, errors of normals and distances at edges."""
    points = np.concatenate([points for points, _ in scans])
    tree, rng = cKDTree(points), np.random.default_rng(1)
    at = points[rng.choice(len(points), number)]
    fits = [fit_at(points[near_points(tree, p, REACH * base_m, rng)], p, rng) for p in at]
    map_of(scans[:1], base_m).adaptive(MIN_POINTS)
    start = process_time()
    base = map_of(scans, base_m)
    add_ms = (process_time() - start) * 1e3 / len(scans)
    coarse = map_of(scans, 4.0 * base_m)
    start = process_time()
    adaptive = base.adaptive(MIN_POINTS)
    cut_ms = (process_time() - start) * 1e3
    row = {'add_ms': add_ms, 'map_mb': base.nbytes / 1e6}
    row |= {'surfels': len(adaptive), 'base_surfels': base.num_surfels(MIN_POINTS)}
    row['x_surfels'] = row['surfels'] / row['base_surfels']
    voxels = {'base_': base.surfels(MIN_POINTS), 'coarse_': coarse.surfels(MIN_POINTS)}
    for prefix, surfels in {'': adaptive, **voxels}.items():
        errors = errors_at(surfels, at, fits)
        off = share_off(surfels, points, tree, number, rng)
        row |= {f'{prefix}{name}': value for name, value in (errors | off).items()}
    return {**row, 'cut_ms': cut_ms}


def near_points(
    tree: cKDTree, centre: Points, reach_m: float, rng: np.random.Generator
) -> npt.NDArray[np.int64]:
    """Return rows of points around a centre, at most MOST."""
    rows = np.array(tree.query_ball_point(centre, reach_m), np.int64)
    return rng.choice(rows, MOST, replace=False) if len(rows) > MOST else rows


def best_plane(
    points: Points, through: Points | None, rng: np.random.Generator
) -> tuple[Points, npt.NDArray[np.bool_]] | None:
    """Return normal and members of the plane with most points, near a point; None for few."""
    if len(points) < 12:
        return None
    a, b, c = points[rng.integers(0, len(points), (3, TRIALS))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    usable = length > 1e-9
    if through is not None:
        distance = np.abs(np.einsum('ij,ij->i', normal, through - a))
        usable &= distance < PLANE_M * length
    if not usable.any():
        return None
    normal, a = normal[usable] / length[usable, None], a[usable]
    near = np.abs(points @ normal.T - np.einsum('ij,ij->i', normal, a)) < PLANE_M
    member = near[:, near.sum(axis=0).argmax()]
    values = np.zeros(3)
    for _ in range(3):
        if member.sum() < 10:
            return None
        mean = points[member].mean(axis=0)
        values, vectors = np.linalg.eigh(np.cov((points[member] - mean).T))
        member = np.abs((points - mean) @ vectors[:, 0]) < PLANE_M
    is_line = values[1] < 0.01 * np.ptp(points, axis=0).max() ** 2
    return None if is_line else (vectors[:, 0], member)


def fit_at(points: Points, at: Points, rng: np.random.Generator) -> tuple[Points, float] | None:
    """Return the normal of the plane through a point, and its share of the points."""
    plane = best_plane(points, at, rng) if len(points) >= 30 else None
    return None if plane is None else (plane[0], float(plane[1].mean()))


def errors_at(
    surfels: Surfels, at: Points, fits: list[tuple[Points, float] | None]
) -> dict[str, float]:
    """Return angles between surfels and fits, and distances of points from their surfels."""
    row, known = rows_at(surfels, at), np.array([fit is not None for fit in fits])
    known &= (row >= 0) & np.isfinite(surfels.planarity[row])
    normal = np.array([fit[0] if fit else [0.0, 0.0, 1.0] for fit in fits])
    share = np.array([fit[1] if fit else 0.0 for fit in fits])
    angle = angle_deg(surfels.normal[row], normal)
    distance = np.abs(np.einsum('ij,ij->i', surfels.normal[row], at - surfels.position[row]))
    is_edge = known & (share <= SHARE)
    return {
        'median_deg': float(np.median(angle[known])),
        'plane_deg': float(np.median(angle[known & (share > SHARE)])),
        'edge_mm': float(1e3 * np.quantile(distance[is_edge], 0.9)) if is_edge.any() else np.nan,
    }


def rows_at(surfels: Surfels, at: Points) -> npt.NDArray[np.int64]:
    """Return the row of the surfel that holds each point, -1 without one."""
    row = np.full(len(at), -1)
    for size in np.unique(surfels.size):
        rows = np.flatnonzero(surfels.size == size)
        keys = pack_keys(surfels.voxel_index[rows])
        order = np.argsort(keys)
        wanted = pack_keys(np.floor(at / size).astype(np.int64))
        place = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
        match = keys[order][place] == wanted
        row[match] = rows[order[place[match]]]
    return row


def angle_deg(first: Points, second: Points) -> Points:
    """Return the angles between lines (K, 3), in [0, 90]."""
    cosine = np.abs(np.einsum('ij,ij->i', first, second))
    return np.asarray(np.degrees(np.arccos(np.minimum(cosine, 1.0))))


def share_off(
    surfels: Surfels, points: Points, tree: cKDTree, number: int, rng: np.random.Generator
) -> dict[str, float]:
    """Return how many good surfels are off both planes of their points, per cent."""
    good = surfels.is_flat
    rows = np.flatnonzero(good & (surfels.num_points >= 30))
    errors = []
    for row in rng.permutation(rows)[:number]:
        size, low = surfels.size[row], surfels.voxel_index[row] * surfels.size[row]
        near = points[near_points(tree, low + 0.5 * size, 0.8661 * size, rng)]
        near = near[((near >= low) & (near < low + size)).all(axis=1)]
        angles = []
        while len(angles) < 2 and (plane := best_plane(near, None, rng)) is not None:
            angles.append(float(angle_deg(surfels.normal[[row]], plane[0][None])[0]))
            near = near[~plane[1]]
        if angles:
            errors.append(min(angles))
    off = np.array(errors) > OFF_DEG
    off_share = float(off.mean()) if errors else np.nan
    return {'off_%': 100.0 * off_share, 'good_%': 100.0 * float(good.mean())}


def job_row(options: Options, every: int) -> Row:
    """Return the times of the window job without and with a cut, and the ratio of memory."""
    prefault()
    street, ours = Street(options), Ours(0.2, WINDOW)
    cut, laps = ours.map.adaptive_cut(), []
    for number in range(2 * WINDOW + min(options.scans, 40)):
        points, pose = street.points(number), street.pose(number)
        points = np.asfortranarray(points[np.isfinite(points).all(axis=1)])
        start = process_time()
        moments = ours.map.reduce(points, pose, origin=pose[:3, 3])
        _, evicted, derived = ours.put(moments, process_time)
        middle = process_time()
        if number % every == 0:
            cut.refresh()
        laps.append((middle - start, derived - evicted, process_time() - middle))
    job_s, derived_s, cut_s = np.array(laps[2 * WINDOW :]).T
    scans = sum(moments.nbytes + 4 * len(moments) for moments in ours.scans)
    num_bytes = ours.map.nbytes + scans
    return {
        'job_ms': 1e3 * float(np.median(job_s)),
        'cut_ms': 1e3 * float(cut_s.mean()),
        'x_time': 1.0 + float((cut_s.mean() - np.median(derived_s)) / np.median(job_s)),
        'x_memory': 1.0 + cut.nbytes / num_bytes,
    }
