# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Join patches that lie on one plane or on one smooth surface.

Noise and curvature break a surface into pieces: a cylinder becomes strips, a wall whose noise
exceeds a voxel becomes layers. Two touching patches are joined if one height field (a plane, a
quadric or a quartic) explains the points of both better than one for each, by the Bayesian
information criterion, which needs no threshold for the noise: two faces of a box are two planes,
two strips of a cylinder one quadric. The pair that gains most is joined first.

Source: Schwarz 1978 (the criterion); the rest is our own.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.frames import plane_frames
from surfel_mapper.models.kernels.joining import touching_patches
from surfel_mapper.models.kernels.region_joining import (
    CHUNK,
    describe_regions,
    join_layers,
    join_smooth,
    Regions,
)

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

LEAST_TOUCH = 2
"""Voxels of a patch that touch another one, at least, as the mean of both."""

LAYER_SHARE = 0.6
"""Least share of the voxels of a layer that touch the larger patch."""

LEAST_COSINE = 0.5
"""Noise is along the ray; at grazing incidence other errors dominate."""

FLOOR_VOXELS = 0.02
"""Residuals are not resolved below this, in voxels: exact surfaces would otherwise never join."""

LEAST_TURN_DEG, LEAST_BEND_VOXELS, LEAST_BEND_SIGMAS = 15.0, 0.25, 1.5
"""
A surface that turns or bends less is a plane: tables sag a little. Sigmas are those of its
patches: far walls seem to bend by steps of disparity.
"""

CURVED_GAIN = 15.0
"""Gain of the criterion by which a curved surface is better than a plane, at least."""

MOST_WORSE, UNRESOLVED_VOXELS = 1.25, 0.2
"""
A plane of several patches has at most MOST_WORSE times their residual, or UNRESOLVED_VOXELS. Joins
are compared near the smaller patch, so a chain of them may be a tree crown.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """
    The means of the points of K patches by voxel, one patch after the other.

    Attributes
    ----------
    starts : (K + 1,) int64
    voxel : (P,) int32
    means : (P, 3) float64, m
    weights : (P,) float64
        Number of points.
    adjacent : tuple
        Neighbours of voxels; see models/kernels/voxel_points.py.
    first : (V + 1,) int64
    owners : (M,) int32
        Owners of the points of each voxel, negative for free ones.

    """

    starts: Indices
    voxel: npt.NDArray[np.int32]
    means: Array
    weights: Array
    adjacent: tuple[Indices, npt.NDArray[np.int32]]
    first: Indices
    owners: npt.NDArray[np.int32]

    def touching(self) -> Indices:
        """Return pairs of touching patches (R, 3): patch, other, voxels of the patch that do."""
        pairs = np.empty((64 * len(self.starts), 3), np.int64)
        state = self.starts, self.voxel, self.adjacent, self.first, self.owners
        num = touching_patches(*state, pairs)
        if num > len(pairs):
            pairs = np.empty((num, 3), np.int64)
            touching_patches(*state, pairs)
        return pairs[:num]


def join_patches(
    pieces: Pieces, view: Array, noise: tuple[float, float], size_m: float
) -> tuple[npt.NDArray[np.int32], Array, npt.NDArray[np.bool_]]:
    """
    Join patches.

    Parameters
    ----------
    pieces : Pieces
        K patches.
    view : (3,) or (K, 3) float64, m
        Position of the sensor, or a place for each patch, that normals face.
    noise : n0 and n2
        Sigma of the points is n0 + n2 range^2, m.
    size_m : float
        Edge of the voxels, m.

    Returns
    -------
    index (K,) int32, normals (J, 3), curved (J,) bool
        The new number of each patch, mean normals, and whether a patch is a curved surface.

    """
    floor, pairs = (FLOOR_VOXELS * size_m) ** 2, pieces.touching()
    regions = single_regions(pieces, view, noise, size_m)
    state = pieces.means, pieces.weights, pieces.starts
    join_layers(layers(pairs, pieces, regions), *state, regions)
    edges, adjacent = touching_regions(pairs, regions.root)
    join_smooth(edges, adjacent, *state, chunk_boxes(pieces.means), floor, regions)
    index, normals, curved, is_worse = described(regions, state, size_m)
    if is_worse.any():
        undone = np.append(is_worse, np.True_)[index]  # the last: patches without points
        regions = separated(regions, single_regions(pieces, view, noise, size_m), undone)
        index, normals, curved, _ = described(regions, state, size_m)
    return index, normals, curved


def separated(regions: Regions, single: Regions, undone: npt.NDArray[np.bool_]) -> Regions:
    """Return regions whose undone patches (K,) are single ones."""
    pairs = zip(single, regions, strict=True)
    return Regions(*(np.where(undone if a.ndim == 1 else undone[:, None], a, b) for a, b in pairs))


def described(
    regions: Regions, state: tuple[Array, Array, Indices], size_m: float
) -> tuple[npt.NDArray[np.int32], Array, npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """
    Return the result of join_patches, and which regions are worse planes than their patches.

    state: means, weights and starts of the pieces
    """
    has_points = regions.rows > 0  # patches without points are in no region
    names = np.flatnonzero(has_points & (regions.root == np.arange(len(has_points))))
    normals, figures = np.empty((len(names), 3)), np.empty((len(names), 4))
    floor = (FLOOR_VOXELS * size_m) ** 2
    limits = CURVED_GAIN, math.radians(LEAST_TURN_DEG), LEAST_BEND_VOXELS * size_m
    context = *state, chunk_boxes(state[0]), floor
    describe_regions(names, context, regions, limits, normals, figures)
    index = np.searchsorted(names, regions.root).astype(np.int32)
    points, every = regions.patch_points, len(names) + 1
    squares = np.bincount(index, points * regions.patch_sigma**2, every)[:-1]
    own = np.sqrt(squares / np.bincount(index, points, every)[:-1])
    gains, turns, bends = (figures[:, :3] > limits).T
    curved = gains & turns & bends & (figures[:, 2] > LEAST_BEND_SIGMAS * own)
    is_worse = figures[:, 3] > np.maximum(MOST_WORSE * own, UNRESOLVED_VOXELS * size_m)
    is_worse &= ~curved & (np.bincount(index, minlength=every)[:-1] > 1)
    return index, normals, curved, is_worse


def single_regions(
    pieces: Pieces, view: Array, noise: tuple[float, float], size_m: float
) -> Regions:
    """Return a region for every patch."""
    number = len(pieces.starts) - 1
    means, normals, values = plane_frames(pieces.means, pieces.weights, pieces.starts)
    towards = view - means
    normals[np.einsum('ij,ij->i', towards, normals) < 0.0] *= -1.0
    counts = np.diff(pieces.starts)
    points = np.zeros(number)
    np.add.at(points, np.repeat(np.arange(number), counts), pieces.weights)
    range_sq = np.maximum(np.einsum('ij,ij->i', towards, towards), 1e-24)
    cosine = np.abs(np.einsum('ij,ij->i', towards, normals)) / np.sqrt(range_sq)
    sigma = (noise[0] + noise[1] * range_sq) * np.maximum(cosine, LEAST_COSINE)
    floor = (FLOOR_VOXELS * size_m) ** 2
    return Regions(
        root=np.arange(number),
        next_patch=np.full(number, -1),
        last=np.arange(number),
        patches=np.ones(number, np.int64),
        rows=counts,
        normal=normals * points[:, None],
        mean=means,
        extent=np.sqrt(3.0 * np.maximum(values[:, 2], 0.0)) + size_m,
        patch_normal=normals,
        patch_points=points,
        patch_sigma=np.maximum(sigma, np.sqrt(np.maximum(values[:, 0], floor))),
    )


def chunk_boxes(points: Array) -> Array:
    """Return the least and greatest coordinates of CHUNK points each, (C, 2, 3) m."""
    if not len(points):
        return np.empty((0, 2, 3))
    starts = np.arange(0, len(points), CHUNK)
    ends = [end.reduceat(points, starts) for end in (np.minimum, np.maximum)]
    return np.stack(ends, axis=1)


def layers(pairs: Indices, pieces: Pieces, regions: Regions) -> Indices:
    """Return patches (R, 2) that may be layers of larger ones, those of the largest first."""
    a, b, touch = pairs.T
    points = regions.patch_points
    is_layer = (touch >= LAYER_SHARE * np.diff(pieces.starts)[a]) & (points[a] < points[b])
    chosen = pairs[is_layer, :2]
    return chosen[np.argsort(-points[chosen[:, 1]], kind='stable')]


def touching_regions(pairs: Indices, root: Indices) -> tuple[Indices, tuple[Indices, Indices]]:
    """Return pairs (E, 2) of touching regions, and as first (K + 1,) and others (2 E,)."""
    number = len(root)
    ends = np.sort(root[pairs[:, :2]], axis=1)
    code, edge = np.unique(ends[:, 0] * number + ends[:, 1], return_inverse=True)
    voxels = np.bincount(edge.reshape(-1), pairs[:, 2], len(code))
    edges = np.stack(np.divmod(code, max(number, 1)), axis=1)
    edges = edges[(voxels >= 2 * LEAST_TOUCH) & (edges[:, 0] != edges[:, 1])]
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind='stable')]
    first = np.searchsorted(both[:, 0], np.arange(number + 1))
    return edges, (first, np.ascontiguousarray(both[:, 1]))
