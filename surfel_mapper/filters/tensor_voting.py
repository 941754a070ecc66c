# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters by tensor voting: whether a point is on a surface, on a curve or at a junction.

Every neighbour casts a vote, a symmetric matrix that is large in the directions in which it sees
no continuation of the point. Of the eigenvalues l1 >= l2 >= l3 of the sum, l1 - l2 is the saliency
of a surface (stick, along the normal), l2 - l3 that of a curve (plate, across the tangent) and l3
that of a junction (ball), each over the number of neighbours. libpointmatcher confuses saliencies
and eigenvalues when Saliency labels points; here the label is the largest saliency. Under
libpointmatcher's name a filter votes as libpointmatcher does: in the first round a point votes for
its nearest neighbours, which differ from those that have it among theirs; a vote of the second
round is no symmetric matrix, and only its lower triangle counts.

SpectralDecomposition thins surfaces, curves and junctions to an even density each. If nothing is
known of the neighbours, the eigenvalues of their votes have known ratios for points spread evenly
on a curve, on a surface and in space; the nearest ratio classifies a point. If the largest
eigenvalue exceeds that of neighbours which fill the radius, the place is too dense, and every
other point of it, drawn at random, is dropped. Then all vote again, until hardly any is dropped.
Points with no neighbour near enough to vote are outliers and are dropped. Under libpointmatcher's
name its rules hold: every class has limits of its own, four of five points beyond those of a
junction are dropped at once, and points below a tenth of the range of saliency are outliers.

Source: Labussiere et al. 2020, Geometry preserving sampling method based on spectral
decomposition for large-scale environments.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.filters.base import (
    FiniteFilter,
    generator,
    Mask,
    parameter,
    select,
    with_columns,
)
from surfel_mapper.filters.columns import NORMALS
from surfel_mapper.filters.kernels.tensor_voting import closed_form_votes, first_votes
from surfel_mapper.filters.neighbours import (
    coordinates,
    neighbour_rows,
    Points,
    threads_of_search,
)
from surfel_mapper.filters.registry import register
from surfel_mapper.filters.shapes import eigen, eigen_by_size, PAIRS
from surfel_mapper.scan import Scan

Columns = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """
    Sums of the votes for points, as eigenvalues and eigenvectors.

    Attributes
    ----------
    values : (N, 3) float64
        Ascending; all 0 if no neighbour is near enough.
    vectors : (N, 3, 3) float64
        vectors[:, i] belong to values[:, i]; nan if all values are 0.
    num_neighbours : int
        Number of possible votes for a point.

    """

    values: Points
    vectors: Points
    num_neighbours: int

    @property
    def saliencies(self) -> Points:
        """Saliencies of junction, curve and surface, (N, 3)."""
        low, medium, high = self.values.T
        return np.stack([low, medium - low, high - medium], axis=1) / max(self.num_neighbours, 1)

    @property
    def tensors(self) -> Points:
        """Tensors for another round: sticks and plates, without balls; (N, 6)."""
        _, curve, surface = self.saliencies.T
        _, second, normal = (np.nan_to_num(self.vectors[:, i]).T for i in range(3))
        rows = [
            (surface + curve) * normal[i] * normal[j] + curve * second[i] * second[j]
            for i, j in PAIRS
        ]
        return np.ascontiguousarray(np.stack(rows, axis=1))

    def columns(self, *, normals: bool, labels: bool, tensors: bool) -> Columns:
        """Return the columns, with the names of libpointmatcher."""
        saliencies = self.saliencies
        columns: Columns = dict(
            zip(('pointness', 'curveness', 'surfaceness'), saliencies.T, strict=True)
        )
        tangent, second, normal = (self.vectors[:, i] for i in range(3))
        if normals:
            columns |= {NORMALS: normal, 'tangents': tangent}
        if labels:
            columns['labels'] = 1.0 + saliencies.argmax(axis=1)
        if tensors:
            low, medium, high = self.values.T
            columns['sticks'] = np.column_stack([high - medium, normal])
            columns['plates'] = np.column_stack([medium - low, normal, second])
            columns['balls'] = low
        return columns


@dataclass(frozen=True, slots=True, eq=False)
class Voting:
    """Points and the neighbours that vote for each."""

    points: Points
    ids: npt.NDArray[np.int32]
    sigma: float
    is_symmetric: bool
    """Whether votes are gathered and made symmetric; else as in libpointmatcher."""

    @classmethod
    def among(cls, points: Points, filter_: VotingFilter) -> Voting:
        """Return the voting of the nearest neighbours of each point, with a filter's settings."""
        number = min(filter_.num_neighbours + 1, len(points))  # the nearest is the point itself
        ids = neighbour_rows(points, number, filter_.threads)
        return cls(points, ids, filter_.sigma, filter_.symmetric_votes)

    def first(self) -> Votes:
        """Return the votes of voters without tensors, sparse."""
        votes = np.empty((6, len(self.points)))
        first_votes(self.points, self.ids, self.sigma, not self.is_symmetric, votes)
        return Votes(*eigen(votes), self.ids.shape[1] - 1)

    def balls(self) -> Votes:
        """Return the votes of voters without tensors, in closed form."""
        ball = np.array([float(i == j) for i, j in PAIRS])
        return self.next_round(np.tile(ball, (len(self.points), 1)))

    def next_round(self, tensors: Points) -> Votes:
        """Return the votes of voters with tensors (N, 6)."""
        votes = np.empty((6, len(self.points)))
        closed_form_votes(self.points, self.ids, tensors, self.sigma, self.is_symmetric, votes)
        decompose = eigen if self.is_symmetric else eigen_by_size
        return Votes(*decompose(votes), self.ids.shape[1] - 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class VotingFilter(FiniteFilter):
    """Base of the filters by tensor voting."""

    num_neighbours: int = parameter(
        50, 'Neighbours that vote for each point.', low=6, high=2**32 - 1, libpointmatcher='k'
    )
    sigma: float = parameter(
        0.2,
        'Scale of the votes: exp(-d^2 / sigma) at a distance of d m, none beyond 3 sigma m.',
        low=0.0,
        libpointmatcher='sigma',
    )
    symmetric_votes: bool = parameter(
        True,
        '1: every point takes the symmetric part of the votes of its neighbours; 0: in the first '
        'round a point votes for its neighbours, in the second the lower triangle counts.',
        libpointmatcher_default=False,
    )
    keep_normals: bool = parameter(
        True, 'Add normals, and tangents of curves.', libpointmatcher='keepNormals'
    )
    keep_labels: bool = parameter(
        True, 'Add labels: 3 surface, 2 curve, 1 junction.', libpointmatcher='keepLabels'
    )
    keep_tensors: bool = parameter(
        True,
        'Add sticks, plates and balls: their size and directions.',
        libpointmatcher='keepTensors',
    )
    threads: int = threads_of_search()

    def with_votes(self, scan: Scan, votes: Votes, **more: npt.NDArray[Any]) -> Scan:
        """Return the scan with the selected columns."""
        columns = votes.columns(
            normals=self.keep_normals, labels=self.keep_labels, tensors=self.keep_tensors
        )
        dtype = scan.points.dtype
        return with_columns(
            scan, **{name: column.astype(dtype) for name, column in {**columns, **more}.items()}
        )


@register(libpointmatcher='SaliencyDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class Saliency(VotingFilter):
    """Add surfaceness, curveness and pointness by tensor voting, with normals and labels."""

    def apply_finite(self, scan: Scan) -> Scan:
        """Return the scan with the columns added."""
        voting = Voting.among(coordinates(scan), self)
        return self.with_votes(scan, voting.next_round(voting.first().tensors))


EVEN = 5
"""If fewer points are dropped in a round, the density is even."""


RATIOS = np.array([[0.5, 1.0], [0.75, 0.75], [1.0, 1.0]])
"""Ratios of the smallest and middle eigenvalue to the largest on curves, surfaces, in space."""


CLASSES = (
    (3, (5.0 / 6.0, 5.0 / 6.0, 5.0 / 6.0), 0.2),
    (1, (0.5, 1.0, 1.0), 0.5),
    (2, (0.75, 0.75, 1.0), 0.5),
)
"""libpointmatcher's classes: dimension, limits of the eigenvalues, chance to stay above them."""


@register(libpointmatcher='SpectralDecompositionDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class SpectralDecomposition(VotingFilter):
    """Thin surfaces, curves and corners to an even density, drop outliers, add saliencies."""

    radius_m: float = parameter(
        0.4,
        'Radius that the neighbours of a point should fill, half of it on curves, m.',
        low=0.0,
        libpointmatcher='radius',
    )
    max_iterations: int = parameter(
        10, 'At most this many rounds of thinning.', low=1, high=2**32 - 1, libpointmatcher='itMax'
    )
    keep_lambdas: bool = parameter(
        True,
        'Add lambda1, lambda2, lambda3, the eigenvalues, descending.',
        libpointmatcher='keepLambdas',
    )
    thinning: str = parameter(
        'nearest',
        'nearest: drop half of the points denser than expected for the class nearest to them; '
        'each: for every class in turn, drop a share of the points beyond all of its limits.',
        choices=('nearest', 'each'),
        libpointmatcher_default='each',
    )
    min_saliency: float = parameter(
        0.0,
        'Points whose largest saliency is below this share of its range in the scan are dropped.',
        low=0.0,
        high=1.0,
        libpointmatcher_default=0.1,
    )
    seed: int = parameter(0, 'Seed of the random numbers.', low=0, high=2**31 - 1)

    def apply_finite(self, scan: Scan) -> Scan:
        """Return the points that stay, with the columns."""
        points, random = coordinates(scan), generator(scan, self.seed)
        rows: npt.NDArray[np.int64] = np.arange(len(points))
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
        votes = voting.next_round(votes.tensors)
        salient = self.salient(votes)
        votes = Votes(votes.values[salient], votes.vectors[salient], votes.num_neighbours)
        names = ('lambda3', 'lambda2', 'lambda1') if self.keep_lambdas else ()
        lambdas = dict(zip(names, votes.values.T, strict=False))
        return self.with_votes(select(scan, rows[salient]), votes, **lambdas)

    def vote(self, points: Points) -> tuple[Voting, Votes]:
        """Return the votes of points without tensors."""
        voting = Voting.among(points, self)
        return voting, voting.balls()

    def salient(self, votes: Votes) -> Mask:
        """Return which points have votes and a sufficient saliency."""
        saliencies = votes.saliencies
        has_votes = votes.values[:, 2] > 0.0
        if self.min_saliency == 0.0 or not len(saliencies):
            return np.asarray(has_votes)
        low, high = saliencies.min(axis=0), saliencies.max(axis=0)
        largest = saliencies.argmax(axis=1)
        limits = (low + self.min_saliency * (high - low))[largest]
        return np.asarray(has_votes & (saliencies.max(axis=1) >= limits))

    def stays(self, votes: Votes, random: np.random.Generator) -> Mask:
        """Return which points stay for the next round."""
        if self.thinning == 'each':
            return self.stays_in_each_class(votes, random)
        lowest, medium, highest = votes.values.T / votes.num_neighbours
        with np.errstate(invalid='ignore'):  # nan without votes, then not dense
            ratios = np.stack([lowest, medium], axis=1) / highest[:, None]
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

    def stays_in_each_class(self, votes: Votes, random: np.random.Generator) -> Mask:
        """Return which points stay by libpointmatcher's limits of every class."""
        values = votes.values / votes.num_neighbours
        stays = np.ones(len(values), np.bool_)
        for dimension, shares, chance in CLASSES:
            limits = np.array(shares) * mean_decay(dimension, self.sigma, self.radius_m)
            is_dense = (values >= limits).all(axis=1)
            stays &= ~is_dense | (random.random(len(values)) < chance)
        return stays


def mean_decay(dimension: int, sigma: float, radius_m: float) -> float:
    """
    Return the mean of exp(-d^2 / sigma) over a ball about a point.

    Parameters
    ----------
    dimension : int
        1 on a curve, 2 on a surface, 3 in space.
    sigma : float
        Scale, m^2.
    radius_m : float
        Radius of the ball.

    """
    t = math.inf if sigma == 0.0 else radius_m / math.sqrt(sigma)
    if not 1e-3 < t < math.inf:  # rounding exceeds the difference to the limit
        return 0.0 if t == math.inf else 1.0
    if dimension == 1:
        return math.sqrt(math.pi) * math.erf(t) / (2.0 * t)
    if dimension == 2:
        return -math.expm1(-t * t) / (t * t)
    return 3.0 * (math.sqrt(math.pi) * math.erf(t) - 2.0 * t * math.exp(-t * t)) / (4.0 * t**3)
