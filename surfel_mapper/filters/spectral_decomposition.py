# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
SpectralDecomposition: make surfaces, curves and corners equally dense each, by tensor voting.

Where nothing is known of the neighbours, the eigenvalues that their votes add up to have known
ratios for points spread evenly on a curve, on a surface and in space; the nearest of these is
what a point is taken for. Where the largest is more than neighbours that fill the radius would
make it, they are nearer than that: the place is too dense, and every other point of it, drawn by
chance, goes. Then all vote again, until hardly any have to go. libpointmatcher tests every point
for all three, drops four of five at once, and ends well below the density asked for.

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


RATIOS = np.array([[0.5, 1.0], [0.75, 0.75], [1.0, 1.0]])
"""Of the smallest and the middle eigenvalue to the largest on a curve, a surface, in space."""


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
        with np.errstate(invalid='ignore'):  # nan where there are no votes: then not dense either
            ratios = np.stack([lowest, middle], axis=1) / highest[:, None]
        nearest = ((ratios[:, None] - RATIOS) ** 2).sum(axis=2).argmin(axis=1)
        expected = np.array(
            [
                mean_decay(1, self.sigma, 0.5 * self.radius_m),
                mean_decay(2, self.sigma, self.radius_m),
                mean_decay(3, self.sigma, self.radius_m) * 5.0 / 6.0,
            ]
        )
        is_dense = highest > expected[nearest]
        return np.asarray(~is_dense | (random.random(len(is_dense)) < 0.5))


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
