# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
From patches of clusters to patches of points: noise, growth, facets, merging.

Recursive bisection finds large patches from one point a voxel, but leaves voxels at edges, on
small faces and at boundaries to Gaussians: at 3 cm three quarters of the objects on a table.
Growth uses all points of each voxel. Patches grow over touching voxels, facets are grown from the
points that are left, coplanar neighbours are merged, and every point goes to the patch that it
lies on.

The tolerance of a patch follows from the distances of its own points, so it needs no model of the
sensor; thresholds of the bisection use the noise that is estimated from blocks of voxels.

One module of 350 lines: growth, facets and merging share the table of patches and its noise.

Source: Besl and Jain 1988 (region growing from seeds); the rest is our own.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.kernels.growth import (
    assign_points,
    classify_free,
    count_contacts,
    find_facets,
    grow_patches,
    sample_distances,
    SLOTS,
)
from surfel_mapper.models.kernels.voxel_points import (
    block_noise,
    find_core,
    neighbour_rows,
    owner_means,
)
from surfel_mapper.models.multi_model import Plane, Surface

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Owners = npt.NDArray[np.int32]

FreeSurfels = tuple[Indices, npt.NDArray[np.bool_], Array, Array]
"""Number, flatness, mean and normal of the free points of every voxel, (V, ...) each."""

CORE_SHARE, CORE_POINTS = 0.12, 8
"""Sparse voxels have a smaller share of the points of their densest neighbour."""

MOST_SPARSE = 0.3
"""If more voxels are sparse, they are outliers; planes alone clip fewer to sparse ones."""

BLOCKS, BLOCK_POINTS = 120, 100
"""Blocks for the estimate of the noise, and points used in each, at most."""

NOISE_BINS, NOISE_QUANTILE = 4, 0.3
"""Bins of range; the quantile is below the median, as edges add to the noise of a block."""

CLIPPING = 2.0
"""Correction of sigma by this times its square in voxels, for 5 to 15 mm at 3 cm within 10 %."""

TOLERANCE_SIGMAS, TOLERANCE_VOXELS, MOST_TOLERANCE_VOXELS = 3.0, 0.03, 0.5
"""Tolerance of a patch: sigmas of its points and a share of a voxel, up to half a voxel."""

SAMPLES = 20_000
"""Points for the tolerances of all patches, about."""

FLAT_VOXELS = 0.6
"""Thickness of a flat voxel, 6 sigma, at most."""

GROWTH_ANGLE_DEG, FACET_ANGLE_DEG = 40.0, 25.0
"""Angle between the normals of a flat voxel and of the patch or facet that may take it."""

FACET_VOXELS, FACET_POINTS, FACET_WIDTH_VOXELS = 3, 30, 0.8
"""Smallest facet."""

MOST_FACETS = 4096

MERGE_ANGLE_DEG, MERGE_GROWTH = 6.0, 1.25
"""Coplanar patches differ by less, and merging them increases the residual by less."""


@dataclass(frozen=True, slots=True, eq=False)
class VoxelPoints:
    """
    The finite points of a cloud by voxel; see models/kernels/voxel_points.py.

    Attributes
    ----------
    points : (P, 3) float32 or float64, m
    rows : (P,) int32
        Row of each in the cloud.
    starts : (V + 1,) int64
        First point of each voxel, and P.
    lattice : tuple
        Keys (V,) int64 of the voxels, bits to y and z, first neighbours (V, 9) int64.

    """

    points: npt.NDArray[np.floating]
    rows: npt.NDArray[np.int32]
    starts: Indices
    lattice: tuple[Indices, int, int, Indices]

    @classmethod
    def of(
        cls,
        points: npt.NDArray[np.floating],
        rows: npt.NDArray[np.int32],
        starts: Indices,
        keys: Indices,
        bits: Indices,
    ) -> VoxelPoints:
        """Find the neighbours; bits (3,) of x, y and z in the keys."""
        first, to_y, to_z = np.empty((len(keys), 9), np.int64), int(bits[0]), int(bits[:2].sum())
        neighbour_rows(keys, to_y, to_z, first)
        return cls(points, rows, starts, (keys, to_y, to_z, first))

    def core(self) -> npt.NDArray[np.bool_]:
        """Return which voxels are not outliers, (V,) bool."""
        core = np.ones(len(self.starts) - 1, np.bool_)
        if len(core):
            find_core(self.starts, *self.lattice, CORE_SHARE, CORE_POINTS, core)
        return core if 1.0 - core.mean() > MOST_SPARSE else np.ones_like(core)

    def by_owner(self, owner: Owners) -> tuple[Array, Owners]:
        """Return the means (M, 3) of the points by voxel and owner, sorted by owner, and those."""
        owners, means = np.empty(len(owner), np.int32), np.empty((len(owner), 3))
        num = owner_means(self.points, self.starts, owner, owners, means)
        order = np.argsort(owners[:num], kind='stable')
        return means[order], owners[order]


def estimate_noise(
    voxels: VoxelPoints, means: Array, core: npt.NDArray[np.bool_], size_m: float, view: Array
) -> tuple[float, float]:
    """
    Return the noise of the points as n0, m, and n2, 1/m: sigma is n0 + n2 range^2.

    A block of three voxels clips noise of more than a third of a voxel; see CLIPPING.
    """
    rows = np.flatnonzero(core)
    seeds = rows[:: max(len(rows) // BLOCKS, 1)]
    sigma: Array = np.empty(len(seeds))
    block_noise(voxels.points, voxels.starts, *voxels.lattice, seeds, BLOCK_POINTS, sigma)
    range_sq, sigma = ((means[seeds] - view) ** 2).sum(axis=1)[sigma >= 0.0], sigma[sigma >= 0.0]
    if not len(sigma):
        return 0.0, 0.0
    bins = NOISE_BINS if len(sigma) >= 10 * NOISE_BINS else 1
    parts = np.array_split(np.argsort(range_sq, kind='stable'), bins)
    x = np.array([np.median(range_sq[part]) for part in parts])
    y = np.array([np.quantile(sigma[part], NOISE_QUANTILE) for part in parts])
    y *= 1.0 + CLIPPING * (y / size_m) ** 2
    return line_above_zero(x, y)


def line_above_zero(x: Array, y: Array) -> tuple[float, float]:
    """Return a and b of a + b x, neither negative, nearest to y relative to y."""
    weight = 1.0 / np.maximum(y, 1e-9)
    design = np.stack([np.ones_like(x), x], axis=1) * weight[:, None]
    best, least = (0.0, 0.0), math.inf
    for used in ([0, 1], [0], [1]):
        part = np.zeros(2)
        part[used] = np.linalg.lstsq(design[:, used], y * weight, rcond=None)[0]
        error = float(((design @ part - y * weight) ** 2).sum())
        if (part >= 0.0).all() and error < least - 1e-12:
            best, least = (float(part[0]), float(part[1])), error
    return best


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
        Normals of the patches, of either sign.

    """

    owner: Owners
    means: Array
    owners: Owners
    normals: Array


def grow(
    voxels: VoxelPoints,
    means: Array,
    label: Owners,
    group: Owners,
    patches: list[Plane],
    size_m: float,
    least_points: int,
) -> Grown:
    """
    Grow patches and facets, and merge those that are coplanar.

    Parameters
    ----------
    voxels : VoxelPoints
        The points.
    means : (V, 3) float64, m
        Their means by voxel.
    label : (V,) int32
        Index of the patch of each voxel, -1 for none.
    group : (V,) int32
        Group of each voxel, for points on no patch.
    patches : list of Plane
        Planes and surfaces.
    size_m : float
        Edge of the voxels, m.
    least_points : int
        Points of a facet.

    """
    tangent = tangents(means, label, patches)
    tolerance = tolerances(voxels, label, tangent, len(patches), size_m)
    median_m = float(np.median(tolerance)) if len(tolerance) else 0.1 * size_m
    owner = np.repeat(label, np.diff(voxels.starts))
    free = free_surfels(voxels, owner, size_m, median_m)
    extend_patches(voxels, label, (tangent, tolerance), free, owner)
    free = free_surfels(voxels, owner, size_m, median_m)
    rules = (
        median_m,
        FACET_VOXELS,
        max(FACET_POINTS, least_points),
        math.cos(math.radians(FACET_ANGLE_DEG)),
        FACET_WIDTH_VOXELS * size_m,
    )
    num = add_facets(voxels, patches, free, rules, owner)
    contacts = np.zeros((num, num), np.int32)
    count_contacts(voxels.starts, voxels.lattice, owner, contacts)
    curved = [k for k, patch in enumerate(patches) if isinstance(patch, Surface)]
    contacts[curved], contacts[:, curved] = 0, 0
    is_free = owner < 0
    owner[is_free] = np.repeat(-1 - group, np.diff(voxels.starts))[is_free]
    pair_means, owners = voxels.by_owner(owner)
    on_patch = owners >= 0
    moments = owner_moments(pair_means[on_patch], owners[on_patch], num)
    root = coplanar(moments, contacts, median_m)
    names, index = np.unique(root, return_inverse=True)
    new: Owners = index.astype(np.int32)
    owner, owners = renamed(owner, new), renamed(owners, new)
    order = np.argsort(owners, kind='stable')
    normals = np.array([plane_of(moments[root == k].sum(axis=0))[0] for k in names])
    return Grown(owner, pair_means[order], owners[order], normals.reshape(-1, 3))


def extend_patches(
    voxels: VoxelPoints,
    label: Owners,
    shape: tuple[Array, Array],
    free: FreeSurfels,
    owner: Owners,
) -> None:
    """Grow patches, given as tangents and tolerances, over touching voxels; write the owners."""
    candidate = np.full((len(label), SLOTS), -1, np.int32)
    planes = np.empty((len(label), SLOTS, 4))
    state = voxels.points, voxels.starts
    flat = free[1], free[3], math.cos(math.radians(GROWTH_ANGLE_DEG))
    grow_patches(*state, voxels.lattice, label, *shape, flat, candidate, planes)
    assign_points(*state, label, *shape, candidate, planes, owner)


def add_facets(
    voxels: VoxelPoints,
    patches: list[Plane],
    free: FreeSurfels,
    rules: tuple[float, ...],
    owner: Owners,
) -> int:
    """Grow facets from free points and write the owners; return the number of all patches."""
    found = np.empty((len(patches) + MOST_FACETS, 4))
    for k, patch in enumerate(patches):
        found[k] = (*patch.normal, patch.offset_m)
    state = voxels.points, voxels.starts, voxels.lattice
    return int(find_facets(*state, free, rules, owner, found, len(patches)))


def renamed(owner: Owners, index: Owners) -> Owners:
    """Return owners with patch k renamed to index[k]."""
    result: Owners = owner.copy()
    result[owner >= 0] = index[owner[owner >= 0]]
    return result


def tangents(means: Array, label: Owners, patches: list[Plane]) -> Array:
    """Return the plane (V, 4) of the patch of each voxel, that of a surface tangential there."""
    planes = np.zeros((len(patches) + 1, 4))  # label -1: the last
    for k, patch in enumerate(patches):
        planes[k] = (*patch.normal, patch.offset_m)
    tangent: Array = planes[label]
    for k, patch in enumerate(patches):
        if isinstance(patch, Surface):
            rows = np.flatnonzero(label == k)
            xy = patch.to_local(means[rows])[:, :2]
            normals = patch.normals(xy)
            tangent[rows, :3] = normals
            tangent[rows, 3] = -np.einsum('ij,ij->i', normals, patch.lifted(xy))
    return tangent


def tolerances(
    voxels: VoxelPoints, label: Owners, tangent: Array, number: int, size_m: float
) -> Array:
    """Return the distance (K,) up to which a point lies on each patch, m."""
    held = int(np.diff(voxels.starts)[label >= 0].sum())
    who, distance = np.empty(held, np.int32), np.empty(held)
    stride = 1 + held // SAMPLES
    num = sample_distances(voxels.points, voxels.starts, label, tangent, stride, who, distance)
    order = np.argsort(who[:num], kind='stable')
    ends = np.searchsorted(who[order], np.arange(1, number))
    sigma = [
        1.4826 * float(np.median(part)) if len(part) else 0.0
        for part in np.split(distance[order], ends)
    ][:number]
    limit = TOLERANCE_SIGMAS * np.array(sigma) + TOLERANCE_VOXELS * size_m
    result: Array = np.minimum(limit, MOST_TOLERANCE_VOXELS * size_m)
    return result


def free_surfels(
    voxels: VoxelPoints, owner: Owners, size_m: float, tolerance_m: float
) -> FreeSurfels:
    """Return number, flatness, mean and normal of the free points of every voxel."""
    number = len(voxels.starts) - 1
    count, flat = np.empty(number, np.int64), np.empty(number, np.bool_)
    mean, normal = np.zeros((number, 3)), np.zeros((number, 3))
    thickness = min(FLAT_VOXELS * size_m, 8.0 / TOLERANCE_SIGMAS * tolerance_m)
    classify_free(voxels.points, voxels.starts, owner, thickness, count, flat, mean, normal)
    return count, flat, mean, normal


def coplanar(moments: Array, contacts: npt.NDArray[np.int32], tolerance_m: float) -> Indices:
    """Return for each patch the one that it is merged with, (K,), from pairs in contact."""
    root = np.arange(len(moments))
    limit = math.cos(math.radians(MERGE_ANGLE_DEG))
    pairs = np.argwhere(np.triu(contacts) > 0)
    pairs = pairs[np.argsort(-moments[pairs, 0].min(axis=1), kind='stable')]
    frames, moments = [plane_of(row) for row in moments], moments.copy()
    for i, j in pairs.tolist():
        a, b = int(root[i]), int(root[j])
        if a == b or abs(frames[a][0] @ frames[b][0]) < limit:
            continue
        together = moments[a] + moments[b]
        plane = plane_of(together)
        apart = max(frames[a][1], frames[b][1], tolerance_m / TOLERANCE_SIGMAS)
        if plane[1] < MERGE_GROWTH * apart:
            keep, gone = (a, b) if moments[a, 0] >= moments[b, 0] else (b, a)
            root[root == gone] = keep
            moments[keep], frames[keep] = together, plane
    return root


def owner_moments(means: Array, owners: Owners, number: int) -> Array:
    """Return 1, x, y, z, xx, xy, xz, yy, yz, zz of the means of each patch, (K, 10)."""
    xyz = means - means[0] if len(means) else means  # squares about a distant origin lose digits
    terms = [np.ones(len(xyz)), *xyz.T]
    terms += [xyz[:, i] * xyz[:, j] for i in range(3) for j in range(i, 3)]
    return np.stack([np.bincount(owners, term, number) for term in terms], axis=1)


def plane_of(moments: Array) -> tuple[Array, float]:
    """Return normal and root mean square distance of the plane of moments (10,)."""
    number = max(float(moments[0]), 1.0)
    mean = moments[1:4] / number
    scatter = moments[[4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(3, 3) / number - np.outer(mean, mean)
    values, vectors = np.linalg.eigh(scatter)
    return vectors[:, 0], math.sqrt(max(float(values[0]), 0.0))
