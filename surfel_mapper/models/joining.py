# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Join patches that lie on one plane or on one smooth surface.

Noise and curvature break a surface into pieces: a cylinder becomes strips, a wall whose noise
exceeds a voxel becomes layers. Two touching patches are joined if one height field (a plane
or a quadric) explains the points of both better than one for each, by the Bayesian
information criterion, which needs no threshold for the noise: two faces of a box are two planes,
two strips of a cylinder one quadric. In each round a region joins the larger neighbour with which
it gains most, if that one gains most with it, too, or is much larger.

Source: Schwarz 1978 (the criterion); the rest is our own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.frames import eigen, means_and_scatters
from surfel_mapper.models.kernels.joining import compare_regions, touching_patches

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

LEAST_TOUCH = 2
"""Voxels of a patch that touch another one, at least, as the mean of both."""

LAYER_SHARE, LAYER_SIGMAS = 0.6, 3.0
"""
A layer of a larger patch touches it in this share of its voxels, and is as near in deviations of
the noise.
"""

LARGER = 8.0
"""A region larger by this factor takes all neighbours that gain most with it in a round."""

LEAST_COSINE = 0.5
"""Noise is along the ray; at grazing incidence other errors dominate."""

LEAST_FLOOR_VOXELS, MOST_FLOOR_VOXELS, FLOOR_RANGE = 0.02, 0.1, 3e-3
"""
Residuals are not resolved below the first: exact surfaces would otherwise never join. Nor are they
below noise that grows with range^2, up to the second. It is that of depth cameras, correlated over
tens of centimetres: halves of a table seem to differ by less. The first grows with the voxels in
which patches touch, up to the second and the third, a share of the range: roads are less flat over
metres than walls of rooms.
"""

GAP_WIDTHS = 0.2, 0.5
"""
Half the widths of two patches that are joined across a gap, in voxels, at least. Small patches far
from each other lie on one plane by chance.
"""

LEAST_TURN_DEG, LEAST_BEND_VOXELS, LEAST_BEND_SIGMAS = 15.0, 0.25, 1.5
"""
A surface that turns or bends less is a plane: tables sag a little. Sigmas are those of the sensor:
far walls seem to bend by steps of disparity.
"""

STEEPEST_DEG = 81.0
"""
Slope of a joined surface, at most. A scan has one side of an object, of which a surface may have
all. Wider ones are no height fields.
"""

CURVED_GAIN = 30.0
"""Gain of the criterion by which a curved surface is better than a plane, at least."""

MOST_WORSE, UNRESOLVED_VOXELS = 1.25, 0.2
"""
A plane of several patches has at most MOST_WORSE times their residual, or UNRESOLVED_VOXELS. Joins
are compared near the smaller patch, so a chain of them may be a tree crown. Its patches are joined
again, without joins that make planes worse: one ditch does not divide a road.
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
    edge_m : float
        Edge of these voxels, if there are several means of a patch in one: patches touch across
        gaps. 0 otherwise.

    """

    starts: Indices
    voxel: npt.NDArray[np.int32]
    means: Array
    weights: Array
    adjacent: tuple[Indices, npt.NDArray[np.int32]]
    first: Indices
    owners: npt.NDArray[np.int32]
    edge_m: float = 0.0

    def touching(self) -> Indices:
        """Return pairs of touching patches (R, 3): patch, other, voxels of the patch that do."""
        pairs = np.empty((64 * len(self.starts), 3), np.int64)
        state = self.starts, self.voxel, self.adjacent, self.first, self.owners
        num = touching_patches(*state, pairs)
        if num > len(pairs):
            pairs = np.empty((num, 3), np.int64)
            touching_patches(*state, pairs)
        return pairs[:num]


@dataclass(frozen=True, slots=True, eq=False)
class Regions:
    """
    Patches, or regions that are named by one of theirs, K rows.

    Attributes
    ----------
    rows : (K,) int64
        Numbers of means.
    normals : (K, 3) float64
        Sums of the normals of all points.
    middles : (K, 3) float64, m
    extents : (K,) float64, m
        Half the width, about.

    """

    rows: Indices
    normals: Array
    middles: Array
    extents: Array

    def join(self, small: Indices, large: Indices) -> None:
        """Add regions (n,) to others (n,), in place."""
        weight = np.linalg.norm(self.normals, axis=1)
        sums = weight[:, None] * self.middles
        away = np.linalg.norm(self.middles[small] - self.middles[large], axis=1)
        reach = np.maximum(self.extents[small], 0.5 * (away + self.extents[small]))
        np.maximum.at(self.extents, large, reach)
        for table in (self.rows, self.normals, weight, sums):
            np.add.at(table, large, table[small])
        self.middles[large] = sums[large] / np.maximum(weight[large], 1e-12)[:, None]


def join_patches(
    pieces: Pieces,
    view: Array,
    noise: tuple[float, float],
    size_m: float,
    steepest_deg: float = STEEPEST_DEG,
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
    steepest_deg : float
        Slope of a joined surface, at most.

    Returns
    -------
    index (K,) int32, normals (J, 3), curved (J,) bool
        The new number of each patch, mean normals, and whether a patch is a curved surface.

    """
    single, touching = Comparison.of(pieces, view, noise, size_m), pieces.touching()
    single = replace(single, steepest=math.cos(math.radians(steepest_deg)))
    if pieces.edge_m > size_m:
        widths = np.sort(single.extents[touching[:, :2]] / pieces.edge_m - 1.0, axis=1)
        wide = touching[(widths > GAP_WIDTHS).all(axis=1)]
        root = single.joined(np.arange(len(single.means)), wide, UNRESOLVED_VOXELS * size_m)
        return single.described(root, size_m)[:3]
    root, layered = single.with_layers(touching)
    root = layered.joined(root, touching)
    index, normals, curved, is_worse = layered.described(root, size_m)
    if is_worse.any():
        undone = np.append(is_worse, np.True_)[index]  # the last: patches without points
        root = np.where(undone, np.arange(len(root)), root)
        normals = np.where(undone[:, None], single.normals, layered.normals)
        sigma = np.where(undone, single.sigma, layered.sigma)
        separated = replace(layered, normals=normals, sigma=sigma)
        open_pairs = touching[undone[touching[:, :2]].all(axis=1)]
        root = separated.joined(root, open_pairs, UNRESOLVED_VOXELS * size_m)
        index, normals, curved, _ = separated.described(root, size_m)
    return index, normals, curved


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """
    Patches that are compared with each other.

    Attributes
    ----------
    pieces : Pieces
        Their points.
    num_points : (K,) float64
        Number of these.
    means, covariances, extents : (K, 3), (K, 3, 3), (K,) float64, m
        Moments of their points, and half their width, about.
    normals : (K, 3) float64
        Normals of the patches.
    noise, sigma : (K,) float64, m
        Noise of the sensor across them, and that of their points.
    floor : (K,) float64, m^2
        Square of the residuals that are not resolved.
    steepest : float
        Least cosine of the slope of a joined surface.

    """

    pieces: Pieces
    num_points: Array
    means: Array
    covariances: Array
    extents: Array
    normals: Array
    noise: Array
    sigma: Array
    floor: Array
    steepest: float = 0.0

    @classmethod
    def of(
        cls, pieces: Pieces, view: Array, noise: tuple[float, float], size_m: float
    ) -> Comparison:
        """Describe every patch; the parameters are those of join_patches."""
        number, means, scatters = means_and_scatters(pieces.means, pieces.weights, pieces.starts)
        covariances = scatters / np.maximum(number, 1.0)[:, None, None]
        values, axes = eigen(covariances)
        view_rays, normals = view - means, axes[:, 0].copy()
        normals[np.einsum('ij,ij->i', view_rays, normals) < 0.0] *= -1.0
        range_sq = np.maximum(np.einsum('ij,ij->i', view_rays, view_rays), 1e-24)
        cosine = np.abs(np.einsum('ij,ij->i', view_rays, normals)) / np.sqrt(range_sq)
        cosine = np.maximum(cosine, LEAST_COSINE)
        across = (noise[0] + noise[1] * range_sq) * cosine
        edge_m, most_m = max(pieces.edge_m, size_m), MOST_FLOOR_VOXELS * size_m
        least_m = np.minimum(LEAST_FLOOR_VOXELS * edge_m, FLOOR_RANGE * np.sqrt(range_sq))
        least_m = np.clip(least_m, LEAST_FLOOR_VOXELS * size_m, most_m)
        floor = np.clip(noise[1] * range_sq * cosine, least_m, most_m) ** 2
        extents = np.sqrt(3.0 * values[:, 2]) + edge_m
        sigma = np.maximum(across, np.sqrt(np.maximum(values[:, 0], floor)))
        moments = number, means, covariances, extents
        return cls(pieces, *moments, normals, across, sigma, floor)

    def with_layers(self, touching: Indices) -> tuple[Indices, Comparison]:
        """
        Return for each patch the larger one (K,) of which it is a layer, or itself.

        Noise beyond a voxel is cut into layers. In the second result these have the normals of
        the larger patches, and their distances from them are noise.
        """
        points, (a, b, touch) = self.num_points, touching.T
        is_layer = touch >= LAYER_SHARE * np.diff(self.pieces.starts)[a]
        is_layer &= points[a] < points[b]
        a, b = a[is_layer], b[is_layer]
        normals = self.normals[b]
        height = np.einsum('ij,ij->i', self.means[a] - self.means[b], normals)
        thickness_sq = np.einsum('ij,ijk,ik->i', normals, self.covariances[a], normals)
        away = np.sqrt(height**2 + thickness_sq)
        near = np.flatnonzero(away < LAYER_SIGMAS * self.sigma[b])
        near = near[np.argsort(points[b[near]], kind='stable')]
        root, sigma = np.arange(len(points)), self.sigma.copy()
        root[a[near]] = b[near]  # the last assignment is that of the largest
        np.maximum.at(sigma, a[near], away[near])
        while (root[root] != root).any():
            root = root[root]
        return root, replace(self, normals=self.normals[root], sigma=sigma)

    def regions(self) -> Regions:
        """Return a region for every patch."""
        normals = self.normals * self.num_points[:, None]
        rows = np.diff(self.pieces.starts)
        return Regions(rows, normals, self.means.copy(), self.extents.copy())

    def joined(self, root: Indices, touching: Indices, plane_m: float | None = None) -> Indices:
        """
        Return the region (K,) of each patch, given those of layers and touching patches.

        plane_m: residual of a plane that is not resolved, m; if given, regions stay planes.
        """
        number, regions = len(root), self.regions()
        layer = np.flatnonzero(root != np.arange(number))
        regions.join(layer, root[layer])
        pairs = touching_pairs(root[touching[:, :2]], touching[:, 2], number)
        gains, is_stale = np.zeros(len(pairs)), np.full(number, True)
        while len(pairs):
            open_pairs = np.flatnonzero(is_stale[pairs].any(axis=1))
            gains[open_pairs] = 0.0
            if plane_m is not None:
                open_pairs = open_pairs[~self.worse_planes(pairs[open_pairs], root, plane_m)]
            gains[open_pairs] = self.compared(pairs[open_pairs], root, regions)[:, 0]
            small, large = chosen_joins(pairs, gains, regions.rows)
            if not len(small):
                break
            regions.join(small, large)
            name = np.arange(number)
            name[small] = large
            root, pairs = name[root], np.sort(name[pairs], axis=1)
            is_stale[:] = False
            is_stale[large] = True
            _, row = np.unique(pairs @ [number, 1], return_index=True)
            row = row[pairs[row, 0] != pairs[row, 1]]
            pairs, gains = pairs[row], gains[row]
        return root

    def worse_planes(self, pairs: Indices, root: Indices, plane_m: float) -> npt.NDArray[np.bool_]:
        """Return which pairs (R, 2) of regions fit one plane worse than their patches."""
        homogeneous = np.column_stack([self.means, np.ones(len(root))])
        products = homogeneous[:, :, None] * homogeneous[:, None]
        products[:, :3, :3] += self.covariances
        rows = np.column_stack([products.reshape(-1, 16), (MOST_WORSE * self.sigma) ** 2])
        table = np.zeros((len(root), 17))
        np.add.at(table, root, self.num_points[:, None] * rows)
        both = table[pairs].sum(axis=1)
        both /= both[:, 15:16]
        mean, product = both[:, 3:12:4], both[:, :16].reshape(-1, 4, 4)[:, :3, :3]
        values, _ = eigen(product - mean[:, :, None] * mean[:, None])
        worse: npt.NDArray[np.bool_] = values[:, 0] > np.maximum(both[:, 16], plane_m**2)
        return worse

    def compared(self, pairs: Indices, root: Indices, regions: Regions) -> Array:
        """Return gains of pairs of regions, or descriptions: (R, 4), see compare_regions."""
        pieces, out = self.pieces, np.empty((len(pairs), 4))
        members = np.argsort(root, kind='stable')
        groups = members, np.searchsorted(root[members], np.arange(len(root) + 1))
        points = pieces.starts, pieces.means, pieces.weights, self.normals
        tables = regions.normals, regions.middles, regions.extents, self.sigma
        columns = np.empty((4, len(pieces.means) + 1))
        compare_regions(pairs, groups, points, tables, (self.floor, self.steepest), columns, out)
        return out

    def described(
        self, root: Indices, size_m: float
    ) -> tuple[npt.NDArray[np.int32], Array, npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """Return the result of join_patches, and which regions are worse planes than patches."""
        number = len(root)
        names = np.flatnonzero((np.diff(self.pieces.starts) > 0) & (root == np.arange(number)))
        regions, totals = self.regions(), np.zeros((number, 3))
        np.add.at(totals, root, regions.normals)
        described = replace(regions, normals=totals)
        figures = self.compared(np.stack([names, names], axis=1), root, described)
        index = np.searchsorted(names, root).astype(np.int32)
        points, every = self.num_points, len(names) + 1
        total = np.bincount(index, points, every)[:-1]
        noise, own = (
            np.sqrt(np.bincount(index, points * sigma**2, every)[:-1] / total)
            for sigma in (self.noise, self.sigma)
        )
        limits = CURVED_GAIN, math.radians(LEAST_TURN_DEG), LEAST_BEND_VOXELS * size_m
        gains, turns, bends = (figures[:, :3] > limits).T
        curved = gains & turns & bends & (figures[:, 2] > LEAST_BEND_SIGMAS * noise)
        limit_m = MOST_WORSE * np.sqrt(own**2 + self.floor[names])
        is_worse = figures[:, 3] > np.maximum(limit_m, UNRESOLVED_VOXELS * size_m)
        is_worse &= ~curved & (np.bincount(index, minlength=every)[:-1] > 1)
        normals = totals[names]
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
        return index, normals, curved, is_worse


def touching_pairs(ends: Indices, voxels: Indices, number: int) -> Indices:
    """Return distinct pairs (E, 2) of ends (R, 2) with enough voxels (R,), the lesser first."""
    code, pair = np.unique(np.sort(ends, axis=1) @ [number, 1], return_inverse=True)
    is_enough = np.bincount(pair.reshape(-1), voxels, len(code)) >= 2 * LEAST_TOUCH
    pairs = np.stack(np.divmod(code[is_enough], max(number, 1)), axis=1)
    distinct: Indices = pairs[pairs[:, 0] != pairs[:, 1]]
    return distinct


def chosen_joins(pairs: Indices, gains: Array, rows: Indices) -> tuple[Indices, Indices]:
    """Return regions (n,) and the larger ones (n,) that they join in this round; see LARGER."""
    order = np.argsort(gains, kind='stable')
    ends = pairs[order[gains[order] > 0.0]]
    partner: Indices = np.full(len(rows), -1)
    partner[ends.ravel()] = ends[:, ::-1].ravel()  # the last assignment is that of most gain
    small = np.flatnonzero(partner >= 0)
    large = partner[small]
    is_smaller = (rows[small] < rows[large]) | ((rows[small] == rows[large]) & (small > large))
    is_smaller &= (partner[large] == small) | (LARGER * rows[small] < rows[large])
    small = small[is_smaller]
    joins = np.zeros(len(rows), np.bool_)
    joins[small] = True
    small = small[~joins[partner[small]]]
    return small, partner[small]
