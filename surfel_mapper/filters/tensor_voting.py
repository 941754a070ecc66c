# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Tensor voting: whether a point is on a surface, on a curve or at a corner, by its neighbours.

Every neighbour casts a vote, a symmetric matrix that is large in the directions in which it sees
no continuation of the point. Of the eigenvalues l1 >= l2 >= l3 of the sum, l1 - l2 says how much
of a surface there is (a stick, along the normal), l2 - l3 how much of a curve (a plate, across
the tangent) and l3 how much of neither (a ball). Saliencies are these over the number of
neighbours. libpointmatcher confuses saliencies and eigenvalues where Saliency labels points; here
the label is the largest saliency.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.filters.base import Filter, with_columns
from surfel_mapper.filters.columns import NORMALS
from surfel_mapper.filters.kernels.tensor_voting import closed_form_votes, first_votes
from surfel_mapper.filters.neighbours import coordinates, neighbourhoods, Points
from surfel_mapper.filters.parameters import parameter
from surfel_mapper.filters.registry import register
from surfel_mapper.filters.shapes import eigen, PAIRS
from surfel_mapper.scan import Scan

Columns = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """
    The votes that points have received, as eigenvalues and eigenvectors.

    Attributes
    ----------
    values : (N, 3) float64
        Ascending; all 0 where no neighbour is near enough.
    vectors : (N, 3, 3) float64
        vectors[:, i] belong to values[:, i]; nan where all values are 0.
    num_neighbours : int
        How many could vote.

    """

    values: Points
    vectors: Points
    num_neighbours: int

    @property
    def saliencies(self) -> Points:
        """Of junction, curve and surface, (N, 3)."""
        low, middle, high = self.values.T
        return np.stack([low, middle - low, high - middle], axis=1) / max(self.num_neighbours, 1)

    @property
    def tensors(self) -> Points:
        """What is known of the points for another round: sticks and plates, no balls; (N, 6)."""
        _, curve, surface = self.saliencies.T
        _, second, normal = (np.nan_to_num(self.vectors[:, i]).T for i in range(3))
        rows = [
            (surface + curve) * normal[i] * normal[j] + curve * second[i] * second[j]
            for i, j in PAIRS
        ]
        return np.ascontiguousarray(np.stack(rows, axis=1))

    def columns(self, *, normals: bool, labels: bool, tensors: bool) -> Columns:
        """Return the columns that libpointmatcher names so."""
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
            low, middle, high = self.values.T
            columns['sticks'] = np.column_stack([high - middle, normal])
            columns['plates'] = np.column_stack([middle - low, normal, second])
            columns['balls'] = low
        return columns


@dataclass(frozen=True, slots=True, eq=False)
class Voting:
    """Points and who votes for whom."""

    points: Points
    ids: npt.NDArray[np.int32]
    sigma: float

    @classmethod
    def among(cls, points: Points, num_neighbours: int, sigma: float) -> Voting:
        """Return the voting in which so many nearest neighbours vote for each point."""
        number = min(num_neighbours + 1, len(points))  # the nearest is the point itself
        ids = np.empty((len(points), number), np.int32)
        for rows, near, _ in neighbourhoods(points, number):
            ids[rows] = near
        return cls(points, ids, sigma)

    def first(self) -> Votes:
        """Return the votes where nothing is known of the voters, sparse."""
        votes = np.empty((6, len(self.points)))
        first_votes(self.points, self.ids, self.sigma, votes)
        return self._decomposed(votes)

    def balls(self) -> Votes:
        """Return the votes in closed form where nothing is known of the voters."""
        ball = np.array([float(i == j) for i, j in PAIRS])
        return self.again(np.tile(ball, (len(self.points), 1)))

    def again(self, tensors: Points) -> Votes:
        """Return the votes of voters of which tensors (N, 6) are known."""
        votes = np.empty((6, len(self.points)))
        closed_form_votes(self.points, self.ids, tensors, self.sigma, votes)
        return self._decomposed(votes)

    def _decomposed(self, votes: Points) -> Votes:
        return Votes(*eigen(votes), self.ids.shape[1] - 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class VotingFilter(Filter):
    """Base of the filters by tensor voting."""

    num_neighbours: int = parameter(
        50, 'Neighbours that vote for each point.', low=6, high=2**32 - 1, theirs='k'
    )
    sigma: float = parameter(
        0.2,
        'Scale of the votes: at d m they count exp(-d^2 / sigma), beyond 3 sigma m nothing.',
        low=0.0,
        theirs='sigma',
    )
    keep_normals: bool = parameter(
        True, 'Add normals, and tangents of curves.', theirs='keepNormals'
    )
    keep_labels: bool = parameter(
        True, 'Add labels: 3 surface, 2 curve, 1 junction.', theirs='keepLabels'
    )
    keep_tensors: bool = parameter(
        True, 'Add sticks, plates and balls: their size and directions.', theirs='keepTensors'
    )

    def with_votes(self, scan: Scan, votes: Votes, **more: npt.NDArray[Any]) -> Scan:
        """Return the scan with the columns asked for."""
        columns = votes.columns(
            normals=self.keep_normals, labels=self.keep_labels, tensors=self.keep_tensors
        )
        dtype = scan.points.dtype
        return with_columns(
            scan, **{name: column.astype(dtype) for name, column in {**columns, **more}.items()}
        )


@register(theirs='SaliencyDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class Saliency(VotingFilter):
    """Add surfaceness, curveness and pointness, by tensor voting, and what follows from them."""

    def apply(self, scan: Scan) -> Scan:
        """Return the scan with the columns added; nan and infinite points are refused."""
        voting = Voting.among(coordinates(scan), self.num_neighbours, self.sigma)
        return self.with_votes(scan, voting.again(voting.first().tensors))
