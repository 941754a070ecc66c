# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Ellipsoids: what the points of small boxes are like in full (libpointmatcher: Elipsoids).

Eigenvalues and covariance are of scatter / (n - 1). Of shapes, planarity comes first, then
cylindricality, then sphericality, and the limit of planarity is on the same number; in
libpointmatcher they are whatever the order of unsorted eigenvalues makes of them.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FilterError
from surfel_mapper.filters.base import Mask
from surfel_mapper.filters.boxes import Boxes, BoxFilter, Columns
from surfel_mapper.filters.parameters import parameter
from surfel_mapper.filters.registry import register
from surfel_mapper.filters.robot import TIME_COLUMNS
from surfel_mapper.filters.shapes import as_matrices, shares
from surfel_mapper.scan import Scan


@register(theirs='ElipsoidsDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class Ellipsoids(BoxFilter):
    """Cut the space into boxes of few points, sample from each, add the ellipsoid of the box."""

    ratio: float = parameter(
        0.5,
        'Share of the points that stay, drawn by chance.',
        low=1e-7,
        high=0.9999999,
        theirs='ratio',
    )
    max_time_window: float = parameter(
        math.inf,
        'Boxes whose points are farther apart in time are dropped; in the unit of their column '
        f'({", ".join(TIME_COLUMNS)}).',
        theirs='maxTimeWindow',
    )
    min_planarity: float = parameter(
        0.0,
        'Boxes less planar are dropped; 1 is a plane, 0 a line or a ball.',
        theirs='minPlanarity',
    )
    keep_means: bool = parameter(False, 'Add means, of the box, m.', theirs='keepMeans')
    keep_covariances: bool = parameter(
        False, 'Add covariance, of the box, 9 numbers, m^2.', theirs='keepCovariances'
    )
    keep_weights: bool = parameter(
        False, 'Add weights, the number of points in the box.', theirs='keepWeights'
    )
    keep_shapes: bool = parameter(
        False, 'Add shapes: planarity, cylindricality, sphericality.', theirs='keepShapes'
    )
    keep_indices: bool = parameter(
        False,
        'Add pointIds, rows of the points of the box in the scan given, -1 past the last, their '
        'pointX, pointY, pointZ, m, and numOfNN, how many they are.',
        theirs='keepIndices',
    )

    def fit(self, scan: Scan, boxes: Boxes) -> Mask:
        """Return which boxes are sampled: small, planar and short enough, (M,) bool."""
        fit = BoxFilter.fit(self, scan, boxes)
        if self.min_planarity > 0.0:
            fit = fit & (shares(boxes.values)[:, 0] >= self.min_planarity)
        if self.max_time_window < math.inf:
            fit = fit & (boxes.spread(times_of(scan)) <= self.max_time_window)
        return fit

    def columns_of(self, boxes: Boxes) -> Columns:
        """Return the columns asked for, a row for each box."""
        columns = BoxFilter.columns_of(self, boxes)
        if self.keep_means:
            columns['means'] = boxes.moments.mean
        if self.keep_covariances:
            columns['covariance'] = as_matrices(boxes.moments.covariance).reshape(-1, 9)
        if self.keep_weights:
            columns['weights'] = boxes.moments.count.astype(np.float64)
        if self.keep_shapes:
            columns['shapes'] = shares(boxes.values)
        if self.keep_indices:
            columns |= members(boxes, min(self.max_points, len(boxes.rows)))
        return columns


def times_of(scan: Scan) -> npt.NDArray[Any]:
    """Return the times of the points as their column has them."""
    for name in TIME_COLUMNS:
        if name in scan.columns:
            times = scan.columns[name]
            return times if times.dtype.kind == 'f' else times.astype(np.int64)
    have = ', '.join(scan.columns) or 'none'
    raise FilterError(
        f'needs the times of the points ({", ".join(TIME_COLUMNS)}); the points have {have}'
    )


def members(boxes: Boxes, most: int) -> Columns:
    """Return the points of each box: pointIds, pointX, pointY, pointZ (M, most), numOfNN (M,)."""
    count = boxes.moments.count
    order = np.argsort(boxes.rows, kind='stable')
    row = boxes.rows[order]
    place = np.arange(len(order)) - (np.cumsum(count) - count)[row]
    ids = np.full((len(boxes), most), -1, np.int32)
    ids[row, place] = order
    columns: Columns = {'pointIds': ids, 'numOfNN': count.astype(np.float64)}
    for name, axis in zip(('pointX', 'pointY', 'pointZ'), boxes.points.T, strict=True):
        columns[name] = np.where(ids >= 0, axis[ids] if len(axis) else 0.0, np.nan)
    return columns
