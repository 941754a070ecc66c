# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters that thin a scan: by chance, by count, by rank.

All keep the order of the points. Chance depends on the seed and on the stamp of the scan (see
base.py), so a filter with a seed of -1, which libpointmatcher seeds from the machine, gives the
same points every time here too. Its random sampling stops as soon as it has the number expected,
and so prefers points at the beginning; here every point has the same chance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
import itertools
import math

import numpy as np

from surfel_mapper.filters.base import Filter, generator, Mask, select
from surfel_mapper.filters.columns import DENSITIES
from surfel_mapper.filters.parameters import parameter
from surfel_mapper.filters.registry import register
from surfel_mapper.scan import Scan

INT32_MAX = 2**31 - 1


@register(theirs='RandomSamplingDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class RandomSampling(Filter):
    """Keep each point with a probability."""

    probability: float = parameter(
        0.75, 'Chance of a point to stay.', low=0.0, high=1.0, theirs='prob'
    )
    method: int = parameter(
        0, 'Makes no difference here.', low=0, high=1, theirs='randomSamplingMethod'
    )
    seed: int = parameter(-1, 'Of the random numbers.', low=-1, high=INT32_MAX, theirs='seed')

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay."""
        draws = generator(scan, self.seed).random(len(scan))
        return np.asarray(draws < self.probability, np.bool_)


@register(theirs='MaxPointCountDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class MaxPointCount(Filter):
    """Keep so many points, drawn by chance, where there are more."""

    seed: int = parameter(1, 'Of the random numbers.', low=0, high=INT32_MAX, theirs='seed')
    max_points: int = parameter(
        1000, 'At most this many points stay.', low=0, high=INT32_MAX, theirs='maxCount'
    )

    def apply(self, scan: Scan) -> Scan:
        """Return the scan with the points that stay, in their order."""
        if len(scan) <= self.max_points:
            return scan
        draws = generator(scan, self.seed).random(len(scan))
        rows = np.argpartition(draws, self.max_points)[: self.max_points]
        return select(scan, np.sort(rows))


@register(theirs='FixStepSamplingDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class FixStepSampling(Filter):
    """Keep every n-th point, from a random one on; the step n may change from scan to scan."""

    start_step: int = parameter(
        10, 'Step at the first scan.', low=1, high=INT32_MAX, theirs='startStep'
    )
    end_step: int = parameter(
        10, 'Step at which it stops changing.', low=1, high=INT32_MAX, theirs='endStep'
    )
    step_factor: float = parameter(
        1.0, 'The step is multiplied by this after every scan.', low=1e-7, theirs='stepMult'
    )
    seed: int = parameter(0, 'Of the random numbers.', low=0, high=INT32_MAX)
    _calls: Iterator[int] = field(
        default_factory=itertools.count, init=False, repr=False, compare=False
    )

    def step(self, calls: int) -> int:
        """Return the step after so many scans."""
        if calls == 0 or self.step_factor == 1.0:
            return self.start_step
        with np.errstate(over='ignore', under='ignore'):
            step = float(np.float64(self.start_step) * np.float64(self.step_factor) ** calls)
        limit = min if self.step_factor > 1.0 else max
        return int(limit(step, float(self.end_step)))

    def apply(self, scan: Scan) -> Scan:
        """Return the scan with the points that stay; the next scan may have another step."""
        step = self.step(next(self._calls))
        phase = int(generator(scan, self.seed).integers(step))
        return select(scan, np.arange(phase, len(scan), step))


@register(theirs='MaxDensityDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class MaxDensity(Filter):
    """Thin points by chance where they are denser than a limit; needs densities."""

    max_density: float = parameter(
        10.0, 'Density that remains, points per m^3.', low=1e-7, theirs='maxDensity'
    )
    seed: int = parameter(0, 'Of the random numbers.', low=0, high=INT32_MAX)

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay; those whose density is nan do not."""
        densities = self.column(scan, DENSITIES)
        draws = generator(scan, self.seed).random(len(scan))
        return np.asarray(draws * densities < self.max_density, np.bool_)


@register(theirs='MaxQuantileOnAxisDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class MaxQuantileOnAxis(Filter):
    """Keep the points below, or above, a quantile of one coordinate."""

    axis: int = parameter(0, '0, 1, 2: x, y, z.', low=0, high=2, theirs='dim')
    ratio: float = parameter(
        0.5, 'The share of points below the quantile.', low=1e-7, high=0.9999999, theirs='ratio'
    )
    remove_beyond: bool = parameter(
        True, '1: keep what is below; 0: keep what is above.', theirs='removeBeyond'
    )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay; the one at the quantile does not, nor does a nan."""
        values = scan.points[:, self.axis]
        known = values[values == values]
        if not len(known):
            return np.zeros(len(scan), np.bool_)
        rank = math.floor(len(known) * self.ratio)
        quantile = np.partition(known, rank)[rank]
        return np.asarray(values < quantile if self.remove_beyond else values > quantile)
