# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Rules that select good surfels, against fits of two planes to the dense points of each voxel.

The reference takes all points of the scans in a voxel, at least 30: a plane by RANSAC, a second
one through the points beside it, and hard EM for both. A voxel is mixed if the second plane has a
tenth of the points and another direction or place. It is left out if the normals of two halves of
the points of its main plane differ by more than 5 deg: then the points do not determine it. No
code of the package takes part.

``off`` are the selected surfels that are off by more than 10 deg from the main plane, ``kept`` the
voxels on one plane that are selected, ``undetermined`` the selected surfels that were left out,
all in per cent. Rows of one scan compare the surfels of single scans with the plane of all scans.
Rows of ``sigma`` are tenths of the voxels on one plane by normal_sigma: predicted, and measured
(63 % are below), deg.

The hall has recorded poses, the city those of registration; both come from
SURFEL_MAPPER_TEST_DATA, without which there are no rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
import os
from pathlib import Path
import tempfile
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from surfel_mapper import SurfelMap, Surfels
from surfel_mapper.files.scan_files import read_scan
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.mapping.surfels import concatenated
from test.bench.options import Options
from test.bench.registration import ours, recorded, Recording
from test.bench.report import Row

Array = npt.NDArray[np.float64]

PARTS = {'hall_os0_full': slice(0, 20), 'hall_os0_long': slice(58, 118)}

LEAST, MOST, TAU_M = 30, 400, 0.03
"""Points of a reference, at least and at most, and the distance of inliers of a plane, m."""

RULES: dict[str, Callable[[Surfels], npt.NDArray[np.bool_]]] = {
    'planarity > 0.7': lambda s: s.planarity > 0.7,
    'planarity > 0.8, 20 points': lambda s: (s.planarity > 0.8) & (s.num_points >= 20),
    'curvature < 0.01': lambda s: s.curvature < 0.01,
    'thickness, sigma': lambda s: (s.thickness < 0.028) & (s.normal_sigma < 0.13),
    'is_good': lambda s: s.is_good,
}


class Reference(NamedTuple):
    """Voxels by key, ascending: normals, whether on one plane, whether determined."""

    key: npt.NDArray[np.int64]
    normal: Array
    is_one: npt.NDArray[np.bool_]
    is_sure: npt.NDArray[np.bool_]


def run(options: Options) -> Iterator[Row]:
    """Yield a row for each rule, part, voxel size and number of scans."""
    data = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    if not data:
        return
    with tempfile.TemporaryDirectory() as scratch:
        for recording, part in recordings(Path(data) / 'data', Path(scratch)):
            for size_m in options.voxel_sizes_m:
                yield from rows(recording, part, size_m)


def recordings(data: Path, scratch: Path) -> Iterator[tuple[Recording, slice]]:
    """Yield the recordings, and the scans of each that are mapped."""
    for name, part in PARTS.items():
        yield recorded(data / 'bags' / name, scratch), part
    files = sorted((data / 'folders/kitti_city').glob('*.pcd'))
    paths = [scratch / f'{file.stem}.npy' for file in files]
    for file, path in zip(files, paths, strict=True):
        np.save(path, np.asarray(read_scan(file)[0], np.float32))
    stamps_ns = [10**17 + 10**8 * number for number in range(len(files))]
    city = Recording('kitti_city', paths, stamps_ns, np.empty(0))
    yield replace(city, poses=ours(city, 0.5)[1]), slice(None)


def rows(recording: Recording, part: slice, size_m: float) -> Iterator[Row]:
    """Yield the rows of a part: of single scans, and of all."""
    poses = recording.poses[part]
    scans = [
        np.load(path)[:, :3].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        for path, pose in zip(recording.paths[part], poses, strict=True)
    ]
    reference = reference_of(np.concatenate(scans), size_m)
    whole, single = SurfelMap(size_m), []
    for number, (points, pose) in enumerate(zip(scans, poses, strict=True)):
        whole.add(points, pose[:3, 3])
        if number % 7 == 0:
            alone = SurfelMap(size_m)
            alone.add(points, pose[:3, 3])
            single.append(alone.surfels())
    for num_scans, surfels in ((1, concatenated(single)), (len(scans), whole.surfels())):
        key = pack_keys(surfels.voxel_index)
        at = np.minimum(np.searchsorted(reference.key, key), len(reference.key) - 1)
        is_known = (reference.key[at] == key) & np.isfinite(surfels.planarity)
        about = {'part': recording.name, 'voxel_m': size_m, 'scans': num_scans}
        yield from (about | row for row in judged(surfels[is_known], reference, at[is_known]))


def judged(surfels: Surfels, reference: Reference, at: npt.NDArray[np.int64]) -> Iterator[Row]:
    """Yield the figures of each rule, and the deciles of normal_sigma."""
    is_one, is_sure = reference.is_one[at], reference.is_sure[at]
    cosine = np.abs((surfels.normal * reference.normal[at]).sum(axis=1))
    angle = np.degrees(np.arccos(np.minimum(cosine, 1.0)))
    for name, rule in {'all': lambda s: np.ones(len(s), np.bool_), **RULES}.items():
        chosen = rule(surfels)
        sure = chosen & is_sure
        yield {
            'rule': name,
            'selected': int(chosen.sum()),
            'off': percent(angle[sure] > 10.0),
            'mixed': percent(~is_one[sure]),
            'kept': percent(chosen[is_one & is_sure]),
            'undetermined': percent(~is_sure[chosen]),
        }
    flat = is_one & is_sure & (surfels.thickness < 0.03) & np.isfinite(surfels.normal_sigma)
    sigma, angle = np.degrees(surfels.normal_sigma[flat]), angle[flat]
    tenths = np.array_split(np.argsort(sigma), 10)
    pairs = [(np.median(sigma[t]), np.quantile(angle[t], 0.632)) for t in tenths if len(t)]
    yield {'rule': 'sigma: ' + ' '.join(f'{p:.2g}/{m:.2g}' for p, m in pairs)}


def percent(flags: npt.NDArray[np.bool_]) -> float:
    """Return the share of flags that are set, per cent; nan of none."""
    return float(100.0 * flags.mean()) if len(flags) else float('nan')


def reference_of(points: Array, size_m: float) -> Reference:
    """Return the reference of the voxels of at least LEAST points."""
    keys = pack_keys(np.floor(points / size_m).astype(np.int64))
    order = np.argsort(keys, kind='stable')
    key, counts = np.unique(keys[order], return_counts=True)
    rng = np.random.default_rng(5)
    groups = np.split(points[order], np.cumsum(counts)[:-1])
    fits = [fitted(group - group[0], rng) for group in groups if len(group) >= LEAST]
    normal, is_one, is_sure = (np.array(column) for column in zip(*fits, strict=True))
    return Reference(key[counts >= LEAST], normal, is_one, is_sure)


def fitted(points: Array, rng: np.random.Generator) -> tuple[Array, bool, bool]:
    """Return the normal of the main plane, whether there is no other, whether it is determined."""
    if len(points) > MOST:
        points = points[rng.choice(len(points), MOST, replace=False)]
    num, first = len(points), ransac(points, rng)
    one = distance(points, first) < TAU_M
    is_one, explained = True, one.mean()
    if num - one.sum() >= max(8, 0.1 * num):
        second = ransac(points[~one], rng)
        for _ in range(5):
            near, far = distance(points, first), distance(points, second)
            one = (near <= far) & (near < 2.0 * TAU_M)
            two = (far < near) & (far < 2.0 * TAU_M)
            if min(one.sum(), two.sum()) < 4:
                break
            first, second = plane(points[one]), plane(points[two])
        if two.sum() > one.sum():
            first, second, one, two = second, first, two, one
        apart_m = abs((second[0] - first[0]) @ first[1])
        turned = abs(first[1] @ second[1]) < np.cos(np.radians(15.0))
        is_one = not (two.mean() >= 0.1 and (apart_m > 0.05 or turned))
        explained = one.mean() + two.mean()
    half = rng.permutation(one.sum()) < one.sum() // 2
    is_sure = one.sum() >= 8
    if is_sure:
        halves = plane(points[one][half])[1] @ plane(points[one][~half])[1]
        is_sure = abs(halves) > np.cos(np.radians(5.0))
    return first[1], bool(is_one and explained >= 0.85), bool(is_sure)


def ransac(points: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return a point and the normal of the plane with the most inliers, refined."""
    a, b, c = points[rng.integers(0, len(points), (3, 60))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    if not (length > 1e-6).any():
        return plane(points)
    a, normal = a[length > 1e-6], normal[length > 1e-6] / length[length > 1e-6, None]
    off = np.abs(points @ normal.T - (a * normal).sum(axis=1))
    best = (off < TAU_M).sum(axis=0).argmax()
    fit = a[best], normal[best]
    for _ in range(3):
        inliers = points[distance(points, fit) < TAU_M]
        if len(inliers) < 4:
            break
        fit = plane(inliers)
    return fit


def plane(points: Array) -> tuple[Array, Array]:
    """Return the mean and the normal of points."""
    mean = points.mean(axis=0)
    return mean, np.linalg.eigh((points - mean).T @ (points - mean))[1][:, 0]


def distance(points: Array, fit: tuple[Array, Array]) -> Array:
    """Return the distances of points from a plane, m."""
    return np.asarray(np.abs((points - fit[0]) @ fit[1]))
