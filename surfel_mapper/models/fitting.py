# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Fit planes, B-spline surfaces and Gaussians to a cloud.

The cloud is thinned to a point a voxel, in the order of the voxels, so that the result does not
depend on the order of the points; then bisected into clusters that are flat or small. Flat ones
are merged to surfaces, which become planes or height fields; the others are Gaussians.

A map of surfels is fitted as a cloud of nine points across each surfel, which carry its slope.

Source: Gao and Dong 2025 (A Real-Time Multi-Model Parametric Representation of Point Clouds).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
import logging
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.compilation import clock
from surfel_mapper.config import ModelsConfig
from surfel_mapper.errors import ModelError
from surfel_mapper.filters.grids import AXIS_BITS, KEY_BITS
from surfel_mapper.mapping.moments import are_far_apart, OTHER_UNIT
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.models.coarse_growth import (
    CoarseRules,
    gap_pieces,
    grow_coarse,
    in_scatter,
    join_coarse,
    SPARSE_SHARE,
)
from surfel_mapper.models.coverage import covered
from surfel_mapper.models.frames import eigen
from surfel_mapper.models.growth import Charts, grow, Grown, grown, owner_table, VoxelPoints
from surfel_mapper.models.kernels.frames import LEAST_WIDTH, member_moments, split_members
from surfel_mapper.models.multi_model import Gaussians, MultiModel, Plane, Surface
from surfel_mapper.models.noise import estimate_noise, LEAST_DISPARITY_NOISE, NoiseSamples
from surfel_mapper.models.patches import (
    described,
    fit_patches,
    PatchPoints,
    rms_across,
    SURFACE_PITCH_VOXELS,
)
from surfel_mapper.models.seams import with_smooth_seams
from surfel_mapper.models.segmentation import (
    Clusters,
    is_paper,
    merge_clusters,
    segment_cloud,
    thickness,
)
from surfel_mapper.models.thinning import thin, Thinned

_log = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Owners = npt.NDArray[np.int32]

SIZES = (0.5, 2.0, 4.0, 8.0, 16.0, 64.0, 128.0)
"""
Edges of the voxels in which points that are left are grown and patches are joined, in those of the
cloud; the finer ones only if these can be numbered.
"""

PARTS, MOST_PARTED_M = 3, 0.1
"""
Parts of a voxel along each axis, and the largest voxels that are divided: models are grown over
the means of the points in each, so patches of near and far surfaces follow the same rules. Larger
voxels are as large as objects, so models are grown over all points.
"""

MERGED_VOXELS = 0.3
"""
Largest offset of merged clusters before growth, in voxels. Merged clusters are never divided
again, as a book and its table would have to be. Separate ones may be joined after growth.
"""

STAGES = ('thin', 'neighbours', 'cluster', 'merge', 'fit', 'grow', 'refit')
"""Names of the stages of a fit with growth."""


def fit(
    points: npt.NDArray[Any],
    config: ModelsConfig | None = None,
    viewpoint: npt.ArrayLike = (0.0, 0.0, 0.0),
) -> MultiModel:
    """
    Fit planes, surfaces and Gaussians to a cloud.

    Parameters
    ----------
    points : (..., 3) float32 or float64, m
        Organised or not; points that are not finite are left out.
    config : ModelsConfig, optional
        Settings; defaults if omitted.
    viewpoint : (3,) float, m
        Position of the sensor; normals face it, and noise grows with the distance from it.

    Returns
    -------
    MultiModel
        Empty for no points; exact planes, collinear and repeated points are valid input.

    Raises
    ------
    ModelError
        If points or viewpoint have a wrong shape or dtype.
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
    laps = [clock()]
    grows = not is_paper(config) and config.kinds == 'all'
    divisions = PARTS if grows and config.voxel_size_m <= MOST_PARTED_M else 1
    thinned = thin(points.reshape(-1, 3), config.voxel_size_m, divisions)
    if are_far_apart(thinned.means, len(thinned.rows)):
        _log.warning(OTHER_UNIT)
    laps.append(clock())
    grows = grows and len(thinned.means) > 0
    model = (fit_points if grows else fit_means)(thinned, config, view, laps)
    laps.append(clock())
    names = ('thin', 'cluster', 'merge', 'fit') if len(laps) == 5 else STAGES
    times = [1e3 * (end - start) for start, end in pairwise(laps)]
    return replace(model, milliseconds=dict(zip(names, times, strict=True)))


def fit_means(
    thinned: Thinned, config: ModelsConfig, view: Array, laps: list[float]
) -> MultiModel:
    """Fit models to one point a voxel, as in the paper."""
    clusters = segment_cloud(thinned.means, config, view)
    laps.append(clock())
    surfaces = merge_clusters(clusters, config, view) if config.kinds == 'all' else []
    laps.append(clock())
    kept, groups = chart_points(clusters, surfaces, config, view)
    fitted = zip(fit_patches(groups, config, view), kept, strict=True)
    patches = [(patch, members) for patch, members in fitted if patch is not None]
    model, labels = assembled(clusters, patches, config)
    return replace(model, labels=thinned.point_labels(labels))


def fit_points(fine: Thinned, config: ModelsConfig, view: Array, laps: list[float]) -> MultiModel:
    """Fit models to one point a voxel, and grow them over those of the parts of voxels."""
    is_parted = fine.divisions > 1
    thinned = fine.whole_voxels() if is_parted else fine
    voxels = thinned.by_voxel()
    if config.noise_m == config.noise_per_range_sq == 0.0:
        starts = fine.starts[thinned.starts] if is_parted else fine.starts
        samples = NoiseSamples(fine.points, fine.rows, starts, thinned.means, view=view)
        noise = estimate_noise(samples, config.voxel_size_m)
        config = replace(config, noise_m=min(noise[0], 1.0), noise_per_range_sq=min(noise[1], 1.0))
    laps.append(clock())
    clusters = segment_cloud(thinned.means, config, view)
    laps.append(clock())
    close = replace(
        config,
        max_offset_voxels=min(config.max_offset_voxels, MERGED_VOXELS),
        arc_offset_voxels=min(config.arc_offset_voxels, MERGED_VOXELS),
    )
    surfaces = merge_clusters(clusters, close, view)
    laps.append(clock())
    kept, groups = chart_points(clusters, surfaces, config, view)
    charts = charts_of(clusters, groups, config, view)
    laps.append(clock())
    group = np.empty(len(thinned.means), np.int32)
    group[clusters.order] = np.repeat(np.arange(len(clusters)), clusters.num_points)
    of_cluster = np.full(len(clusters), -1, np.int32)
    for k, members in enumerate(kept):
        of_cluster[members] = k
    label = of_cluster[group]
    growth = grow(voxels, thinned.means, label, group, charts, config, view)
    joined = growth
    if config.noise_per_range_sq < LEAST_DISPARITY_NOISE:
        joined = grow_sparse(thinned, voxels, growth, group, config, view)
    laps.append(clock())
    fitted = owner_patches(joined, config, view)
    lost = np.array([patch is None for patch in fitted], np.bool_)
    if lost.any() and joined is not growth:
        joined = separated(voxels, joined, growth, lost)
        fitted = owner_patches(joined, config, view)
    model = owner_models(thinned, voxels, joined, fitted, config)
    if not is_parted:
        return covered(model, fine.points, np.ones(len(fine.points), np.int64), view)
    model = covered(model, fine.means, np.diff(fine.starts), view)
    return replace(model, labels=fine.point_labels(model.labels))


def grow_sparse(
    thinned: Thinned,
    voxels: VoxelPoints,
    growth: Grown,
    group: Owners,
    config: ModelsConfig,
    view: Array,
) -> Grown:
    """
    Find facets in finer, then in coarser voxels while many points are on no patch; join all.

    Planes in scatter are taken out: their points are those of groups, (V,) by voxel.
    """
    noise = config.noise_m, config.noise_per_range_sq
    rules = CoarseRules(config.voxel_size_m, growth.tolerance_m, noise, view)
    shape, owner = (growth.normals, growth.curved), growth.owner.copy()
    halves = thinned.bits.max() < AXIS_BITS and thinned.bits.sum() + 3 <= KEY_BITS
    for factor in SIZES if halves else SIZES[1:]:
        size_m = factor * config.voxel_size_m
        grows = (owner < 0).sum() >= max(SPARSE_SHARE * len(owner), 1.0)
        if grows:
            shape = grow_coarse(voxels.points, owner, shape, size_m, rules, config)
        if len(shape[0]) > 1 and (grows or factor > 1.0):
            size_m = max(size_m, config.voxel_size_m)
            pieces = gap_pieces(voxels, owner, len(shape[0]), size_m)
            shape = join_coarse(pieces, owner, shape, rules)
    keeps = ~in_scatter(voxels, owner, shape[1], config.voxel_size_m)
    if shape[0] is growth.normals and keeps.all():
        return growth
    index = np.where(keeps, np.cumsum(keeps) - 1, -1).astype(np.int32)
    rows = np.flatnonzero(owner >= 0)
    owner[rows] = index[owner[rows]]
    freed = rows[owner[rows] < 0]
    owner[freed] = -1 - np.repeat(group, np.diff(voxels.starts))[freed]
    shape = shape[0][keeps], shape[1][keeps]
    return grown(owner, owner_table(voxels, owner), *shape, growth.tolerance_m)


def separated(
    voxels: VoxelPoints, joined: Grown, previous: Grown, lost: npt.NDArray[np.bool_]
) -> Grown:
    """Return joined patches, the lost ones (K,) as the previous ones; these are multi-valued."""
    number = len(joined.normals)
    is_unjoined = np.append(lost, np.False_)[np.maximum(joined.owner, -1)]
    previous_owner = np.where(previous.owner >= 0, previous.owner + number, previous.owner)
    owner = np.where(is_unjoined, previous_owner, joined.owner)
    used, index = np.unique(np.maximum(owner, -1), return_inverse=True)
    shift = int(used[0] < 0)
    owner = np.where(owner < 0, owner, index - shift).astype(np.int32)
    normals = np.concatenate([joined.normals, previous.normals])[used[shift:]]
    curved = np.concatenate([joined.curved, previous.curved])[used[shift:]]
    return grown(owner, owner_table(voxels, owner), normals, curved, joined.tolerance_m)


def owner_patches(growth: Grown, config: ModelsConfig, view: Array) -> list[Plane | None]:
    """Fit patches to the points that they own; None for multi-valued ones."""
    number = len(growth.normals)
    starts = np.searchsorted(growth.owners, np.arange(number + 1))
    first = int(starts[0])
    if not number:
        return []
    centre = np.add.reduceat(growth.means, starts[:-1]) / np.diff(starts)[:, None]
    facing = np.einsum('ij,ij->i', growth.normals, view - centre)
    points = PatchPoints(
        points=np.ascontiguousarray(growth.means[first:]),
        starts=starts - first,
        normals=growth.normals * np.where(facing < 0.0, -1.0, 1.0)[:, None],
        thickness=thickness(centre, config, view),
        curved=growth.curved,
    )
    return fit_patches(points, config, view)


def owner_models(
    thinned: Thinned,
    voxels: VoxelPoints,
    growth: Grown,
    patches: list[Plane | None],
    config: ModelsConfig,
) -> MultiModel:
    """Return patches, and Gaussians of groups of the points that have none."""
    number = len(patches)
    order = [k for _, k in sorted((p.id, k) for k, p in enumerate(patches) if p is not None)]
    kept = [patch for k in order if (patch := patches[k]) is not None]
    num_planes = sum(not isinstance(patch, Surface) for patch in kept)
    starts = np.searchsorted(growth.owners, np.arange(number + 1))
    surfaces = with_smooth_seams(
        [patch for patch in kept if isinstance(patch, Surface)],
        [growth.means[starts[k] : starts[k + 1]] for k in order[num_planes:]],
        config,
    )
    ids = np.full(number, -1, np.int64)
    ids[order] = np.arange(len(order))
    # multi-valued surfaces and free groups are Gaussians; groups are negative owners
    is_free = np.append(ids, -1)[np.maximum(growth.owners, -1)] < 0
    names, group = np.unique(growth.owners[is_free], return_inverse=True)
    low = min(int(growth.owners.min(initial=0)), 0)
    table = np.empty(number - low, np.int32)
    table[-low:] = ids
    table[names - low] = len(kept) + np.arange(len(names))
    label = table[growth.owner - low]
    own = label >= len(kept)
    group, label[own] = narrow_groups(
        (growth.means[is_free], group),
        (voxels.points[own], label[own].astype(np.int64) - len(kept)),
        WIDE_VOXELS * config.voxel_size_m,
    )
    label[own] += len(kept)
    labels = np.full(len(thinned.points), -1, np.int32)
    labels[voxels.rows] = label
    counts = np.bincount(group)
    mean, covariance = group_moments(growth.means[is_free], group, counts)
    return MultiModel(
        planes=kept[:num_planes],
        surfaces=surfaces,
        gaussians=Gaussians(len(kept) + np.arange(len(counts)), counts, mean, covariance),
        labels=labels,
        voxel_size_m=config.voxel_size_m,
        num_thinned=len(growth.means),
        noise=(config.noise_m, config.noise_per_range_sq),
    )


WIDE_VOXELS, LEAST_WIDE = 2.0, 4
"""Gaussians of as many points whose largest sigma exceeds that number of voxels are divided."""


def narrow_groups(
    means: tuple[Array, Indices], points: tuple[npt.NDArray[Any], Indices], wide_m: float
) -> tuple[Indices, Indices]:
    """
    Divide wide groups of points at their mean, across their longest axis.

    The remaining points of a cluster may surround its patches. One Gaussian of all of them would
    fill the space of the patches.

    Parameters
    ----------
    means : (M, 3) float64, m, and (M,) int64
        Points of the thinned cloud, and their groups.
    points : (N, 3) float, m, and (N,) int64
        All points, and their groups.
    wide_m : float
        Largest sigma of a group of LEAST_WIDE points, m.

    Returns
    -------
    (M,) int64, (N,) int64
        Groups of both.

    """
    (xyz, group), (every, of_point) = means, points
    group, of_point = group.copy(), of_point.copy()
    while len(group):
        counts = np.bincount(group)
        mean, covariance = group_moments(xyz, group, counts)
        values, axes = eigen(covariance)
        is_wide = (counts >= LEAST_WIDE) & (values[:, 2] > wide_m**2)
        if not is_wide.any():
            break
        axis = np.where(is_wide[:, None], axes[:, 2], 0.0)
        number = len(counts) + np.cumsum(is_wide) - 1
        split_members(xyz, group, mean, axis, number)
        split_members(every, of_point, mean, axis, number)
    return group, of_point


def group_moments(points: Array, group: Indices, counts: Indices) -> tuple[Array, Array]:
    """Return mean (G, 3) and covariance (G, 3, 3) of groups of points."""
    mean, covariance = np.zeros((len(counts), 3)), np.zeros((len(counts), 3, 3))
    member_moments(points, group, counts, mean, covariance)
    return mean, covariance


def chart_points(
    clusters: Clusters, surfaces: list[Indices], config: ModelsConfig, viewpoint: Array
) -> tuple[list[Indices], PatchPoints]:
    """Return the charts with enough points, as lists of their clusters, and their points."""
    least = 1 if is_paper(config) else config.min_surface_points
    counts = clusters.num_points
    kept = [members for members in surfaces if counts[members].sum() >= least]
    rows, first = np.concatenate([np.empty(0, np.int64), *kept]), np.cumsum([0, *map(len, kept)])
    columns = np.column_stack([np.ones(len(rows)), clusters.mean[rows], clusters.frames[rows, 2]])
    sums = np.add.reduceat(counts[rows, None] * columns, first[:-1])
    lengths = np.linalg.norm(sums[:, 4:], axis=1)
    points = [clusters.points[start:stop] for start, stop in clusters.rows[rows].tolist()]
    groups = PatchPoints(
        points=np.concatenate([np.empty((0, 3)), *points]),
        starts=np.append(0, np.cumsum(counts[rows]))[first],
        normals=sums[:, 4:] / np.where(lengths > 0.0, lengths, 1.0)[:, None],
        thickness=thickness(sums[:, 1:4] / sums[:, :1], config, viewpoint),
    )
    return kept, groups


def charts_of(
    clusters: Clusters, groups: PatchPoints, config: ModelsConfig, viewpoint: Array
) -> Charts:
    """Return the charts of points for growth."""
    rules = groups.thickness, SURFACE_PITCH_VOXELS * config.voxel_size_m, True, True
    means, covariances, frames, curved = described(groups, viewpoint, rules)
    normals, axes = frames[:, 2], clusters.frames[:, 2]
    rms_m = rms_across(covariances, normals, np.diff(groups.starts))
    offsets = -np.einsum('ij,ij->i', axes, clusters.mean)
    return Charts(means, normals, rms_m, curved, np.column_stack([axes, offsets]))


def assembled(
    clusters: Clusters, patches: list[tuple[Plane, Indices]], config: ModelsConfig
) -> tuple[MultiModel, npt.NDArray[np.int32]]:
    """Return the model and the labels (M,) of the thinned points."""
    of_cluster = np.full(len(clusters), -1, np.int64)
    for patch, members in patches:
        of_cluster[members] = patch.id
    kept = sorted((patch for patch, _ in patches), key=lambda patch: patch.id)
    free = np.flatnonzero(of_cluster < 0)
    of_cluster[free] = len(kept) + np.arange(len(free))
    labels = np.empty(len(clusters.points), np.int32)
    labels[clusters.order] = np.repeat(of_cluster, clusters.num_points)
    model = MultiModel(
        planes=[patch for patch in kept if not isinstance(patch, Surface)],
        surfaces=[patch for patch in kept if isinstance(patch, Surface)],
        gaussians=Gaussians(
            id=of_cluster[free],
            num_points=clusters.num_points[free],
            mean=clusters.mean[free],
            covariance=clusters.covariances()[free],
        ),
        labels=labels,
        voxel_size_m=config.voxel_size_m,
        num_thinned=len(clusters.points),
    )
    return model, labels


ABOVE_EXTENTS = 1.0
"""Height of the virtual viewpoint above a map, in diagonals of the map."""

INSET = 1e-6
"""
Least distance of points across surfels from the faces of their voxel, in voxels: more than the
rounding of coordinates as far as voxels are numbered.
"""


def surfel_points(surfels: Surfels, voxel_size_m: float) -> Array:
    """
    Return points (9 K, 3) across surfels, m; surfels without a normal are left out.

    A full square of width w has sigma w / sqrt(12), so its half width is sqrt(3) sigma.

    Parameters
    ----------
    surfels : Surfels
        K of them with a normal.
    voxel_size_m : float
        Edge of their voxels, m: no point leaves its voxel.

    """
    surfels = surfels.select(np.flatnonzero(np.isfinite(surfels.planarity)))
    x, y = across(surfels.normal)
    # surfels do not store their tangential axes: the disc is taken as round
    wide = np.sqrt(3.0 * surfels.eigenvalues[:, 1:].mean(axis=1))
    # a line is one point
    wide[surfels.eigenvalues[:, 1] < LEAST_WIDTH * surfels.eigenvalues[:, 2]] = 0.0
    half = np.minimum(wide, voxel_size_m * np.sqrt(0.5))[:, None]
    low, high = ((surfels.voxel_index + to) * voxel_size_m for to in (INSET, 1.0 - INSET))
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    samples = [surfels.position + half * (i * x + j * y) for i, j in steps]
    inside = [np.clip(sample, low, high) for sample in samples]
    points: Array = np.stack(inside, axis=1).reshape(-1, 3)
    return points


def across(normals: Array) -> tuple[Array, Array]:
    """Return two unit vectors (K, 3) orthogonal to each normal and to each other."""
    helper = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    x = np.cross(helper, normals)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return x, np.asarray(np.cross(normals, x), np.float64)


def above(surfels: Surfels) -> Array:
    """Return a viewpoint (3,) far above the middle of surfels, m."""
    if not len(surfels):
        return np.zeros(3)
    low, high = surfels.position.min(axis=0), surfels.position.max(axis=0)
    centre: Array = 0.5 * (low + high)
    centre[2] = high[2] + ABOVE_EXTENTS * float(np.linalg.norm(high - low))
    return centre
