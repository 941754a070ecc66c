# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters that choose points by their normals, so that registration is well constrained.

Both keep the order of the points and all columns. Points without a normal (nan) are never chosen;
where no choice is needed, because the scan has no more points than wanted, they stay.

Sources: Rusinkiewicz and Levoy 2001, Efficient variants of the ICP algorithm; Gelfand et al.
2003, Geometrically stable sampling for the ICP algorithm.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from surfel_mapper.errors import FilterError
from surfel_mapper.filters.base import Filter, generator, select
from surfel_mapper.filters.columns import NORMALS, with_normals
from surfel_mapper.filters.kernels.stable_sampling import choose
from surfel_mapper.filters.neighbours import coordinates, Ids, Points
from surfel_mapper.filters.parameters import parameter
from surfel_mapper.filters.registry import register
from surfel_mapper.scan import Scan

UINT32_MAX = 2**32 - 1

UNHELD = 1e-9
"""Motions held by less than this share of what holds the strongest are held by rounding."""


@register(theirs='NormalSpaceDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class NormalSpace(Filter):
    """Keep so many points that their normals are spread over all directions; needs normals."""

    num_points: int = parameter(
        5000, 'How many stay where there are more.', low=1, high=UINT32_MAX, theirs='nbSample'
    )
    seed: int = parameter(1, 'Of the random numbers.', low=0, high=UINT32_MAX, theirs='seed')
    step_rad: float = parameter(
        0.09817477042,
        'Width of the buckets of directions, rad.',
        low=0.04908738521,
        high=3.14159265359,
        theirs='epsilon',
    )

    def apply(self, scan: Scan) -> Scan:
        """
        Return the scan with the points chosen.

        One point is drawn from every bucket that has any left, again and again; in the last
        round from buckets drawn by chance.
        """
        normals = normals_of(self, scan)
        if len(scan) <= self.num_points:
            return scan
        usable = np.flatnonzero(np.isfinite(normals).all(axis=1))
        random = generator(scan, self.seed)
        usable = random.permutation(usable)
        bucket = buckets(normals[usable], self.step_rad)
        order = np.argsort(bucket, kind='stable')
        starts = np.searchsorted(bucket[order], bucket[order])
        draw = np.arange(len(order)) - starts  # how many of its bucket were drawn before
        turn = np.argsort(draw + random.random(len(order)))
        return select(scan, np.sort(usable[order[turn[: self.num_points]]]))


def buckets(normals: Points, step_rad: float) -> Ids:
    """
    Return the bucket of every direction, (N,) int64.

    Buckets are bands about z, each cut into as many parts as make all about equally large on the
    sphere; libpointmatcher cuts every band into as many, and draws those about z more rarely.
    """
    lengths = np.sqrt((normals * normals).sum(axis=1))
    cosine = np.divide(normals[:, 2], lengths, out=np.ones_like(lengths), where=lengths > 0.0)
    num_bands = math.ceil(math.pi / step_rad)
    band = np.arccos(np.clip(cosine, -1.0, 1.0)) / step_rad
    band = np.minimum(band.astype(np.int64), num_bands - 1)
    middles = np.minimum((np.arange(num_bands) + 0.5) * step_rad, math.pi)
    num_parts = np.maximum(np.rint(2.0 * np.pi / step_rad * np.sin(middles)), 1.0)
    turn = np.arctan2(normals[:, 1], normals[:, 0]) / (2.0 * np.pi) % 1.0
    part = np.minimum(turn * num_parts[band], num_parts[band] - 1.0).astype(np.int64)
    first = np.cumsum(num_parts) - num_parts
    return np.asarray(first[band] + part, np.int64)


@register(theirs='CovarianceSamplingDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class CovarianceSampling(Filter):
    """Keep so many points that hold all six directions of a rigid motion; needs normals."""

    num_points: int = parameter(
        5000, 'How many stay where there are more.', low=1, high=UINT32_MAX, theirs='nbSample'
    )
    torque_norm: int = parameter(
        1,
        'Length that rotations are measured by, 0: 1 m; 1: the mean distance of the points from '
        'their mean; 2: the largest.',
        low=0,
        high=2,
        theirs='torqueNorm',
    )

    def apply(self, scan: Scan) -> Scan:
        """
        Return the scan with the points chosen; nan and infinite points are refused.

        Point to plane distances change with translation along n and rotation along p x n. The
        eigenvectors of the sum of their products are motions that the scan resists, strongly or
        weakly. Again and again the one resisted least by the points chosen so far gets the point
        that resists it most. Motions that nothing resists, as along a tunnel, are left out; in
        libpointmatcher they get all the points.
        """
        normals, points = normals_of(self, scan), coordinates(scan)
        if len(scan) <= self.num_points:
            return scan
        usable = np.flatnonzero(np.isfinite(normals).all(axis=1))
        normals, points = normals[usable], points[usable]
        resists = resistance(points, normals, self.torque_norm)
        by_motion = np.ascontiguousarray(np.argsort(-np.abs(resists), axis=0, kind='stable').T)
        chosen = np.zeros(len(usable), np.bool_)
        choose(np.ascontiguousarray(resists), by_motion, min(self.num_points, len(usable)), chosen)
        return select(scan, usable[chosen])


def resistance(points: Points, normals: Points, torque_norm: int) -> Points:
    """Return how every point resists each motion that the scan resists at all, (N, up to 6)."""
    if not len(points):
        return np.empty((0, 6))
    arms = points - points.mean(axis=0)
    distances = np.sqrt((arms * arms).sum(axis=1))
    length = (1.0, distances.mean(), distances.max())[torque_norm]
    turns = np.cross(arms, normals) / (length if length > 0.0 else 1.0)
    forces = np.hstack([turns, normals])
    strengths, motions = np.linalg.eigh(forces.T @ forces)
    return np.asarray(forces @ motions[:, strengths >= UNHELD * strengths[-1]])


def normals_of(each: Filter, scan: Scan) -> Points:
    """Return the normals, (N, 3) float64."""
    normals = each.column(with_normals(scan), NORMALS)
    if normals.shape != (len(scan), 3):
        raise FilterError(f'{NORMALS}: shape {normals.shape}, expected (N, 3)')
    return normals.astype(np.float64)
