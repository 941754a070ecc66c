# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters that cut the space of a scan into boxes of few points and sample from each.

A box is cut at the median of its points across its longest edge, so that both halves hold the same
number of points within one, and boxes stay as close to cubes as they can.

From each box either points are drawn at random, which keep their columns and take the shape of
their box, or one point is made, the mean.

Ellipsoids (libpointmatcher: Elipsoids) adds the full shape of a box. Of ``shapes``, planarity
comes first, then cylindricality, then sphericality, and the limit of planarity applies to the same
number; in libpointmatcher their values depend on the order of unsorted eigenvalues.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.filters.base import (
    generator,
    Mask,
    parameter,
    select,
    with_columns,
    with_points,
)
from surfel_mapper.filters.columns import DENSITIES
from surfel_mapper.filters.descriptors import TIME_COLUMNS, times_of
from surfel_mapper.filters.kernels.boxes import cut
from surfel_mapper.filters.merging import merged_columns, PointGroups
from surfel_mapper.filters.neighbours import coordinates, Ids, Points
from surfel_mapper.filters.registry import register
from surfel_mapper.filters.shapes import as_matrices, eigen, EIGEN_OF, Moments, ShapeFilter, shares
from surfel_mapper.scan import Scan

INT32_MAX = 2**31 - 1

ON_A_LINE = 4e-7
"""Ratio of the middle eigenvalue to the largest up to which float32 points are on a line."""

Columns = dict[str, npt.NDArray[Any]]


def cut_into_boxes(points: Points, max_points: int) -> tuple[Ids, int]:
    """
    Return the box of every point, (N,) int64, and the number of boxes.

    Parameters
    ----------
    points : (N, 3) float64
        Finite.
    max_points : int
        A box with more points is cut.

    """
    if not len(points):
        return np.empty(0, np.int64), 0
    order, rows = np.arange(len(points)), np.empty(len(points), np.int64)
    return rows, cut(points, max_points, order, rows)


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """
    The boxes of a scan.

    Attributes
    ----------
    points : (N, 3) float64, m
    rows : (N,) int64
        Box of every point.
    moments : Moments
        Moments of each of the M boxes.
    values, vectors : (M, 3) and (M, 3, 3) float64
        Eigenvalues and eigenvectors, see shapes.eigen.

    """

    points: Points
    rows: Ids
    moments: Moments
    values: Points
    vectors: Points

    @classmethod
    def of(cls, scan: Scan, max_points: int) -> Boxes:
        """Return the boxes of a scan."""
        points = coordinates(scan)
        rows, number = cut_into_boxes(points, max_points)
        moments = Moments.of_groups(points, rows, number)
        return cls(points, rows, moments, *eigen(moments.covariance))

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.moments.count)

    def spread(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return largest minus smallest of the values (N,) of the points in each box, (M,)."""
        if not len(values):
            return values
        order = np.argsort(self.rows, kind='stable')
        starts = np.searchsorted(self.rows[order], np.arange(len(self)))
        ordered = values[order]
        return np.asarray(
            np.maximum.reduceat(ordered, starts) - np.minimum.reduceat(ordered, starts)
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxFilter(ShapeFilter):
    """Base of the filters that sample from boxes."""

    ratio: float = parameter(
        0.5,
        'Share of the points that stay, drawn at random.',
        low=1e-7,
        high=1.0,
        libpointmatcher='ratio',
    )
    max_points: int = parameter(
        7, 'A box with more points is cut in two.', low=3, high=INT32_MAX, libpointmatcher='knn'
    )
    sampling_method: int = parameter(
        0,
        '0: draw points at random; 1: one point per box, the mean.',
        low=0,
        high=1,
        libpointmatcher='samplingMethod',
    )
    max_box_m: float = parameter(
        math.inf,
        'Boxes whose points extend farther along an axis are dropped, m.',
        libpointmatcher='maxBoxDim',
    )
    average_columns: bool = parameter(
        True,
        'Columns of a mean, 1: averages; 0: those of the first point.',
        libpointmatcher='averageExistingDescriptors',
    )
    drop_degenerate: bool = parameter(
        False,
        'Drop boxes without a normal: of one or two points, or points on a line.',
        libpointmatcher_default=True,
    )
    keep_densities: bool = parameter(
        False,
        'Add densities, points per m^3 of the ball about the mean of the box.',
        libpointmatcher='keepDensities',
    )
    seed: int = parameter(0, 'Seed of the random numbers.', low=0, high=INT32_MAX)

    def apply_finite(self, scan: Scan) -> Scan:
        """Return the drawn points in their order, or means in the order of their first points."""
        boxes = Boxes.of(scan, self.max_points)
        fit = self.fit(scan, boxes)
        if self.sampling_method == 0:
            drawn = generator(scan, self.seed).random(len(scan)) < self.ratio
            rows = np.flatnonzero(drawn & fit[boxes.rows])
            sampled, chosen = select(scan, rows), boxes.rows[rows]
        else:
            sampled, chosen = self.means(scan, boxes, fit)
        dtype = scan.points.dtype
        columns = {
            name: column[chosen].astype(dtype if column.dtype.kind == 'f' else column.dtype)
            for name, column in self.columns_of(boxes).items()
        }
        return with_columns(sampled, **columns)

    def means(self, scan: Scan, boxes: Boxes, fit: Mask) -> tuple[Scan, Ids]:
        """Return the means of the boxes that fit, and their boxes."""
        first = PointGroups.of(boxes.rows, len(boxes)).first
        chosen = np.flatnonzero(fit)
        chosen = chosen[np.argsort(first[chosen])]
        out_row = np.full(len(boxes), -1)
        out_row[chosen] = np.arange(len(chosen))
        inside = select(scan, fit[boxes.rows])
        groups = PointGroups.of(out_row[boxes.rows[fit[boxes.rows]]], len(chosen))
        columns = merged_columns(inside.columns, groups, average=self.average_columns)
        means = with_points(inside, boxes.moments.mean[chosen], columns)
        return means, chosen

    def fit(self, scan: Scan, boxes: Boxes) -> Mask:
        """Return which boxes are sampled, (M,) bool."""
        fit = np.ones(len(boxes), np.bool_)
        if self.max_box_m < math.inf:
            extents = [boxes.spread(axis) for axis in boxes.points.T]
            fit &= np.max(extents, axis=0) <= self.max_box_m
        if self.drop_degenerate and self.needs_shapes:
            fit &= boxes.values[:, 1] > ON_A_LINE * boxes.values[:, 2]
        return fit

    @property
    def needs_shapes(self) -> bool:
        """Whether a column or limit depends on the eigenvectors of a box."""
        return self.keep_normals or self.keep_eigen_values or self.keep_eigen_vectors

    def columns_of(self, boxes: Boxes) -> Columns:
        """Return the selected columns, one row per box."""
        columns = self.shape_columns(boxes.values, boxes.vectors, boxes.moments.count)
        if self.keep_densities:
            columns[DENSITIES] = boxes.moments.density
        return columns


@register(libpointmatcher='SamplingSurfaceNormalDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class SamplingSurfaceNormal(BoxFilter):
    """Cut the space into boxes of few points, sample from each, add the normal of the box."""


@register(libpointmatcher='ElipsoidsDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class Ellipsoids(BoxFilter):
    """Cut the space into boxes of few points, sample from each, add the ellipsoid of the box."""

    ratio: float = parameter(
        0.5,
        'Share of the points that stay, drawn at random.',
        low=1e-7,
        high=0.9999999,
        libpointmatcher='ratio',
    )
    eigen_of: str = parameter(
        'covariance',
        'Matrix of the eigenvalues and of covariance: covariance, scatter / (n - 1); mean_square, '
        'scatter / n; scatter, the sum over the n points.',
        choices=tuple(EIGEN_OF),
        libpointmatcher_default='scatter',
    )
    max_time_window: float = parameter(
        math.inf,
        'Boxes whose points are farther apart in time are dropped; in the unit of the column '
        f'({", ".join(TIME_COLUMNS)}).',
        libpointmatcher='maxTimeWindow',
    )
    min_planarity: float = parameter(
        0.0,
        'Boxes less planar are dropped; 1 is a plane, 0 a line or a ball.',
        libpointmatcher='minPlanarity',
    )
    keep_means: bool = parameter(False, 'Add means of the box, m.', libpointmatcher='keepMeans')
    keep_covariances: bool = parameter(
        False, 'Add covariance of the box, 9 numbers, m^2.', libpointmatcher='keepCovariances'
    )
    keep_weights: bool = parameter(
        False, 'Add weights, the number of points in the box.', libpointmatcher='keepWeights'
    )
    keep_shapes: bool = parameter(
        False, 'Add shapes: planarity, cylindricality, sphericality.', libpointmatcher='keepShapes'
    )
    keep_indices: bool = parameter(
        False,
        'Add pointIds, rows of the points of the box in the scan given, -1 past the last, their '
        'pointX, pointY, pointZ, m, and numOfNN, their number.',
        libpointmatcher='keepIndices',
    )

    def fit(self, scan: Scan, boxes: Boxes) -> Mask:
        """Return which boxes are sampled: small, planar and brief enough, (M,) bool."""
        fit = BoxFilter.fit(self, scan, boxes)
        if self.min_planarity > 0.0:
            fit = fit & (shares(boxes.values)[:, 0] >= self.min_planarity)
        if self.max_time_window < math.inf:
            fit = fit & (boxes.spread(times_of(scan)) <= self.max_time_window)
        return fit

    @property
    def needs_shapes(self) -> bool:
        """Whether a column or limit depends on the eigenvectors of a box."""
        asked_for = self.keep_covariances or self.keep_shapes or self.min_planarity > 0.0
        return asked_for or BoxFilter.needs_shapes.fget(self)  # type: ignore[attr-defined]

    def columns_of(self, boxes: Boxes) -> Columns:
        """Return the selected columns, one row per box."""
        columns = BoxFilter.columns_of(self, boxes)
        if self.keep_means:
            columns['means'] = boxes.moments.mean
        if self.keep_covariances:
            factor = EIGEN_OF[self.eigen_of](boxes.moments.count)
            matrices = as_matrices(boxes.moments.covariance * factor)
            columns['covariance'] = matrices.reshape(-1, 9)
        if self.keep_weights:
            columns['weights'] = boxes.moments.count.astype(np.float64)
        if self.keep_shapes:
            columns['shapes'] = shares(boxes.values)
        if self.keep_indices:
            columns |= members(boxes, min(self.max_points, len(boxes.rows)))
        return columns


def members(boxes: Boxes, most: int) -> Columns:
    """Return the points of each box: pointIds, pointX, pointY, pointZ (M, most), numOfNN (M,)."""
    count = boxes.moments.count
    order = np.argsort(boxes.rows, kind='stable')
    row = boxes.rows[order]
    column = np.arange(len(order)) - (np.cumsum(count) - count)[row]
    ids = np.full((len(boxes), most), -1, np.int32)
    ids[row, column] = order
    columns: Columns = {'pointIds': ids, 'numOfNN': count.astype(np.float64)}
    for name, axis in zip(('pointX', 'pointY', 'pointZ'), boxes.points.T, strict=True):
        columns[name] = np.where(ids >= 0, axis[ids] if len(axis) else 0.0, np.nan)
    return columns
