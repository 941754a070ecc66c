# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Nearest neighbours within a scan, and the filters that drop points with few of them.

The search is that of kernels/nearest.py, several times as fast as the k-d trees of scipy, Open3D
and small_gicp because it asks for the neighbours of all points. It yields pieces of some 100,000
neighbours, so that memory follows the number of points and not its product with the number of
neighbours, and pieces can be searched by several threads.

Many lidars put every beam without return at (0, 0, 0). Points at distance 0 end a search like any
others, so a crowd at one place costs no more than other points do.

The outlier filters are those of PCL and Open3D. A lidar measures near surfaces more densely than
far ones, so a limit for the whole scan drops far points first; a radius states its limit in m.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FilterError
from surfel_mapper.filters.base import FiniteFilter, Mask, parameter
from surfel_mapper.filters.kernels.nearest import find_nearest
from surfel_mapper.filters.kernels.search_tree import build_nodes, LEAF, RIGHT
from surfel_mapper.filters.registry import register
from surfel_mapper.scan import Scan
from surfel_mapper.threads import share

AT_ONCE = 2**17
"""Neighbours in a piece: the arrays stay in the cache."""

Points = npt.NDArray[np.float64]
Ids = npt.NDArray[np.int64]
Indices = npt.NDArray[np.int32]

Kind = TypeVar('Kind', bound=np.generic)


class SearchTree(NamedTuple):
    """
    A search tree of points, as the kernels take it; kernels/search_tree.py describes the arrays.

    Results are in the order of the tree, where near points are close in memory; ``by_row`` sorts
    them into the order of the input. Indices count in the order of the tree, rows in the input.
    """

    xyz: Points
    order: Indices
    links: npt.NDArray[np.int32]
    boxes: Points
    leaves: npt.NDArray[np.int32]

    @property
    def points(self) -> tuple[Points, Points, Points]:
        """Coordinates x, y and z of the points, (N,) each, m, in the order of the tree."""
        x, y, z = self.xyz[:, : len(self.order)]
        return x, y, z

    def rows(self, indices: Indices, *, none: int) -> npt.NDArray[np.int32]:
        """Return the row of each index in the order of the tree; ``none`` if it is N."""
        rows = self.order.take(indices, mode='clip')
        rows[indices == len(self.order)] = none
        return rows

    def by_row(self, values: npt.NDArray[Kind]) -> npt.NDArray[Kind]:
        """Return values (N, ...), one of each point, in the order of the input."""
        result = np.empty_like(values)
        result[self.order] = values
        return result


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


def threads_of_search() -> Any:
    """Return the parameter ``threads`` of a filter that searches for neighbours."""
    return parameter(
        1, 'Threads that share the search; the result does not depend on it.', low=1, high=64
    )


def search_tree(points: Points) -> SearchTree:
    """Build the tree of the points (N, 3), which are finite."""
    num_leaves = -(-len(points) // LEAF)
    order, xyz = np.arange(len(points), dtype=np.int32), np.empty((3, num_leaves * LEAF))
    xyz[:, len(points) :] = np.inf
    links, boxes = np.full((3, 2 * num_leaves), -1, np.int32), np.empty((2 * num_leaves, 6))
    if num_leaves:
        build_nodes(points, order, links, boxes, xyz, num_leaves)
    leaves = np.flatnonzero(links[RIGHT, : 2 * num_leaves - 1] < 0).astype(np.int32)
    return SearchTree(xyz, order, links, boxes, leaves)


def visit_neighbours(
    visit: Callable[[slice, Indices, Points], object],
    tree: SearchTree,
    number: int,
    max_distance_m: float = math.inf,
    *,
    ordered: bool = False,
    threads: int = 1,
) -> None:
    """
    Call a function with the nearest neighbours of all points, block by block.

    Parameters
    ----------
    visit : callable
        Called, maybe by several threads at once, with the slice of P points in the order of the
        tree, the indices of their neighbours in that order (P, number) int32, N past the last, and
        the squared distances to them (P, number) float64, m^2, inf past the last. Each point is
        in one block.
    tree : SearchTree
        As search_tree returns it.
    number : int
        Neighbours of each, including the point itself or one at the same place; at most N.
    max_distance_m : float
        Points farther away are no neighbours.
    ordered : bool
        Whether the nearest is first, of equally near ones the one of the lowest row. The order
        is arbitrary otherwise.
    threads : int
        Threads that share the work; the blocks do not depend on it.

    """
    if not len(tree.order):
        return
    # squared for comparisons; the bound is exclusive, and its square must not underflow
    within = max(float(np.nextafter(max_distance_m, math.inf)), 1e-150)
    within_sq = within * within  # infinite if too large, which ** refuses
    num_leaves = len(tree.leaves)
    step = max(AT_ONCE // (number * LEAF), 1)

    def search(chunk: slice) -> None:
        for begin in range(chunk.start * step, min(chunk.stop * step, num_leaves), step):
            block = np.array([begin, min(begin + step, num_leaves)])
            points = slice(begin * LEAF, min((begin + step) * LEAF, len(tree.order)))
            shape = points.stop - points.start, number
            near, squared = np.empty(shape, np.int32), np.empty(shape)
            find_nearest(tuple(tree), block, within_sq, ordered, near, squared)
            visit(points, near, squared)

    share(search, -(-num_leaves // step), threads)


def neighbour_rows(points: Points, number: int, threads: int = 1) -> npt.NDArray[np.int32]:
    """
    Return the rows of the nearest neighbours of all points.

    Parameters
    ----------
    points : (N, 3) float64, m
        Finite.
    number : int
        Neighbours of each, including the point itself; at most N.
    threads : int
        Threads that share the search.

    Returns
    -------
    (N, number) int32
        Nearest first; N where the squared distance is infinite.

    """
    tree = search_tree(points)
    ids = np.empty((len(points), number), np.int32)

    def gather(span: slice, near: Indices, _: Points) -> None:
        ids[tree.order[span]] = tree.rows(near, none=len(points))

    visit_neighbours(gather, tree, number, ordered=True, threads=threads)
    return ids


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
    threads: int = threads_of_search()

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay."""
        points = coordinates(scan)
        number = min(self.num_neighbours + 1, len(points))  # the nearest is the point itself
        if number < 2 or self.std_ratio == math.inf:
            return np.ones(len(points), np.bool_)
        tree = search_tree(points)
        distances = np.empty(len(points))

        def average(span: slice, _: Indices, squared: Points) -> None:
            distances[span] = np.sqrt(squared).sum(axis=1) / (number - 1)  # its own is 0

        visit_neighbours(average, tree, number, threads=self.threads)
        limit = distances.mean() + self.std_ratio * distances.std(ddof=1)
        return tree.by_row(distances <= limit)


@register
@dataclass(frozen=True, slots=True, kw_only=True)
class RadiusOutliers(FiniteFilter):
    """Drop the points with too few others within a radius."""

    radius_m: float = parameter(0.5, 'Radius around a point, m, included.', low=0.0)
    min_neighbours: int = parameter(
        2, 'Least number of other points within it.', low=0, high=INT32_MAX
    )
    threads: int = threads_of_search()

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay."""
        points = coordinates(scan)
        number = self.min_neighbours + 1  # including the point itself
        if number > len(points):
            return np.zeros(len(points), np.bool_)
        if number == 1:
            return np.ones(len(points), np.bool_)
        tree = search_tree(points)
        stays = np.empty(len(points), np.bool_)

        def decide(span: slice, near: Indices, _: Points) -> None:
            stays[span] = near[:, -1] < len(points)  # as many as asked for

        visit_neighbours(decide, tree, number, self.radius_m, threads=self.threads)
        return tree.by_row(stays)
