# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters that thin a scan: at random, by count, by rank, or spread over the directions of normals.

All keep the order of the points and their columns. Random numbers depend on the seed and on the
stamp of the scan (see base.py), so a seed of -1, which libpointmatcher replaces by one from the
machine, gives the same points every time here too. libpointmatcher's random sampling stops when
it has the expected number, and so prefers points at the beginning; here every point has the same
chance.

Sampling by normals constrains a registration well. Points without a normal (nan) are never
chosen unless the scan has no more points than wanted, so that all stay.

Sources: Rusinkiewicz and Levoy 2001, Efficient variants of the ICP algorithm, for NormalSpace;
Gelfand et al. 2003, Geometrically stable sampling for the ICP algorithm, for CovarianceSampling.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
import itertools
import math
from typing import Any

import numpy as np

from surfel_mapper.errors import FilterError
from surfel_mapper.filters.base import Filter, FiniteFilter, generator, Mask, parameter, select
from surfel_mapper.filters.columns import DENSITIES, NORMALS, with_normals
from surfel_mapper.filters.kernels.sampling import choose
from surfel_mapper.filters.neighbours import coordinates, Ids, Points
from surfel_mapper.filters.registry import register
from surfel_mapper.scan import Scan

INT32_MAX = 2**31 - 1


@register(libpointmatcher='RandomSamplingDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class RandomSampling(Filter):
    """Keep each point with a probability."""

    probability: float = parameter(
        0.75, 'Probability that a point stays.', low=0.0, high=1.0, libpointmatcher='prob'
    )
    method: int = parameter(
        0, 'No effect here.', low=0, high=1, libpointmatcher='randomSamplingMethod'
    )
    seed: int = parameter(
        -1, 'Seed of the random numbers.', low=-1, high=INT32_MAX, libpointmatcher='seed'
    )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay."""
        draws = generator(scan, self.seed).random(len(scan))
        return np.asarray(draws < self.probability, np.bool_)


@register(libpointmatcher='MaxPointCountDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class MaxPointCount(Filter):
    """Keep a number of points, drawn at random, if there are more."""

    seed: int = parameter(
        1, 'Seed of the random numbers.', low=0, high=INT32_MAX, libpointmatcher='seed'
    )
    max_points: int = parameter(
        1000, 'At most this many points stay.', low=0, high=INT32_MAX, libpointmatcher='maxCount'
    )

    def apply(self, scan: Scan) -> Scan:
        """Return the points that stay, in their order."""
        if len(scan) <= self.max_points:
            return scan
        draws = generator(scan, self.seed).random(len(scan))
        rows = np.argpartition(draws, self.max_points)[: self.max_points]
        return select(scan, np.sort(rows))


@register(libpointmatcher='FixStepSamplingDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class FixStepSampling(Filter):
    """Keep every n-th point from a random start; the step n may change from scan to scan."""

    start_step: int = parameter(
        10, 'Step at the first scan.', low=1, high=INT32_MAX, libpointmatcher='startStep'
    )
    end_step: int = parameter(
        10, 'Step at which the change ends.', low=1, high=INT32_MAX, libpointmatcher='endStep'
    )
    step_factor: float = parameter(
        1.0,
        'The step is multiplied by this after every scan.',
        low=1e-7,
        libpointmatcher='stepMult',
    )
    seed: int = parameter(0, 'Seed of the random numbers.', low=0, high=INT32_MAX)
    _calls: Iterator[int] = field(
        default_factory=itertools.count, init=False, repr=False, compare=False
    )

    def step(self, calls: int) -> int:
        """Return the step after a number of scans."""
        if calls == 0 or self.step_factor == 1.0:
            return self.start_step
        with np.errstate(over='ignore', under='ignore'):
            step = float(np.float64(self.start_step) * np.float64(self.step_factor) ** calls)
        limit = min if self.step_factor > 1.0 else max
        return int(limit(step, float(self.end_step)))

    def apply(self, scan: Scan) -> Scan:
        """Return the points that stay; the next scan may have another step."""
        step = self.step(next(self._calls))
        phase = int(generator(scan, self.seed).integers(step))
        return select(scan, np.arange(phase, len(scan), step))


@register(libpointmatcher='MaxDensityDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class MaxDensity(Filter):
    """Thin points at random to a largest density; needs densities."""

    max_density: float = parameter(
        10.0, 'Largest density, points per m^3.', low=1e-7, libpointmatcher='maxDensity'
    )
    seed: int = parameter(0, 'Seed of the random numbers.', low=0, high=INT32_MAX)

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay; those of density nan do not."""
        densities = self.column(scan, DENSITIES)
        draws = generator(scan, self.seed).random(len(scan))
        return np.asarray(draws * densities < self.max_density, np.bool_)


@register(libpointmatcher='MaxQuantileOnAxisDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class MaxQuantileOnAxis(Filter):
    """Keep the points below, or above, a quantile of one coordinate."""

    axis: int = parameter(0, '0, 1, 2: x, y, z.', low=0, high=2, libpointmatcher='dim')
    ratio: float = parameter(
        0.5,
        'Share of the points below the quantile.',
        low=1e-7,
        high=0.9999999,
        libpointmatcher='ratio',
    )
    remove_beyond: bool = parameter(
        True, '1: keep the points below it; 0: keep those above.', libpointmatcher='removeBeyond'
    )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay; those at the quantile and nan do not."""
        values = scan.points[:, self.axis]
        valid = values[values == values]
        if not len(valid):
            return np.zeros(len(scan), np.bool_)
        rank = math.floor(len(valid) * self.ratio)
        quantile = np.partition(valid, rank)[rank]
        return np.asarray(values < quantile if self.remove_beyond else values > quantile)


UINT32_MAX = 2**32 - 1

UNHELD = 1e-9
"""Least eigenvalue, as a share of the largest, above rounding: a constrained motion."""


def num_points_parameter() -> Any:
    """Declare the number of points that stay, under the name that libpointmatcher uses."""
    return parameter(
        5000,
        'Number of points that stay.',
        low=1,
        high=UINT32_MAX,
        libpointmatcher='nbSample',
    )


@register(libpointmatcher='NormalSpaceDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class NormalSpace(Filter):
    """Keep a number of points with normals spread over all directions; needs normals."""

    num_points: int = num_points_parameter()
    seed: int = parameter(
        1, 'Seed of the random numbers.', low=0, high=UINT32_MAX, libpointmatcher='seed'
    )
    step_rad: float = parameter(
        0.09817477042,
        'Width of the buckets of directions, rad.',
        low=0.04908738521,
        high=3.14159265359,
        libpointmatcher='epsilon',
    )

    def apply(self, scan: Scan) -> Scan:
        """
        Return the scan with the points chosen.

        In every round one point is drawn from each bucket that has any left; in the last round
        from randomly chosen buckets.
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
        draw = np.arange(len(order)) - starts  # points of its bucket drawn before
        turn = np.argsort(draw + random.random(len(order)))
        return select(scan, np.sort(usable[order[turn[: self.num_points]]]))


def buckets(normals: Points, step_rad: float) -> Ids:
    """
    Return the bucket of every direction, (N,) int64.

    Buckets are bands about z, each divided into sectors of about equal area on the sphere.
    libpointmatcher divides every band into the same number, which makes those about z small.
    """
    lengths = np.sqrt((normals * normals).sum(axis=1))
    cosine = np.divide(normals[:, 2], lengths, out=np.ones_like(lengths), where=lengths > 0.0)
    num_bands = math.ceil(math.pi / step_rad)
    band = np.arccos(np.clip(cosine, -1.0, 1.0)) / step_rad
    band = np.minimum(band.astype(np.int64), num_bands - 1)
    middles = np.minimum((np.arange(num_bands) + 0.5) * step_rad, math.pi)
    num_sectors = np.maximum(np.rint(2.0 * np.pi / step_rad * np.sin(middles)), 1.0)
    turn = np.arctan2(normals[:, 1], normals[:, 0]) / (2.0 * np.pi) % 1.0
    sector = np.minimum(turn * num_sectors[band], num_sectors[band] - 1.0).astype(np.int64)
    first = np.cumsum(num_sectors) - num_sectors
    return np.asarray(first[band] + sector, np.int64)


@register(libpointmatcher='CovarianceSamplingDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class CovarianceSampling(FiniteFilter):
    """Keep a number of points that constrain all six rigid motions; needs normals."""

    num_points: int = num_points_parameter()
    torque_norm: int = parameter(
        1,
        'Length that scales rotations, 0: 1 m; 1: the mean distance of the points from their '
        'mean; 2: the largest.',
        low=0,
        high=2,
        libpointmatcher='torqueNorm',
    )

    def apply_finite(self, scan: Scan) -> Scan:
        """
        Return the scan with the points chosen.

        Point-to-plane distances change with translation along n and rotation along p x n. The
        eigenvectors of the sum of their outer products are motions that the scan constrains,
        strongly or weakly. Each step takes the motion constrained least by the points chosen so
        far and adds the point that constrains it most. Motions that nothing constrains, as along
        a tunnel, are ignored; in libpointmatcher they get all the points.
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
    """Return how each point constrains each motion that the scan constrains, (N, up to 6)."""
    if not len(points):
        return np.empty((0, 6))
    arms = points - points.mean(axis=0)
    distances = np.sqrt((arms * arms).sum(axis=1))
    length = (1.0, distances.mean(), distances.max())[torque_norm]
    turns = np.cross(arms, normals) / (length if length > 0.0 else 1.0)
    forces = np.hstack([turns, normals])
    strengths, motions = np.linalg.eigh(forces.T @ forces)
    return np.asarray(forces @ motions[:, strengths >= UNHELD * strengths[-1]])


def normals_of(filter_: Filter, scan: Scan) -> Points:
    """Return the normals, (N, 3) float64."""
    normals = filter_.column(with_normals(scan), NORMALS)
    if normals.shape != (len(scan), 3):
        raise FilterError(f'{NORMALS}: shape {normals.shape}, expected (N, 3)')
    return normals.astype(np.float64)
