# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Patches in voxels of other sizes: growth over points that are left, and joins across gaps.

In finer voxels faces are flat that share a voxel with others. Rings of a lidar and objects in its
way leave gaps in the ground that are wider than a voxel; in voxels of two and more times the size
both sides touch. Planes grow there by the rules of fine voxels. Patches of a map are joined by the
same rules, those of a scan to planes only. Clouds and surfels of a map use growth alike: a surfel
is one point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models.frames import plane_frames
from surfel_mapper.models.growth import (
    add_facets,
    extend_planes,
    owner_table,
    pieces_of,
    sorted_table,
    VoxelPoints,
)
from surfel_mapper.models.joining import join_patches, Pieces
from surfel_mapper.models.kernels.growth import count_beside
from surfel_mapper.models.thinning import thin

Array = npt.NDArray[np.float64]
Owners = npt.NDArray[np.int32]

Shape = tuple[Array, npt.NDArray[np.bool_]]
"""Normals (K, 3) of patches, and whether each is a curved surface (K,)."""

COARSE_TOLERANCE_VOXELS, MOST_FINEST_VOXELS, MOST_RANGE = 0.04, 0.64, 0.01
"""
Tolerance of facets in coarser voxels, at least, and most of that in the finest voxels or as a
share of the median range of the free points: at 50 m a road sags more than near patches.
"""

COARSE_STEEPEST_DEG = 50.0
"""
Slope of a surface that is joined here, at most. A map has all sides of an object, and less steep
surfaces continue each other better. Coarse voxels join the walls of a hall otherwise.
"""

MOST_BESIDE = 0.5
"""Free points beside a facet by those on it, at most; see models/kernels/growth.py."""

SCATTER_SHARE, SCATTER_SIGMAS, LEAST_SCATTER_VOXELS, SCATTER_WIDTH_VOXELS = 0.15, 3.0, 0.45, 0.75
"""
A plane is in scatter, as in a tree crown, if each side of it has more than this share of the
points on it. These are as near as that number of sigmas, at least of voxels. Points are counted
within the last distance of each mean of the plane, in voxels.
"""

SCATTER_SIGMA_VOXELS = 0.04
"""Least sigma of the points on a plane in scatter, in voxels: walls with shelves are thinner."""

SPARSE_SHARE = 0.05
"""Share of points on no patch from which voxels of other sizes help."""


@dataclass(frozen=True, slots=True, eq=False)
class CoarseRules:
    """
    Rules of growth that are the same in voxels of all sizes.

    Attributes
    ----------
    finest_m : float
        Edge of the finest voxels.
    tolerance_m : float
        Distance up to which a point lies on a facet.
    noise : (float, float)
        Sigma of the points is noise[0] + noise[1] range^2, m.
    view : (3,) float64, m, optional
        Position of the sensor, that normals face; if omitted, joined patches face the side of
        their parts.

    """

    finest_m: float
    tolerance_m: float
    noise: tuple[float, float]
    view: Array | None = None


def grow_coarse(
    points: npt.NDArray[Any],
    owner: Owners,
    shape: Shape,
    size_m: float,
    rules: CoarseRules,
    facets: ModelsConfig | None = None,
) -> Shape:
    """
    Grow planes over free points, and return the normals and curvature of all patches.

    Parameters
    ----------
    points : (N, 3) float, m
        Points that are not finite are left out.
    owner : (N,) int32
        Patch of every point, negative for none; changed in place.
    shape : (K, 3) float64, (K,) bool
        Normals of the patches, and which are curved.
    size_m : float
        Edge of the voxels.
    rules : CoarseRules
        The other rules.
    facets : ModelsConfig, optional
        Settings of facets, which are grown from free points if given.

    """
    coarse = thin(points, size_m).by_voxel()
    (normals, curved), old_owner = shape, owner[coarse.rows]
    new_owner = np.maximum(old_owner, -1)
    if size_m > rules.finest_m:
        extend_planes(coarse, new_owner, curved, (size_m, rules.tolerance_m))
    if facets is not None:
        sizes = size_m, facet_tolerance(coarse, new_owner, size_m, rules)
        facet_normals = add_facets(coarse, new_owner, len(normals), sizes, facets, MOST_BESIDE)
        normals = np.concatenate([normals, facet_normals])
        curved = np.append(curved, np.zeros(len(facet_normals), np.bool_))
    owner[coarse.rows] = np.where(new_owner < 0, old_owner, new_owner)
    return normals, curved


def gap_pieces(finest: VoxelPoints, owner: Owners, number: int, size_m: float) -> Pieces:
    """
    Return patches that touch in coarse voxels, with the means of their points in finest voxels.

    Means in coarse voxels determine neither the normal nor the thickness of a small patch.
    """
    owners, means, counts, _ = owner_table(finest, np.maximum(owner, -1))
    coarse = thin(means, size_m).by_voxel()
    table = owners[coarse.rows], coarse.points, counts[coarse.rows], coarse.starts
    touching, _, _, first = owner_table(coarse, table[0])
    pieces = pieces_of(coarse, table, number)
    return replace(pieces, first=first, owners=touching, edge_m=size_m)


def join_coarse(pieces: Pieces, owner: Owners, shape: Shape, rules: CoarseRules) -> Shape:
    """
    Join patches, and return the normals and curvature of the regions.

    Parameters
    ----------
    pieces : Pieces
        The patches.
    owner, shape, rules
        Those of grow_coarse; owner is changed in place.

    """
    (normals, curved), patch = shape, np.maximum(owner, -1)
    view = beyond(pieces, normals) if rules.view is None else rules.view
    index, joined, bent = join_patches(
        pieces, view, rules.noise, rules.finest_m, COARSE_STEEPEST_DEG
    )
    number = np.bincount(patch[patch >= 0], minlength=len(curved))
    if pieces.edge_m > rules.finest_m:
        bent[:] = False
        used = np.flatnonzero(number)
        alone = used[np.bincount(index[used])[index[used]] == 1]
        joined[index[alone]] = normals[alone]  # of a curved patch the mean of its strips
    # a curved patch stays so, unless a larger plane takes it
    total = np.bincount(index, number, len(joined))
    curved = bent | (2.0 * np.bincount(index, number * curved, len(joined)) > total)
    owner[:] = np.where(patch < 0, owner, np.append(index, 0)[patch])
    return joined, curved


def in_scatter(
    voxels: VoxelPoints, owner: Owners, curved: npt.NDArray[np.bool_], size_m: float
) -> npt.NDArray[np.bool_]:
    """Return which patches (K,) are planes through scatter, such as leaves; voxels of size_m."""
    number = len(curved)
    table = owner_table(voxels, owner)
    starts, _, points, weights = sorted_table(table, 0, number)
    _, normals, values = plane_frames(points, weights, starts)
    sigma = np.sqrt(np.maximum(values[:, 0], 0.0))
    tolerance = np.maximum(SCATTER_SIGMAS * sigma, LEAST_SCATTER_VOXELS * size_m)
    sides = np.zeros((number, 3), np.int64)
    width_m = SCATTER_WIDTH_VOXELS * size_m
    state = voxels.points, voxels.starts, voxels.adjacent, (table[0], table[1], table[3])
    count_beside(*state, normals, tolerance, width_m, sides)
    scattered: npt.NDArray[np.bool_] = sides[:, 1:].min(axis=1) > SCATTER_SHARE * sides[:, 0]
    scattered &= ~curved & (sigma > SCATTER_SIGMA_VOXELS * size_m)
    return scattered


def facet_tolerance(
    coarse: VoxelPoints, owner: Owners, size_m: float, rules: CoarseRules
) -> float:
    """Return the distance up to which a free point lies on a facet, m."""
    most_m, free = MOST_FINEST_VOXELS * rules.finest_m, coarse.points[owner < 0]
    if rules.view is not None and len(free):
        range_sq = ((free - rules.view) ** 2).sum(axis=1)
        most_m = max(most_m, MOST_RANGE * math.sqrt(np.median(range_sq)))
    return max(rules.tolerance_m, min(COARSE_TOLERANCE_VOXELS * size_m, most_m))


def beyond(pieces: Pieces, normals: Array) -> Array:
    """Return a viewpoint (K, 3) for each patch, 1 m from its mean along its normal."""
    number = len(normals)
    patch = np.repeat(np.arange(number), np.diff(pieces.starts))
    total = np.bincount(patch, pieces.weights, number)
    sums = [np.bincount(patch, pieces.weights * x, number) for x in pieces.means.T]
    view: Array = np.stack(sums, axis=1) / np.maximum(total, 1.0)[:, None] + normals
    return view
