# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
SpectralDecomposition: make surfaces, curves and corners equally dense each, by tensor voting.

The eigenvalues that votes of unknown neighbours add up to are known for points spread evenly on a
curve, on a surface and in space. A point all of whose eigenvalues are above what its neighbours
would give it if they filled the radius has them nearer than that: its place is too dense, and
chance decides whether it stays. Then all vote again, until hardly any have to go.

Points for which no neighbour is near enough to vote are outliers and are dropped.

Source: Labussiere et al. 2020, Geometry preserving sampling method based on spectral
decomposition for large-scale environments.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from surfel_mapper.filters.base import generator, Mask, select
from surfel_mapper.filters.neighbours import coordinates, Points
from surfel_mapper.filters.parameters import parameter
from surfel_mapper.filters.registry import register
from surfel_mapper.filters.tensor_voting import Votes, Voting, VotingFilter
from surfel_mapper.scan import Scan

EVEN = 5
"""Fewer points to go in a round mean that the density is even."""


@register(theirs='SpectralDecompositionDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class SpectralDecomposition(VotingFilter):
    """Thin surfaces, curves and corners to an even density, drop outliers, add saliencies."""

    radius_m: float = parameter(
        0.4,
        'Within this of a point, half of it on curves, its neighbours are to be spread, m.',
        low=0.0,
        theirs='radius',
    )
    max_iterations: int = parameter(
        10, 'Rounds of thinning at most.', low=1, high=2**32 - 1, theirs='itMax'
    )
    keep_lambdas: bool = parameter(
        True, 'Add lambda1, lambda2, lambda3, the eigenvalues, descending.', theirs='keepLambdas'
    )
    seed: int = parameter(0, 'Of the random numbers.', low=0, high=2**31 - 1)

    def apply(self, scan: Scan) -> Scan:
        """Return the points that stay, with the columns; nan and infinite points are refused."""
        points, random = coordinates(scan), generator(scan, self.seed)
        rows = np.arange(len(points))
        voting, votes = self.vote(points)
        for _ in range(self.max_iterations):
            if len(rows) <= self.num_neighbours:
                break
            stays = self.stays(votes, random)
            rows = rows[stays]
            if not stays.all():
                voting, votes = self.vote(points[rows])
            if np.count_nonzero(~stays) < EVEN:
                break
        votes = voting.again(votes.tensors)
        voted_for = votes.values[:, 2] > 0.0
        votes = Votes(votes.values[voted_for], votes.vectors[voted_for], votes.num_neighbours)
        names = ('lambda3', 'lambda2', 'lambda1') if self.keep_lambdas else ()
        lambdas = dict(zip(names, votes.values.T, strict=False))
        return self.with_votes(select(scan, rows[voted_for]), votes, **lambdas)

    def vote(self, points: Points) -> tuple[Voting, Votes]:
        """Return the votes where nothing is known of the points."""
        voting = Voting.among(points, self.num_neighbours, self.sigma)
        return voting, voting.balls()

    def stays(self, votes: Votes, random: np.random.Generator) -> Mask:
        """Return which points stay for the next round."""
        lowest, middle, highest = votes.values.T / votes.num_neighbours
        stays = np.ones(len(lowest), np.bool_)
        # by dimension: shares of the decay that eigenvalues are, radius, chance of a dense point
        for dimension, (low, mid, high), radius_m, chance in (
            (3, (5 / 6, 5 / 6, 5 / 6), self.radius_m, 0.2),
            (1, (0.5, 1.0, 1.0), 0.5 * self.radius_m, 0.5),
            (2, (0.75, 0.75, 1.0), self.radius_m, 0.5),
        ):
            decay = mean_decay(dimension, self.sigma, radius_m)
            dense = (lowest >= low * decay) & (middle >= mid * decay) & (highest >= high * decay)
            stays &= ~dense | (random.random(len(stays)) < chance)
        return stays


def mean_decay(dimension: int, sigma: float, radius_m: float) -> float:
    """
    Return the mean of exp(-d^2 / sigma) over a ball about a point.

    Parameters
    ----------
    dimension : int
        1 for a ball on a curve, 2 on a surface, 3 in space.
    sigma : float
        Scale, m^2.
    radius_m : float
        Of the ball.

    """
    t = math.inf if sigma == 0.0 else radius_m / math.sqrt(sigma)
    if not 1e-3 < t < math.inf:  # so near the limits that the formulas lose more than they add
        return 0.0 if t == math.inf else 1.0
    if dimension == 1:
        return math.sqrt(math.pi) * math.erf(t) / (2.0 * t)
    if dimension == 2:
        return -math.expm1(-t * t) / (t * t)
    return 3.0 * (math.sqrt(math.pi) * math.erf(t) - 2.0 * t * math.exp(-t * t)) / (4.0 * t**3)
