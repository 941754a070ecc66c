# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
SurfaceNormal: the normal of every point, and what else its neighbours say.

With fewer points than neighbours asked for, all there are count. Eigenvalues are of the
covariance scatter / (n - 1); libpointmatcher leaves the scatter undivided. Its smoothed normals
shrink where neighbours disagree; here they are of unit length. A normal has no side: its
component of largest magnitude is positive, and orient_normals turns it.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.filters.base import with_columns
from surfel_mapper.filters.columns import DENSITIES, MATCHED_IDS, MEAN_DISTS, NORMALS
from surfel_mapper.filters.neighbours import coordinates, neighbourhoods, Points
from surfel_mapper.filters.parameters import parameter
from surfel_mapper.filters.registry import register
from surfel_mapper.filters.shapes import eigen, Moments, ShapeFilter, unit
from surfel_mapper.scan import Scan


@register(theirs='SurfaceNormalDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceNormal(ShapeFilter):
    """Add the normals of the points, and other columns, from their nearest neighbours."""

    num_neighbours: int = parameter(
        5, 'Neighbours, the point itself among them.', low=3, high=2**31 - 1, theirs='knn'
    )
    max_distance_m: float = parameter(
        math.inf, 'Farther ones do not count, m.', low=0.0, theirs='maxDist'
    )
    epsilon: float = parameter(
        0.0, 'Neighbours may be farther than the nearest by this share.', low=0.0, theirs='epsilon'
    )
    keep_densities: bool = parameter(
        False,
        'Add densities, points per m^3 of the ball about the mean of the neighbours.',
        theirs='keepDensities',
    )
    keep_matched_ids: bool = parameter(
        False,
        'Add matchedIds, rows of the neighbours in the scan given, nearest first; -1: none.',
        theirs='keepMatchedIds',
    )
    keep_mean_distances: bool = parameter(
        False,
        'Add meanDists, the distance of the point from the mean of its neighbours, m.',
        theirs='keepMeanDist',
    )
    sort_eigen: bool = parameter(
        False, 'Makes no difference here: eigenvalues always ascend.', theirs='sortEigen'
    )
    smooth_normals: bool = parameter(
        False, 'Average the normals over the neighbours.', theirs='smoothNormals'
    )

    def apply(self, scan: Scan) -> Scan:
        """Return the scan with the columns added; nan and infinite points are refused."""
        points = coordinates(scan)
        number = min(self.num_neighbours, len(points))
        ids = np.empty((len(points), number), np.int32) if self.needs_ids else None
        parts = []
        for rows, near, _ in neighbourhoods(points, number, self.max_distance_m, self.epsilon):
            parts.append(Moments.of_neighbours(points, near))
            if ids is not None:
                ids[rows] = np.where(near < len(points), near, -1)
        moments = Moments.joined(parts)
        columns: dict[str, npt.NDArray[Any]] = self.shape_columns(*eigen(moments.covariance))
        if self.keep_densities:
            columns[DENSITIES] = moments.density
        if self.keep_mean_distances:
            columns[MEAN_DISTS] = np.linalg.norm(points - moments.mean, axis=1)
        if self.smooth_normals and self.keep_normals and ids is not None:
            columns[NORMALS] = smoothed(columns[NORMALS], ids)
        columns = {name: column.astype(scan.points.dtype) for name, column in columns.items()}
        if self.keep_matched_ids and ids is not None:
            columns[MATCHED_IDS] = ids
        return with_columns(scan, **columns)

    @property
    def needs_ids(self) -> bool:
        """Whether the neighbours are wanted once all are known."""
        return self.keep_matched_ids or self.smooth_normals


def smoothed(normals: Points, ids: npt.NDArray[np.int32]) -> Points:
    """
    Return the mean directions of normals (N, 3) over neighbours (N, K), -1 where there is none.

    A normal and its opposite are one: each neighbour's is turned to the side of the point's own.
    """
    total = np.zeros_like(normals)
    known = np.isfinite(normals[:, 0])
    for column in ids.T:
        counts = (column >= 0) & known[column]
        theirs = np.where(counts[:, None], normals[column], 0.0)
        side = np.einsum('ni,ni->n', theirs, normals)
        total += np.where(side < 0.0, -1.0, 1.0)[:, None] * theirs
    return unit(np.where(known[:, None], total, np.nan))
