# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
From patches of clusters to patches of points: noise, growth, facets, merging.

Recursive bisection finds large patches from one point a voxel, but leaves voxels at edges, on
small faces and at boundaries to Gaussians: at 3 cm three quarters of the objects on a table.
Growth uses all points of each voxel. Patches grow over touching voxels, facets are grown from the
points that are left, patches of one surface are joined, and every point goes to the patch that it
lies on.

The tolerance of a patch follows from the distances of its own points, so it needs no model of the
sensor; thresholds of the bisection use the noise that is estimated from blocks of voxels.

Source: Besl and Jain 1988 (region growing from seeds); the rest is our own.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models.frames import plane_frames
from surfel_mapper.models.joining import join_patches, LEAST_COSINE, Pieces
from surfel_mapper.models.kernels.growth import (
    assign_points,
    describe_free,
    find_facets,
    fit_layers,
    FREE,
    grow_patches,
    SLOTS,
)
from surfel_mapper.models.kernels.voxel_points import owner_means, sort_owners
from surfel_mapper.models.noise import LEAST_DISPARITY_NOISE

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Owners = npt.NDArray[np.int32]

OwnerTable = tuple[Owners, Array, Array, Indices]
"""Owners (M,), means (M, 3) and counts (M,) by voxel and owner; first row (V + 1,) of a voxel."""

FreeSurfels = tuple[Indices, npt.NDArray[np.bool_], Array, Array]
"""Number, flatness, mean and normal of the free points of every voxel, (V, ...) each."""

TOLERANCE_SIGMAS, TOLERANCE_VOXELS, MOST_TOLERANCE_VOXELS = 3.0, 0.03, 0.5
"""Tolerance of a patch: sigmas of its points and a share of a voxel, up to half a voxel."""

NOISE_SIGMAS = 2.5
"""Tolerance by the noise of the sensor at least: noise beyond a voxel is cut into layers."""

SEPARATE_SIGMAS, SEPARATE_VOXELS, SEPARATE_ROUNDS, LEAST_LAYER = 3.0, 0.1, 6, 500
"""
Half the thickness of the largest layer of a plane, in sigmas of the sensor, and at least, in
voxels. Its plane is refitted in this number of rounds. It has this number of voxels, at least.
"""

FAR_SIGMAS = 2.0
"""Tolerance of a plane in coarse voxels: these sigmas and the tolerance of facets, at most."""

SAMPLES = 20_000
"""Points for the tolerances of all patches, about."""

RESOLVED_VOXELS = 0.2
"""Tolerance of facets in voxels of the cloud, or sigmas: in clutter patches are thicker."""

LEAST_POINTS = 6
"""Points that determine the plane of a voxel, at least."""

FLAT_VOXELS = 0.6
"""Thickness of a flat voxel, 6 sigma, at most."""

GROWTH_ANGLE_DEG, FACET_ANGLE_DEG = 40.0, 25.0
"""Angle between the normals of a flat voxel and of the patch or facet that may take it."""

FACET_VOXELS, FACET_POINTS, FACET_WIDTH_VOXELS = 3, 30, 0.8
"""Smallest facet."""

MOST_FACETS = 4096


@dataclass(frozen=True, slots=True, eq=False)
class VoxelPoints:
    """
    The finite points of a cloud by voxel; see models/kernels/voxel_points.py.

    Attributes
    ----------
    points : (P, 3) float64, m
    rows : (P,) int32
        Row of each in the cloud.
    starts : (V + 1,) int64
        First point of each voxel, and P.
    adjacent : tuple
        Neighbours of voxels: first (V + 1,) int64, and rows (A,) int32.

    """

    points: Array
    rows: npt.NDArray[np.int32]
    starts: Indices
    adjacent: tuple[Indices, npt.NDArray[np.int32]]


@dataclass(frozen=True, slots=True, eq=False)
class Charts:
    """
    Planes and curved surfaces of clusters, before growth.

    Attributes
    ----------
    means, normals : (K, 3) float64, m
    rms_m : (K,) float64
        Root mean square distances of the points along the normals.
    curved : (K,) bool
        Whether a chart is a curved surface.
    tangents : (C, 4) float64
        Plane of each cluster, to which a curved chart is tangential there.

    """

    means: Array
    normals: Array
    rms_m: Array
    curved: npt.NDArray[np.bool_]
    tangents: Array


@dataclass(frozen=True, slots=True, eq=False)
class Grown:
    """
    Points by patch.

    Attributes
    ----------
    owner : (P,) int32
        Patch of every point; -1 - g for a free point of group g.
    means : (M, 3) float64, m
        Means of the points by voxel and owner, sorted by owner.
    owners : (M,) int32
        Their owners.
    normals : (K, 3) float64
        Normals of the patches; of a curved one the mean.
    curved : (K,) bool
        Whether a patch is a curved surface.
    tolerance_m : float
        Distance up to which a point lies on a facet.

    """

    owner: Owners
    means: Array
    owners: Owners
    normals: Array
    curved: npt.NDArray[np.bool_]
    tolerance_m: float


def grow(
    voxels: VoxelPoints,
    means: Array,
    label: Owners,
    group: Owners,
    charts: Charts,
    config: ModelsConfig,
    view: Array,
) -> Grown:
    """
    Grow patches and facets, and join those that lie on one plane or smooth surface.

    Parameters
    ----------
    voxels : VoxelPoints
        The points.
    means : (V, 3) float64, m
        Their means by voxel.
    label : (V,) int32
        Index of the chart of each voxel, -1 for none.
    group : (V,) int32
        Cluster of each voxel, the group of points on no patch.
    charts : Charts
        Planes and surfaces.
    config : ModelsConfig
        Settings, with the noise.
    view : (3,) float64, m
        Position of the sensor.

    """
    size_m, noise = config.voxel_size_m, (config.noise_m, config.noise_per_range_sq)
    sigma = noise_across(charts, noise, view)
    offsets = -np.einsum('ij,ij->i', charts.normals, charts.means)
    planes: Array = np.column_stack([charts.normals, offsets])
    if noise[1] >= LEAST_DISPARITY_NOISE:
        planes = largest_layers((means, label), charts, planes, sigma, size_m)
    tangent = np.append(planes, np.zeros((1, 4)), axis=0)[label]  # label -1: the last
    bends = np.flatnonzero(np.append(charts.curved, False)[label])
    tangent[bends] = charts.tangents[group[bends]]
    tolerance = tolerances(voxels, label, tangent, sigma, size_m)
    if len(tolerance):
        median_m = float(np.median(tolerance))
        resolved_m = max(RESOLVED_VOXELS * size_m, TOLERANCE_SIGMAS * float(np.median(sigma)))
        facet_m = min(median_m, resolved_m)
    else:
        range_sq = float(np.median(((means - view) ** 2).sum(axis=1)))
        facet_m = median_m = 3.0 * (noise[0] + noise[1] * range_sq) + 0.1 * size_m
    owner = np.repeat(label, np.diff(voxels.starts))
    free = free_surfels(voxels, owner, size_m, median_m)
    extend_patches(voxels, label, (tangent, tolerance), free, owner)
    num = len(planes)
    num += len(add_facets(voxels, owner, num, (size_m, facet_m), config))
    table = owner_table(voxels, owner)
    index, normals, curved = join_patches(pieces_of(voxels, table, num), view, noise, size_m)
    groups = -1 - np.repeat(group, np.diff(voxels.starts))
    owner = np.where(owner >= 0, np.append(index, 0)[owner], groups)
    return grown(owner, owner_table(voxels, owner), normals, curved, median_m)


def grown(
    owner: Owners,
    table: OwnerTable,
    normals: Array,
    curved: npt.NDArray[np.bool_],
    tolerance_m: float,
) -> Grown:
    """Return the points by patch."""
    low = min(int(table[0].min(initial=0)), 0)
    starts, _, points, _ = sorted_table(table, low, len(normals) - low)
    names = np.repeat(np.arange(low, len(normals), dtype=np.int32), np.diff(starts))
    return Grown(owner, points, names, normals, curved, tolerance_m)


def pieces_of(voxels: VoxelPoints, table: OwnerTable, number: int) -> Pieces:
    """Return the means of the points of each patch."""
    out = sorted_table(table, 0, number)
    return Pieces(*out, adjacent=voxels.adjacent, first=table[3], owners=table[0])


def owner_table(voxels: VoxelPoints, owner: Owners) -> OwnerTable:
    """Average the points of each voxel that have the same owner."""
    owners, means = np.empty(len(owner), np.int32), np.empty((len(owner), 3))
    counts, first = np.empty(len(owner)), np.empty(len(voxels.starts), np.int64)
    num = owner_means(voxels.points, voxels.starts, owner, owners, means, counts, first)
    return owners[:num], means[:num], counts[:num], first


def sorted_table(
    table: OwnerTable, least: int, number: int
) -> tuple[Indices, npt.NDArray[np.int32], Array, Array]:
    """Return starts (number + 1,), voxels, means and counts by owner, from owner least on."""
    starts = np.zeros(number + 2, np.int64)
    voxel, means = np.empty(len(table[0]), np.int32), np.empty((len(table[0]), 3))
    counts = np.empty(len(table[0]))
    num = sort_owners(table, least, starts, voxel, means, counts)
    return starts[:-1], voxel[:num], means[:num], counts[:num]


def extend_patches(
    voxels: VoxelPoints,
    label: Owners,
    shape: tuple[Array, Array],
    free: FreeSurfels,
    owner: Owners,
) -> None:
    """Grow patches, given as tangents and tolerances, over touching voxels; write the owners."""
    candidate = np.full((len(label), SLOTS), -1, np.int32)
    state = voxels.points, voxels.starts
    flat = free[1], free[3], math.cos(math.radians(GROWTH_ANGLE_DEG))
    grow_patches(*state, voxels.adjacent, label, *shape, flat, candidate)
    assign_points(*state, label, *shape, candidate, owner)


def extend_planes(
    voxels: VoxelPoints,
    owner: Owners,
    curved: npt.NDArray[np.bool_],
    sizes: tuple[float, float],
) -> None:
    """
    Grow flat patches over the free points of coarse voxels; write their owners.

    Parameters
    ----------
    voxels : VoxelPoints
        The points by coarse voxel.
    owner : (P,) int32
        Patch of every point, FREE for none.
    curved : (K,) bool
        Patches that are not extended.
    sizes : (float, float)
        Edge of the coarse voxels, and the tolerance of facets, m.

    """
    number = len(curved)
    if not number:
        return
    table = owner_table(voxels, owner)
    starts, voxel, points, weights = sorted_table(table, 0, number)
    means, normals, values = plane_frames(points, weights, starts)
    planes = np.column_stack([normals, -np.einsum('ij,ij->i', normals, means)])
    sigma = np.sqrt(np.maximum(values[:, 0], 0.0))
    tolerance = np.minimum(TOLERANCE_SIGMAS * sigma, FAR_SIGMAS * sigma + sizes[1])
    tolerance[curved] = 0.0
    # the patch of a coarse voxel is the one with most of its points
    patch = np.repeat(np.arange(number, dtype=np.int32), np.diff(starts))
    label = np.full(len(voxels.starts) - 1, -1, np.int32)
    order = np.argsort(weights, kind='stable')
    order = order[~curved[patch[order]]]
    label[voxel[order]] = patch[order]
    free = free_surfels(voxels, owner, *sizes)
    grown = np.empty_like(owner)
    extend_patches(voxels, label, (planes[label], tolerance), free, grown)
    rows = np.flatnonzero((owner < 0) & (grown >= 0))
    on = grown[rows]
    near = np.abs(plane_heights(voxels.points[rows], planes[on])) < tolerance[on]
    owner[rows[near]] = on[near]


def add_facets(
    voxels: VoxelPoints,
    owner: Owners,
    number: int,
    sizes: tuple[float, float],
    config: ModelsConfig,
    most_beside: float = math.inf,
) -> Array:
    """
    Grow facets from free points, write their owners, from number on, and return their normals.

    sizes: edge of the voxels and tolerance, m; most_beside: free points beside by those on a facet
    """
    size_m, tolerance_m = sizes
    free = free_surfels(voxels, owner, size_m, tolerance_m)
    rules = (
        tolerance_m,
        FACET_VOXELS,
        max(FACET_POINTS, config.min_surface_points),
        math.cos(math.radians(FACET_ANGLE_DEG)),
        FACET_WIDTH_VOXELS * size_m,
        most_beside,
    )
    planes = np.empty((number + MOST_FACETS, 4))
    state = voxels.points, voxels.starts, voxels.adjacent
    seeds = np.flatnonzero(free[1])
    seeds = seeds[np.argsort(-free[0][seeds], kind='stable')]
    num = find_facets(*state, free, seeds, rules, owner, planes, number)
    return planes[number:num, :3]


def largest_layers(
    voxels: tuple[Array, Owners], charts: Charts, planes: Array, sigma: Array, size_m: float
) -> Array:
    """
    Return the plane (K, 4) of each chart, that of its largest layer if it has several.

    Books thinner than a voxel are in the clusters of their table. Voxels of smaller layers become
    free, in place.

    Parameters
    ----------
    voxels : (V, 3) float64, m, and (V,) int32
        Means of the points by voxel, and indices of their charts.
    charts, planes : Charts, (K, 4) float64
        Charts, and their planes.
    sigma : (K,) float64, m
        Noise across the charts.
    size_m : float
        Edge of the voxels, m.

    """
    means, label = voxels
    thick = np.maximum(SEPARATE_SIGMAS * sigma, SEPARATE_VOXELS * size_m)
    may = ~charts.curved & (3.0 * charts.rms_m > thick)
    rows = np.flatnonzero(np.append(may, False)[label])
    rows = rows[np.argsort(label[rows], kind='stable')]
    points, patch = means[rows], label[rows]
    starts = np.searchsorted(patch, np.arange(len(planes) + 1))
    plane = planes.copy()
    fit_layers(points, starts, np.stack([2.0 * charts.rms_m, thick]), SEPARATE_ROUNDS, plane)
    away = np.abs(plane_heights(points, plane[patch])) / thick[patch]
    on, far = (
        np.bincount(patch[mask], minlength=len(planes)) for mask in (away < 1.0, away > 2.0)
    )
    is_layered = (on >= LEAST_LAYER) & (2 * far > np.diff(starts) - on)
    label[rows[is_layered[patch] & (away >= 1.0)]] = FREE
    return np.where(is_layered[:, None], plane, planes)


def plane_heights(points: Array, planes: Array) -> Array:
    """Return the signed distance (N,) of each point (N, 3) from its plane (N, 4), m."""
    heights: Array = np.einsum('ij,ij->i', points, planes[:, :3]) + planes[:, 3]
    return heights


def noise_across(charts: Charts, noise: tuple[float, float], view: Array) -> Array:
    """Return sigma (K,) across each chart, m, of noise n0 + n2 range^2 along the ray."""
    rays = charts.means - view
    range_sq = np.maximum(np.einsum('ij,ij->i', rays, rays), 1e-24)
    cosine = np.abs(np.einsum('ij,ij->i', rays, charts.normals)) / np.sqrt(range_sq)
    result: Array = (noise[0] + noise[1] * range_sq) * np.maximum(cosine, LEAST_COSINE)
    return result


def tolerances(
    voxels: VoxelPoints, label: Owners, tangent: Array, noise: Array, size_m: float
) -> Array:
    """Return the distance (K,) up to which a point lies on each patch, m; noise (K,) across it."""
    number = len(noise)
    rows: Indices = np.arange(0, len(voxels.points), 1 + len(voxels.points) // SAMPLES)
    voxel = np.repeat(np.arange(len(label)), np.diff(voxels.starts))[rows]
    rows, voxel = (array[label[voxel] >= 0] for array in (rows, voxel))
    who, plane = label[voxel], tangent[voxel]
    distance = np.abs(plane_heights(voxels.points[rows], plane))
    scale = 0.5 / max(float(distance.max(initial=0.0)), 1e-12)
    ordered = np.append(np.sort(who + scale * distance), number)  # by patch, then by distance
    starts = np.searchsorted(ordered, np.arange(number + 1))
    counts = np.diff(starts)
    halves = np.stack([np.maximum(counts - 1, 0) // 2, counts // 2])
    medians = (ordered[starts[:-1] + halves].mean(axis=0) - np.arange(number)) / scale
    sigma = np.where(counts > 0, 1.4826 * medians, 0.0)
    own = TOLERANCE_SIGMAS * sigma + TOLERANCE_VOXELS * size_m
    most = np.maximum(MOST_TOLERANCE_VOXELS * size_m, TOLERANCE_SIGMAS * noise)
    result: Array = np.minimum(np.maximum(own, NOISE_SIGMAS * noise), most)
    return result


def free_surfels(
    voxels: VoxelPoints, owner: Owners, size_m: float, tolerance_m: float
) -> FreeSurfels:
    """Return number, flatness, mean and normal of the free points of every voxel."""
    thickness = min(FLAT_VOXELS * size_m, 8.0 / TOLERANCE_SIGMAS * tolerance_m)
    number = len(voxels.starts) - 1
    count, flat = np.zeros(number, np.int64), np.zeros(number, np.bool_)
    mean, normal = np.zeros((2, number, 3))
    rules = LEAST_POINTS, thickness**2
    describe_free(voxels.points, voxels.starts, owner, rules, count, flat, mean, normal)
    return count, flat, mean, normal
