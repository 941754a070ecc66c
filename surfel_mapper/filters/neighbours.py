# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Nearest neighbours within a scan, and the filters that drop points with few of them.

The search is scipy's k-d tree. It yields pieces of at most a million neighbours, so that memory
follows the number of points and not its product with the number of neighbours: tensor voting at
its default on 131,072 points would take 160 MB for the coordinates of all neighbours.

Many lidars put every beam without return at (0, 0, 0). No tree can split points at one place, and
a search from each through all of them takes minutes. So of the points at one place only as many
enter the tree as a search returns.

The outlier filters are those of PCL and Open3D. A lidar measures near surfaces more densely than
far ones, so a limit for the whole scan drops far points first; a radius states its limit in m.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FilterError
from surfel_mapper.filters.base import FiniteFilter, Mask, parameter
from surfel_mapper.filters.registry import register
from surfel_mapper.scan import Scan

AT_ONCE = 2**20
"""Neighbours in a piece."""

Points = npt.NDArray[np.float64]
Ids = npt.NDArray[np.int64]


def coordinates(scan: Scan) -> Points:
    """
    Return the points, (N, 3) float64 in C order, m.

    Raises
    ------
    FilterError
        If a coordinate is nan or infinite; filters drop such points before, see FiniteFilter.

    """
    points = np.ascontiguousarray(scan.points, np.float64)
    if not np.isfinite(points).all():
        raise FilterError('a coordinate is nan or infinite; drop such points with filters.finite')
    return points


def search_tree(points: Points) -> Any:
    """Return the search tree of points, (N, 3) finite."""
    from scipy.spatial import cKDTree  # 0.3 s, only for chains that search

    return cKDTree(points)


def neighbourhoods(
    points: Points, number: int, max_distance_m: float = math.inf, epsilon: float = 0.0
) -> Iterator[tuple[slice, Ids, Points]]:
    """
    Yield the nearest neighbours of points, piece by piece, nearest first.

    Parameters
    ----------
    points : (N, 3) float64
        Finite.
    number : int
        Neighbours of each, including the point itself or one at the same place; at most N.
    max_distance_m : float
        Points farther away are no neighbours.
    epsilon : float
        A neighbour may be farther than the true one by this share.

    Yields
    ------
    rows : slice
        The points of the piece.
    ids : (P, number) int64
        Rows of their neighbours; N past the last.
    distances : (P, number) float64, m
        Distances to them; inf past the last.

    """
    if not len(points):
        return
    in_tree = np.append(worth_searching(points, number), len(points))
    tree = search_tree(points[in_tree[:-1]])
    # scipy's bound is exclusive, and its square must not underflow
    bound = max(float(np.nextafter(max_distance_m, math.inf)), 1e-150)
    step = max(AT_ONCE // number, 1)
    for start in range(0, len(points), step):
        rows = slice(start, start + step)
        distances, ids = tree.query(
            points[rows], k=number, eps=epsilon, distance_upper_bound=bound
        )
        yield rows, in_tree[ids.reshape(-1, number)], distances.reshape(-1, number)


def worth_searching(points: Points, number: int) -> Ids:
    """Return the rows of points, at most ``number`` of those at each place."""
    order = np.lexsort(points.T)
    ordered = points[order]
    begins = np.ones(len(points), np.bool_)
    begins[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    starts = np.flatnonzero(begins)
    before = np.arange(len(points)) - np.repeat(starts, np.diff(starts, append=len(points)))
    return np.sort(order[before < number])


INT32_MAX = 2**31 - 1


@register
@dataclass(frozen=True, slots=True, kw_only=True)
class StatisticalOutliers(FiniteFilter):
    """Drop the points whose mean distance to their neighbours is unusually large."""

    num_neighbours: int = parameter(
        20, 'Neighbours of each point, itself not counted.', low=1, high=INT32_MAX
    )
    std_ratio: float = parameter(
        2.0,
        'Largest mean distance that stays: the mean of all plus this times their deviation.',
        low=0.0,
    )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay."""
        points = coordinates(scan)
        number = min(self.num_neighbours + 1, len(points))  # the nearest is the point itself
        if number < 2 or self.std_ratio == math.inf:
            return np.ones(len(points), np.bool_)
        distances = np.empty(len(points))
        for rows, _, around in neighbourhoods(points, number):
            distances[rows] = around[:, 1:].mean(axis=1)
        limit = distances.mean() + self.std_ratio * distances.std(ddof=1)
        return np.asarray(distances <= limit, np.bool_)


@register
@dataclass(frozen=True, slots=True, kw_only=True)
class RadiusOutliers(FiniteFilter):
    """Drop the points with too few others within a radius."""

    radius_m: float = parameter(0.5, 'Radius around a point, m, included.', low=0.0)
    min_neighbours: int = parameter(
        2, 'Least number of other points within it.', low=0, high=INT32_MAX
    )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay."""
        points = coordinates(scan)
        number = self.min_neighbours + 1  # including the point itself
        if number > len(points):
            return np.zeros(len(points), np.bool_)
        if number == 1:
            return np.ones(len(points), np.bool_)
        stays = np.empty(len(points), np.bool_)
        # the farthest of the neighbours asked for decides
        for rows, _, distances in neighbourhoods(points, number, self.radius_m):
            stays[rows] = np.isfinite(distances[:, -1])
        return stays
