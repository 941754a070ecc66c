# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The shape of a set of points (mean, covariance, eigenvectors, density), and SurfaceNormal.

Definitions are those of the map: covariance = scatter / (n - 1), eigenvalues ascending, the
normal is the unit eigenvector of the smallest, and the component of largest magnitude of every
eigenvector is positive. If all points are equal, or there is only one, eigenvalues are 0 and
eigenvectors nan; on a line the normal is some direction orthogonal to it.

SurfaceNormal takes the neighbours of every point. If the scan has fewer points than neighbours
asked for, all count. libpointmatcher's smoothed normals shrink if neighbours disagree; here they
have unit length. A normal has no side; orient_normals gives it one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.filters.base import FiniteFilter, parameter, with_columns
from surfel_mapper.filters.columns import (
    DENSITIES,
    EIGEN_VALUES,
    EIGEN_VECTORS,
    MATCHED_IDS,
    MEAN_DISTS,
    NORMALS,
)
from surfel_mapper.filters.descriptors import unit
from surfel_mapper.filters.kernels.shapes import group_moments, neighbour_moments
from surfel_mapper.filters.neighbours import (
    coordinates,
    Ids,
    Indices,
    Points,
    search_tree,
    SearchTree,
    threads_of_search,
    visit_neighbours,
)
from surfel_mapper.filters.registry import register
from surfel_mapper.kernels.symmetric3 import decompose, eigenvectors, smallest_vectors
from surfel_mapper.scan import Scan

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Row and column of each stored element of a symmetric matrix: xx xy xz yy yz zz."""


EIGEN_OF: dict[str, Callable[[npt.NDArray[Any]], npt.NDArray[Any]]] = {
    'covariance': np.ones_like,
    'mean_square': lambda count: np.maximum(count - 1, 1) / count,
    'scatter': lambda count: np.maximum(count - 1, 1),
}
"""Factor on the covariance of a number of points that gives each matrix."""


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """
    Moments of M sets of points.

    Attributes
    ----------
    count : (M,) int64
        Number of points in each.
    mean : (M, 3) float64, m
    covariance : (6, M) float64, m^2
        Rows in the order of PAIRS.
    radius : (M,) float64, m
        Distance from the mean to the farthest point.

    """

    count: npt.NDArray[np.int64]
    mean: Points
    covariance: Points
    radius: Points

    @classmethod
    def of_groups(cls, points: Points, rows: Ids, number: int) -> Moments:
        """Return the moments of groups, from the group of each point; no group is empty."""
        count, mean = np.zeros(number, np.int64), np.zeros((number, 3))
        covariance, radius = np.zeros((6, number)), np.zeros(number)
        group_moments(points, rows, count, mean, covariance, radius)
        return cls(count, mean, covariance, radius)

    @classmethod
    def of_neighbours(cls, tree: SearchTree, near: Indices) -> Moments:
        """Return the moments of neighbours, from their indices (M, K), N past the last."""
        number = len(near)
        count, mean = np.empty(number, np.int64), np.empty((number, 3))
        covariance, radius = np.empty((6, number)), np.empty(number)
        neighbour_moments(*tree.points, near, count, mean, covariance, radius)
        return cls(count, mean, covariance, radius)

    @property
    def density(self) -> Points:
        """Points per m^3 of the ball about the mean; 0 if all are at one place."""
        volume = 4.0 / 3.0 * np.pi * self.radius**3
        density = np.divide(self.count, volume, out=np.zeros(len(volume)), where=volume > 0.0)
        return np.asarray(density, np.float64)


def eigen(matrices: Points, *, smallest_only: bool = False) -> tuple[Points, Points]:
    """
    Return eigenvalues and eigenvectors of symmetric matrices.

    Parameters
    ----------
    matrices : (6, M) float64
        Positive semidefinite, rows in the order of PAIRS.
    smallest_only : bool
        Whether only the vectors of the smallest values are wanted, in a sixth of the time.

    Returns
    -------
    values : (M, 3) float64
        Ascending, none negative.
    vectors : (M, 3, 3) float64, (M, 1, 3) with ``smallest_only``
        vectors[:, i] are of unit length and belong to values[:, i]; nan if all values are 0.

    """
    matrices = np.ascontiguousarray(matrices)
    number = matrices.shape[1]
    values, smallest = np.empty((2, 3, number))
    decompose(matrices, number, values, smallest)
    vectors = np.empty((number, 1 if smallest_only else 3, 3))
    if smallest_only:
        smallest_vectors(values, smallest, vectors)
    else:
        eigenvectors(matrices, values, smallest, vectors)
    return values.T, vectors


def eigen_by_size(matrices: Points) -> tuple[Points, Points]:
    """
    Return eigenvalues and eigenvectors of symmetric matrices that may be indefinite.

    Parameters
    ----------
    matrices : (6, M) float64
        Rows in the order of PAIRS.

    Returns
    -------
    values : (M, 3) float64
        Absolute values, ascending.
    vectors : (M, 3, 3) float64
        As by eigen.

    """
    signed, columns = np.linalg.eigh(as_matrices(matrices))
    order = np.argsort(np.abs(signed), axis=1, kind='stable')
    values = np.take_along_axis(np.abs(signed), order, axis=1)
    vectors = np.take_along_axis(columns.transpose(0, 2, 1), order[:, :, None], axis=1)
    leading = np.abs(vectors).argmax(axis=2)[:, :, None]
    vectors = vectors * np.where(np.take_along_axis(vectors, leading, axis=2) < 0.0, -1.0, 1.0)
    vectors[values[:, 2] == 0.0] = np.nan
    return values, vectors


def as_matrices(rows: Points) -> Points:
    """Return symmetric matrices (M, 3, 3) from their rows in the order of PAIRS, (6, M)."""
    return np.asarray(rows[[0, 1, 2, 1, 3, 4, 2, 4, 5]].T.reshape(-1, 3, 3))


def shares(values: Points) -> Points:
    """
    Return planarity, cylindricality and sphericality from ascending eigenvalues, (M, 3).

    They are 2 (e1 - e0), e2 - e1 and 3 e0 over the sum, and 0 if the sum is 0. Each is in [0, 1],
    and they add up to 1.
    """
    e0, e1, e2 = values.T
    total = e0 + e1 + e2
    terms = np.stack([2.0 * (e1 - e0), e2 - e1, 3.0 * e0], axis=1)
    nonzero = total[:, None] > 0.0
    return np.asarray(np.divide(terms, total[:, None], out=np.zeros_like(terms), where=nonzero))


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeFilter(FiniteFilter):
    """Base of the filters that add normals and eigenvectors."""

    eigen_of: str = parameter(
        'covariance',
        'Matrix of the eigenvalues: covariance, scatter / (n - 1); mean_square, scatter / n; '
        'scatter, the sum over the n points.',
        choices=tuple(EIGEN_OF),
        libpointmatcher_default='mean_square',
    )

    keep_normals: bool = parameter(True, 'Add the column normals.', libpointmatcher='keepNormals')
    keep_eigen_values: bool = parameter(
        False,
        'Add eigValues, of the covariance, ascending, m^2.',
        libpointmatcher='keepEigenValues',
    )
    keep_eigen_vectors: bool = parameter(
        False, 'Add eigVectors, one after another.', libpointmatcher='keepEigenVectors'
    )

    def shape_columns(
        self, values: Points, vectors: Points, count: npt.NDArray[np.int64]
    ) -> dict[str, npt.NDArray[Any]]:
        """Return the selected columns, from eigenpairs of the covariances of count points."""
        columns = {}
        if self.keep_normals:
            columns[NORMALS] = vectors[:, 0]
        if self.keep_eigen_values:
            columns[EIGEN_VALUES] = values * EIGEN_OF[self.eigen_of](count)[:, None]
        if self.keep_eigen_vectors:
            columns[EIGEN_VECTORS] = vectors.reshape(-1, 9)
        return columns


@register(libpointmatcher='SurfaceNormalDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceNormal(ShapeFilter):
    """Add the normals of the points, and other columns, from their nearest neighbours."""

    num_neighbours: int = parameter(
        5,
        'Number of neighbours, including the point itself.',
        low=3,
        high=2**31 - 1,
        libpointmatcher='knn',
    )
    max_distance_m: float = parameter(
        math.inf, 'Largest distance of a neighbour, m.', low=0.0, libpointmatcher='maxDist'
    )
    epsilon: float = parameter(
        0.0,
        'No effect here: the search is exact.',
        low=0.0,
        libpointmatcher='epsilon',
    )
    keep_densities: bool = parameter(
        False,
        'Add densities, points per m^3 of the ball about the mean of the neighbours.',
        libpointmatcher='keepDensities',
    )
    keep_matched_ids: bool = parameter(
        False,
        'Add matchedIds, rows of the neighbours in the scan given, nearest first; -1: none.',
        libpointmatcher='keepMatchedIds',
    )
    keep_mean_distances: bool = parameter(
        False,
        'Add meanDists, the distance of the point from the mean of its neighbours, m.',
        libpointmatcher='keepMeanDist',
    )
    sort_eigen: bool = parameter(
        False, 'No effect here: eigenvalues always ascend.', libpointmatcher='sortEigen'
    )
    smooth_normals: bool = parameter(
        False, 'Average the normals over the neighbours.', libpointmatcher='smoothNormals'
    )
    threads: int = threads_of_search()

    def apply_finite(self, scan: Scan) -> Scan:
        """Return the scan with the columns added."""
        points = coordinates(scan)
        number = min(self.num_neighbours, len(points))
        tree = search_tree(points)
        none = self.describe(tree, slice(0, 0), np.empty((0, 1), np.int32))
        columns: dict[str, npt.NDArray[Any]] = {
            name: np.empty((len(points), *column.shape[1:])) for name, column in none.items()
        }
        ids = np.empty((len(points), number), np.int32) if self.needs_ids else None

        def describe(span: slice, near: Indices, _: Points) -> None:
            for name, column in self.describe(tree, span, near).items():
                columns[name][span] = column
            if ids is not None:
                ids[tree.order[span]] = tree.rows(near, none=-1)

        visit_neighbours(
            describe,
            tree,
            number,
            self.max_distance_m,
            ordered=self.needs_ids,
            threads=self.threads,
        )
        for name in columns:
            columns[name] = tree.by_row(columns[name])
        if self.smooth_normals and self.keep_normals and ids is not None:
            columns[NORMALS] = smoothed(columns[NORMALS], ids)
        columns = {name: column.astype(scan.points.dtype) for name, column in columns.items()}
        if self.keep_matched_ids and ids is not None:
            columns[MATCHED_IDS] = ids
        return with_columns(scan, **columns)

    def describe(
        self, tree: SearchTree, span: slice, near: Indices
    ) -> dict[str, npt.NDArray[Any]]:
        """Return the selected columns of a span of the points, from their neighbours."""
        moments = Moments.of_neighbours(tree, near)
        columns = self.shape_columns(
            *eigen(moments.covariance, smallest_only=not self.keep_eigen_vectors), moments.count
        )
        if self.keep_densities:
            columns[DENSITIES] = moments.density
        if self.keep_mean_distances:
            points = np.stack([values[span] for values in tree.points], axis=1)
            columns[MEAN_DISTS] = np.linalg.norm(points - moments.mean, axis=1)
        return columns

    @property
    def needs_ids(self) -> bool:
        """Whether the neighbours of all points are needed at the end."""
        return self.keep_matched_ids or self.smooth_normals


def smoothed(normals: Points, ids: npt.NDArray[np.int32]) -> Points:
    """
    Return the mean directions of normals (N, 3) over neighbours (N, K), padded by -1.

    A normal and its opposite are equivalent: each is turned to the side of the point's own.
    """
    total = np.zeros_like(normals)
    is_finite = np.isfinite(normals[:, 0])
    for column in ids.T:
        counts = (column >= 0) & is_finite[column]
        neighbours = np.where(counts[:, None], normals[column], 0.0)
        side = np.einsum('ni,ni->n', neighbours, normals)
        total += np.where(side < 0.0, -1.0, 1.0)[:, None] * neighbours
    return unit(np.where(is_finite[:, None], total, np.nan))
