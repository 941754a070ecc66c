# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Segmentation of a cloud: flat clusters, merged to regions, cut into charts.

A chart is a height field over one plane. A region whose normals deviate from their mean by more
than ``fold_angle_deg`` is bisected by its normals until every part is a chart; a closed cylinder
becomes at least two.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models.frames import eigen, means_and_scatters, oriented
from surfel_mapper.models.kernels.bisection import bisect_cloud, NOISE_SPREAD
from surfel_mapper.models.kernels.region_merging import find_pairs, merge_pairs

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Rows = TypeVar('Rows', npt.NDArray[np.int32], npt.NDArray[np.int64])

FAR_GAP_VOXELS = 5.0
NEAR_GAP_VOXELS = 3.0
"""Linked clusters have boxes nearer than FAR_GAP_VOXELS and points nearer than this."""

MEANS_ITERATIONS = 20
"""Most iterations of 2-means on normals."""

STEADY_SHARE = 0.5
"""
2-means begins with the first axis of the map with this share of the largest variance. The normals
of a ball vary alike in two directions, and their principal axis turns with every scan.
"""

FOLD_PERCENTILE, MOST_FOLDED = 98.0, 20
"""
A surface is folded unless this percentage of normals is near the mean, and at most this number is
not: a cup on a table has less than 2 % of the voxels of both.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """
    Clusters of points, K rows.

    Attributes
    ----------
    points : (N, 3) float64, m
        Reordered, so that a cluster is a range of rows.
    order : (N,) int32
        The row that each point had before.
    rows : (K, 2) int64
        First row of each cluster and the one after its last; ascending, without gaps.
    flat : (K,) bool
        Whether it is a piece of a plane.
    mean : (K, 3) float64, m
    eigenvalues : (K, 3) float64, m^2
        Of the covariance, ascending.
    frames : (K, 3, 3) float64
        Rows x (largest eigenvalue), y, normal.

    """

    points: Array
    order: npt.NDArray[np.int32]
    rows: Indices
    flat: npt.NDArray[np.bool_]
    mean: Array
    eigenvalues: Array
    frames: Array

    def __len__(self) -> int:
        """Return the number of clusters."""
        return len(self.flat)

    @property
    def num_points(self) -> Indices:
        """Points of each cluster, (K,)."""
        counts: Indices = self.rows[:, 1] - self.rows[:, 0]
        return counts

    def covariances(self) -> Array:
        """Return the covariances, (K, 3, 3) m^2."""
        scaled = self.eigenvalues[:, ::-1, None] * self.frames
        result: Array = np.einsum('kij,kil->kjl', self.frames, scaled)
        return result


def is_paper(config: ModelsConfig) -> bool:
    """Return whether the rules are those of the paper."""
    return config.profile == 'paper'


def segment_cloud(points: Array, config: ModelsConfig, viewpoint: Array) -> Clusters:
    """Cluster (N, 3) points; normals face the viewpoint (3,), m."""
    number, by_paper = len(points), is_paper(config)
    moved, spare = np.ascontiguousarray(points.T), np.empty((4, number))
    order, spare_order = np.arange(number, dtype=np.int32), np.empty(number, np.int32)
    rows, flat = np.empty((number, 2), np.int64), np.empty(number, np.bool_)
    rules = (
        config.voxel_size_m,
        config.min_density_radius,
        float(config.max_mixture_points),
        float(config.min_points),
        0.0 if by_paper else config.outlier_share,
        0.0 if by_paper else config.noise_m,
        0.0 if by_paper else config.noise_per_range_sq,
        0.0 if by_paper else 1.0,
    )
    num = bisect_cloud(moved, order, viewpoint, rules, spare, spare_order, rows, flat)
    at = np.argsort(rows[:num, 0])
    ordered, starts = np.ascontiguousarray(moved.T), np.append(rows[at, 0], number)
    counts, means, scatters = means_and_scatters(ordered, np.ones(number), starts)
    values, axes = eigen(scatters / np.maximum(counts - 1.0, 1.0)[:, None, None])
    frames = oriented(axes, viewpoint - means)
    return Clusters(ordered, order, rows[at], flat[at], means, values, frames)


def thickness(means: Array, config: ModelsConfig, viewpoint: Array) -> Array:
    """Return the largest thickness, 6 sigma, of a plane at (K, 3) locations, m."""
    if is_paper(config):
        return np.full(len(means), config.voxel_size_m)
    range_sq = ((means - viewpoint) ** 2).sum(axis=1)
    sigma = NOISE_SPREAD * (config.noise_m + config.noise_per_range_sq * range_sq)
    result: Array = np.sqrt(config.voxel_size_m**2 + 36.0 * sigma**2)
    return result


def merge_clusters(clusters: Clusters, config: ModelsConfig, viewpoint: Array) -> list[Indices]:
    """Return the flat clusters of each chart: their rows, (n,) int64, lowest first."""
    flat = np.flatnonzero(clusters.flat)
    scales = thickness(clusters.mean, config, viewpoint) / config.voxel_size_m

    def components(members: Indices) -> list[Indices]:
        return merged(clusters, members, scales, config)

    def side(members: Indices) -> npt.NDArray[np.bool_] | None:
        return folded(clusters, members, config)

    return height_fields(components(flat), side, components)


def height_fields(
    groups: list[Rows],
    side: Callable[[Rows], npt.NDArray[np.bool_] | None],
    components: Callable[[Rows], list[Rows]],
) -> list[Rows]:
    """
    Bisect groups of rows until each is a height field; clusters and surfels of a map alike.

    Parameters
    ----------
    groups : list of (n,) int
        Rows of clusters or surfels.
    side : callable
        Returns how to bisect rows, (n,) bool, or None if they are a height field.
    components : callable
        Returns the connected components of rows.

    """
    fields, waiting = [], groups[::-1]
    while waiting:
        group = waiting.pop()
        beyond = side(group)
        if beyond is None:
            fields.append(group)
        else:
            for half in (group[beyond], group[~beyond]):
                waiting += components(half)[::-1]
    return fields


def merged(
    clusters: Clusters, members: Indices, scales: Array, config: ModelsConfig
) -> list[Indices]:
    """Return the connected components of some clusters."""
    a, by_paper = config.voxel_size_m, is_paper(config)
    rules = (
        math.cos(math.radians(config.max_angle_deg)),
        config.max_offset_voxels * a,
        2.0 if by_paper else math.cos(math.radians(config.arc_angle_deg)),
        config.arc_offset_voxels * a,
        FAR_GAP_VOXELS * a,
        NEAR_GAP_VOXELS * a,
    )
    rows, scales = clusters.rows[members], scales[members]
    shapes = clusters.mean[members], clusters.eigenvalues[members], clusters.frames[members]
    pairs, lengths = np.empty((1024, 2), np.int64), np.empty(1024)
    number = find_pairs(*shapes, scales, rules, pairs, lengths)
    if number > len(pairs):
        pairs, lengths = np.empty((number, 2), np.int64), np.empty(number)
        find_pairs(*shapes, scales, rules, pairs, lengths)
    nearest = np.argsort(lengths[:number], kind='stable')
    boxes, parent = boxes_of(clusters.points, rows), np.empty(len(members), np.int64)
    merge_pairs(clusters.points, rows, boxes, pairs[nearest], rules[5], parent)
    order = np.argsort(parent, kind='stable')
    ends = np.flatnonzero(np.diff(parent[order])) + 1
    return [component for component in np.split(members[order], ends) if len(component)]


def boxes_of(points: Array, rows: Indices) -> Array:
    """Return the least and greatest coordinates (K, 2, 3) of ranges of rows (K, 2), none empty."""
    edges = rows.ravel()[: np.searchsorted(rows.ravel(), len(points))]  # the end is no row
    ends = [end.reduceat(points, edges)[::2] for end in (np.minimum, np.maximum)]
    return np.stack(ends, axis=1)


def mean_normal(clusters: Clusters, members: Indices) -> Array:
    """Return the mean unit normal (3,) of clusters, weighted by points; 0 if they cancel."""
    total = clusters.num_points[members] @ clusters.frames[members, 2]
    length = float(np.linalg.norm(total))
    unit: Array = total / length if length > 0.0 else total
    return unit


def folded(
    clusters: Clusters, members: Indices, config: ModelsConfig
) -> npt.NDArray[np.bool_] | None:
    """Return how to bisect a region (n,) bool, or None if it is a chart."""
    limit = math.cos(math.radians(config.fold_angle_deg))
    normals, mean = clusters.frames[members, 2], mean_normal(clusters, members)
    return bisected_normals(normals) if is_folded(normals, mean, limit) else None


def is_folded(normals: Array, mean: Array, limit: float) -> bool:
    """Return whether too many cosines of normals (n, 3) to their mean are below a limit."""
    cosines = normals @ mean
    below = np.count_nonzero(cosines < limit)
    if len(normals) < 2 or below == 0 or below > MOST_FOLDED:
        return len(normals) >= 2 and below > 0
    return bool(np.percentile(cosines, 100.0 - FOLD_PERCENTILE) < limit)


def bisected_normals(normals: Array) -> npt.NDArray[np.bool_] | None:
    """Return one half (n,) of normals (n, 3) by 2-means, or None if the other one is empty."""
    spread = normals.var(axis=0)
    axis = int(np.argmax(spread >= STEADY_SHARE * spread.max()))
    side = normals[:, axis] > normals[:, axis].mean()
    for _ in range(MEANS_ITERATIONS):
        if side.all() or not side.any():
            return None
        first, second = normals[side].mean(axis=0), normals[~side].mean(axis=0)
        previous, side = side, normals @ (first - second) > 0.5 * (first @ first - second @ second)
        if (side == previous).all():
            break
    return np.asarray(side, np.bool_)
