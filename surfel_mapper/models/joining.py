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

from collections import defaultdict
from dataclasses import dataclass
import heapq
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.kernels.joining import (
    height_errors,
    plane_frames,
    TERMS,
    touching_patches,
)
from surfel_mapper.models.kernels.voxel_points import LEAST_COSINE

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

LEAST_TOUCH = 2
"""Voxels of the smaller patch that touch the other one, at least."""

LAYER_SHARE, LAYER_SIGMAS = 0.6, 3.0
"""Share of touching voxels, and distance in deviations of the noise, of a layer of a patch."""

JOIN_ANGLE_DEG = 50.0
"""Largest angle between the normals of joined patches at their means."""

COPLANAR_ANGLE_DEG, COPLANAR_GROWTH = 6.0, 1.25
"""Coplanar patches differ by less, and their common plane fits worse by less."""

CHART_ANGLE_DEG = 50.0
"""Largest angle between the normal of a patch and the mean normal of the surface it joins."""

REACH = 2.0
"""Only points within this many extents of the smaller patch are compared."""

MOST_ROWS = 600
"""Points that are compared, at most; larger patches are subsampled."""

FLOOR_VOXELS = 0.02
"""Residuals are not resolved below this, in voxels: exact surfaces would otherwise never join."""

POINTS_PER_TERM = 3.0
"""A height field needs more points."""

LEAST_TURN_DEG, LEAST_BEND_VOXELS = 15.0, 0.25
"""A surface that turns or bends less is a plane: tables sag a little."""

CURVED_GAIN = 15.0
"""Gain of the criterion by which a curved surface is better than a plane, at least."""


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


@dataclass(slots=True, eq=False)
class JoinedPatches:
    """Patches that are joined, and what is needed to join more."""

    patches: list[int]
    rows: Indices
    normal: Array
    mean: Array
    extent_m: float
    neighbours: set[int]


@dataclass(frozen=True, slots=True, eq=False)
class Heights:
    """Height fields fitted to some points: costs, and how far the quadric is from a plane."""

    cost: float
    plane_cost: float
    plane_rms_m: float
    turn_deg: float
    bend_m: float


def join_patches(
    pieces: Pieces, view: Array, noise: tuple[float, float], size_m: float
) -> tuple[npt.NDArray[np.int32], Array, npt.NDArray[np.bool_]]:
    """
    Join patches.

    Parameters
    ----------
    pieces : Pieces
        K patches.
    view : (3,) float64, m
        Position of the sensor, that normals face.
    noise : n0 and n2
        Sigma of the points is n0 + n2 range^2, m.
    size_m : float
        Edge of the voxels, m.

    Returns
    -------
    index (K,) int32, normals (J, 3), curved (J,) bool
        The new number of each patch, mean normals, and whether a patch is a curved surface.

    """
    joiner = Joiner(pieces, view, noise, size_m)
    joiner.join_layers()
    joiner.join_smooth()
    return joiner.result()


class Joiner:
    """Regions of patches that grow as pairs are joined."""

    def __init__(
        self, pieces: Pieces, view: Array, noise: tuple[float, float], size_m: float
    ) -> None:
        number = len(pieces.starts) - 1
        self.pieces = pieces
        self.floor = (FLOOR_VOXELS * size_m) ** 2
        self.least_bend_m = LEAST_BEND_VOXELS * size_m
        self.means, self.normals, values = np.empty((3, number, 3))
        plane_frames(pieces.means, pieces.weights, pieces.starts, self.means, self.normals, values)
        towards = view - self.means
        away = np.einsum('ij,ij->i', towards, self.normals) < 0.0
        self.normals[away] *= -1.0
        self.counts = np.diff(pieces.starts)
        patch = np.repeat(np.arange(number), self.counts)
        self.points = np.bincount(patch, pieces.weights, number)
        range_sq = np.maximum(np.einsum('ij,ij->i', towards, towards), 1e-24)
        cosine = np.abs(np.einsum('ij,ij->i', towards, self.normals)) / np.sqrt(range_sq)
        self.sigma = (noise[0] + noise[1] * range_sq) * np.maximum(cosine, LEAST_COSINE)
        self.sigma = np.maximum(self.sigma, np.sqrt(np.maximum(values[:, 0], self.floor)))
        self.pairs = pieces.touching()
        self.root = np.arange(number)
        extents = np.sqrt(3.0 * np.maximum(values[:, 2], 0.0)) + size_m
        self.regions = {
            k: JoinedPatches(
                [k],
                np.arange(pieces.starts[k], pieces.starts[k + 1]),
                self.normals[k] * self.points[k],
                self.means[k],
                float(extents[k]),
                set(),
            )
            for k in np.flatnonzero(self.counts).tolist()
        }

    def join_layers(self) -> None:
        """Join patches that lie within the noise of a larger one, in front of or behind it."""
        a, b, touch = self.pairs.T
        is_layer = (touch >= LAYER_SHARE * self.counts[a]) & (self.points[a] < self.points[b])
        order = np.flatnonzero(is_layer)
        order = order[np.argsort(-self.points[b[order]], kind='stable')]
        for small, large in zip(a[order].tolist(), b[order].tolist(), strict=True):
            if self.root[small] != small:
                continue
            large = int(self.root[large])
            rows = self.regions[small].rows
            away = (self.pieces.means[rows] - self.means[large]) @ self.normals[large]
            weights = self.pieces.weights[rows]
            near = math.sqrt(float(weights @ away**2) / float(weights.sum()))
            if near < LAYER_SIGMAS * self.sigma[large]:
                self.normals[self.regions[small].patches] = self.normals[large]
                self.regions[small].normal = self.normals[large] * self.points[small]
                self.join(small, large)

    def join_smooth(self) -> None:
        """Join touching regions, those first that gain most."""
        touch: dict[tuple[int, int], int] = defaultdict(int)
        for a, b, voxels in self.pairs.tolist():
            roots = sorted((int(self.root[a]), int(self.root[b])))
            if roots[0] != roots[1]:
                touch[roots[0], roots[1]] += voxels
        heap: list[tuple[float, int, int, int, int]] = []
        for (a, b), voxels in touch.items():
            if voxels >= 2 * LEAST_TOUCH:
                self.regions[a].neighbours.add(b)
                self.regions[b].neighbours.add(a)
                self.push(heap, a, b)
        while heap:
            _, a, b, size_a, size_b = heapq.heappop(heap)
            if a not in self.regions or b not in self.regions:
                continue
            one, other = self.regions[a], self.regions[b]
            if (len(one.patches), len(other.patches)) != (size_a, size_b):
                continue
            small, large = (a, b) if len(one.rows) < len(other.rows) else (b, a)
            self.join(small, large)
            for c in self.regions[large].neighbours:
                self.push(heap, large, c)

    def join(self, small: int, large: int) -> None:
        """Join two regions; the large one keeps its number."""
        gone, kept = self.regions.pop(small), self.regions[large]
        kept.patches += gone.patches
        self.root[gone.patches] = large
        share = float(np.linalg.norm(gone.normal)) / max(
            float(np.linalg.norm(gone.normal) + np.linalg.norm(kept.normal)), 1e-12
        )
        apart = float(np.linalg.norm(gone.mean - kept.mean))
        kept.extent_m = max(kept.extent_m, gone.extent_m, 0.5 * (apart + gone.extent_m))
        kept.mean = kept.mean + share * (gone.mean - kept.mean)
        kept.normal = kept.normal + gone.normal
        kept.rows = np.concatenate([kept.rows, gone.rows])
        kept.neighbours = (kept.neighbours | gone.neighbours) - {small, large}
        for c in gone.neighbours - {large}:
            self.regions[c].neighbours.discard(small)
            self.regions[c].neighbours.add(large)
        kept.neighbours = {c for c in kept.neighbours if c in self.regions}

    def push(self, heap: list[tuple[float, int, int, int, int]], a: int, b: int) -> None:
        """Queue a pair that gains by being joined."""
        gain = self.gain(self.regions[a], self.regions[b])
        if gain > 0.0:
            sizes = len(self.regions[a].patches), len(self.regions[b].patches)
            heapq.heappush(heap, (-gain, a, b, *sizes))

    def gain(self, one: JoinedPatches, other: JoinedPatches) -> float:
        """Return by how much a common height field is better than two; 0 for none."""
        n1, n2 = unit(one.normal), unit(other.normal)
        if float(n1 @ n2) < math.cos(math.radians(JOIN_ANGLE_DEG)):
            return 0.0
        mean = unit(one.normal + other.normal)
        members = self.normals[one.patches + other.patches] @ mean
        if members.min() < math.cos(math.radians(CHART_ANGLE_DEG)):
            return 0.0
        small = one if one.extent_m < other.extent_m else other
        parts = [self.near(region, small) for region in (one, other)]
        stride = 1 + sum(map(len, parts)) // MOST_ROWS
        parts = [part[::stride] for part in parts]
        if min(map(len, parts)) < 3:
            return 0.0
        a, b = self.heights(parts[0], n1), self.heights(parts[1], n2)
        both = self.heights(np.concatenate(parts), mean)
        gain = a.cost + b.cost - both.cost
        if float(n1 @ n2) > math.cos(math.radians(COPLANAR_ANGLE_DEG)):
            sigma = float(self.sigma[one.patches[:1] + other.patches[:1]].max())
            if both.plane_rms_m < COPLANAR_GROWTH * max(a.plane_rms_m, b.plane_rms_m, sigma):
                gain = max(gain, float(min(map(len, parts))))
        return gain

    def near(self, region: JoinedPatches, small: JoinedPatches) -> Indices:
        """Return the rows of a region near a small one."""
        if region is small or region.extent_m < REACH * small.extent_m:
            return region.rows
        away = self.pieces.means[region.rows] - small.mean
        near = np.einsum('ij,ij->i', away, away) < (REACH * small.extent_m) ** 2
        rows: Indices = region.rows[near]
        return rows

    def heights(self, rows: Indices, normal: Array) -> Heights:
        """Fit height fields to points over a plane."""
        errors = np.empty(3)
        turn = height_errors(self.pieces.means, self.pieces.weights, rows, normal, errors)
        number = len(rows)
        found = [
            number * math.log(error + self.floor) + terms * math.log(number)
            for error, terms in zip(errors.tolist(), TERMS.tolist(), strict=True)
            if terms == 3 or number > POINTS_PER_TERM * terms
        ]
        return Heights(
            cost=min(found),
            plane_cost=found[0],
            plane_rms_m=math.sqrt(errors[0] + self.floor),
            turn_deg=math.degrees(turn),
            bend_m=math.sqrt(12.0 * max(errors[0] - errors[1], 0.0)),
        )

    def result(self) -> tuple[npt.NDArray[np.int32], Array, npt.NDArray[np.bool_]]:
        """Return the new numbers, normals and kinds; see join_patches."""
        names = np.array(sorted(self.regions), np.int64)
        index = np.searchsorted(names, self.root)  # patches without points have no region
        normals, curved = np.empty((len(names), 3)), np.empty(len(names), np.bool_)
        for k, region in enumerate(self.regions[name] for name in names.tolist()):
            normals[k] = unit(region.normal)
            found = self.heights(region.rows[:: 1 + len(region.rows) // MOST_ROWS], normals[k])
            gain = found.plane_cost - found.cost
            bends = found.bend_m > self.least_bend_m and found.turn_deg > LEAST_TURN_DEG
            curved[k] = gain > CURVED_GAIN and bends
        return index.astype(np.int32), normals, curved


def unit(vector: Array) -> Array:
    """Return the unit vector; 0 for 0."""
    result: Array = vector / max(float(np.linalg.norm(vector)), 1e-12)
    return result
