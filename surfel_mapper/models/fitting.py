# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
From a cloud to planes, B-spline surfaces and Gaussians.

The cloud is thinned to a point a voxel, in the order of the voxels, so that the result does not
depend on the order of the points; then clustered until every cluster is flat or small; flat ones
are joined to surfaces, which become planes or height fields; the rest are Gaussians.

Source: Gao and Dong 2025 (A Real-Time Multi-Model Parametric Representation of Point Clouds).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import ModelsConfig
from surfel_mapper.errors import ModelError
from surfel_mapper.filters.grids import ScanVoxels
from surfel_mapper.kernels.selection import copy_ranges, number_ranges
from surfel_mapper.models.clusters import (
    Clusters,
    clusters_of,
    is_paper,
    mean_normal,
    surfaces_of,
    thickness,
)
from surfel_mapper.models.kernels.voxel_means import (
    finite_ends,
    give_labels,
    mean_runs,
    row_bits,
    sorted_runs,
    voxel_keys,
    voxel_runs,
)
from surfel_mapper.models.multi_model import Gaussians, MultiModel, Plane, Surface
from surfel_mapper.models.patches import Groups, patches_of

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


def fit(
    points: npt.NDArray[Any],
    config: ModelsConfig | None = None,
    viewpoint: npt.ArrayLike = (0.0, 0.0, 0.0),
) -> MultiModel:
    """
    Return planes, surfaces and Gaussians for a cloud.

    Parameters
    ----------
    points : (..., 3) float32 or float64, m
        Organised or not; what is not finite is left out.
    config : ModelsConfig, optional
        Settings; the defaults without it.
    viewpoint : (3,) float, m
        Where the sensor was; normals face it, and its noise grows with the distance.

    Returns
    -------
    MultiModel
        Empty for no points; exact planes, points on a line and repeated ones are no exception.

    Raises
    ------
    ModelError
        If points or viewpoint are of another shape or type.
    FilterError
        If the cloud extends over more voxels than can be numbered.

    """
    config = config or ModelsConfig()
    points, view = np.asarray(points), np.asarray(viewpoint, np.float64)
    if points.ndim < 2 or points.shape[-1] != 3 or points.dtype not in (np.float32, np.float64):
        raise ModelError(
            f'points: {points.dtype} {points.shape}, expected (..., 3) float32 or float64'
        )
    if view.shape != (3,) or not np.isfinite(view).all():
        raise ModelError(f'viewpoint: {viewpoint!r}, expected three finite numbers')
    laps = [perf_counter()]
    thinned = thin(points.reshape(-1, 3), config.voxel_size_m)
    laps.append(perf_counter())
    clusters = clusters_of(thinned.means, config, view)
    laps.append(perf_counter())
    everything = config.kinds == 'all'
    surfaces = surfaces_of(clusters, config, view) if everything else []
    laps.append(perf_counter())
    patches = fitted_patches(clusters, surfaces, config, view)
    laps.append(perf_counter())
    names = ('thin', 'cluster', 'join', 'fit')
    times = [1e3 * (end - start) for start, end in pairwise(laps)]
    model, labels = assembled(clusters, patches, config)
    stages = dict(zip(names, times, strict=True))
    return replace(model, labels=thinned.spread(labels), milliseconds=stages)


@dataclass(frozen=True, slots=True, eq=False)
class Thinned:
    """
    A point for every voxel with points.

    Attributes
    ----------
    means : (M, 3) float64, m
        Means of the points, in the order of the voxels.
    runs : (R,) int64
        Which rows of the cloud are in which voxel; see models/kernels/voxel_means.py.
    num_points : int
        All points, finite or not.

    """

    means: Array
    runs: Indices
    num_points: int

    def spread(self, labels: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
        """Return labels for all points from those of the means, -1 where they are not finite."""
        found = np.full(self.num_points, -1, np.int32)
        give_labels(self.runs, row_bits(self.num_points), labels, found)
        return found


def thin(points: npt.NDArray[Any], voxel_size_m: float) -> Thinned:
    """Return the means of the points (N, 3) in each voxel."""
    points, ends = np.ascontiguousarray(points), np.empty((2, 3))
    if not finite_ends(points, ends):
        return Thinned(np.empty((0, 3)), np.empty(0, np.int64), len(points))
    grid = ScanVoxels.between(ends[0], ends[1], np.full(3, voxel_size_m), 'origin')
    keys, to_key = np.empty(len(points), np.int64), row_bits(len(points))
    voxel_keys(points, grid.size, grid.shift, grid.base, grid.bits, keys)
    key_bits = int(grid.bits.sum())
    if key_bits + to_key > 63:  # far more voxels than points: number those that hold any
        held = keys >= 0
        keys[held] = np.unique(keys[held], return_inverse=True)[1]
        key_bits = len(points).bit_length()
    num = voxel_runs(keys, to_key)
    runs = sorted_runs(keys[:num], key_bits, to_key)
    means = np.empty((num, 3))
    return Thinned(means[: mean_runs(points, runs, to_key, means)], runs, len(points))


def fitted_patches(
    clusters: Clusters, surfaces: list[Indices], config: ModelsConfig, viewpoint: Array
) -> list[tuple[Plane, Indices]]:
    """Return the patches that fit, each with the rows of its clusters."""
    least = 1 if is_paper(config) else config.min_surface_points
    counts = clusters.num_points
    kept = [members for members in surfaces if counts[members].sum() >= least]
    if not kept:
        return []
    starts = np.concatenate([[0], np.cumsum([counts[members].sum() for members in kept])])
    points = np.empty((starts[-1], 3))
    copy_ranges(clusters.points, clusters.rows[np.concatenate(kept)], points)
    means = np.array([counts[m] @ clusters.mean[m] / counts[m].sum() for m in kept])
    groups = Groups(
        points=points,
        starts=starts,
        normals=np.array([mean_normal(clusters, members) for members in kept]),
        thickness=thickness(means, config, viewpoint),
    )
    patches = patches_of(groups, config, viewpoint)
    return [(p, members) for p, members in zip(patches, kept, strict=True) if p is not None]


def assembled(
    clusters: Clusters, patches: list[tuple[Plane, Indices]], config: ModelsConfig
) -> tuple[MultiModel, npt.NDArray[np.int32]]:
    """Return the model, numbered anew, and the labels (M,) of the thinned points."""
    planes = [patch for patch in patches if not isinstance(patch[0], Surface)]
    surfaces = [patch for patch in patches if isinstance(patch[0], Surface)]
    of_cluster = np.full(len(clusters), -1, np.int64)
    numbered: list[Plane] = []
    for number, (patch, members) in enumerate([*planes, *surfaces]):
        of_cluster[members] = number
        numbered.append(replace(patch, id=number))
    rest = np.flatnonzero(of_cluster < 0)
    of_cluster[rest] = len(numbered) + np.arange(len(rest))
    labels = np.empty(len(clusters.points), np.int32)
    number_ranges(clusters.rows, of_cluster, clusters.order, labels)
    model = MultiModel(
        planes=numbered[: len(planes)],
        surfaces=[patch for patch in numbered if isinstance(patch, Surface)],
        gaussians=Gaussians(
            id=of_cluster[rest],
            num_points=clusters.num_points[rest],
            mean=clusters.mean[rest],
            covariance=clusters.covariances()[rest],
        ),
        labels=labels,
        voxel_size_m=config.voxel_size_m,
        num_thinned=len(clusters.points),
    )
    return model, labels
