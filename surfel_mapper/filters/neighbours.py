# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Nearest neighbours within a scan, for the filters that look around a point.

The search is scipy's k-d tree. Its answer comes in pieces of at most a million neighbours, so
that memory follows the points and not their number times the number of neighbours: the default
of the tensor votes on 131,072 points would take 160 MB for the coordinates of all neighbours.

Many lidars put every beam without return at (0, 0, 0). No tree can part points at one place, and
a search from each through all of them takes minutes; so of those at one place only as many as
anyone asks for go into the tree.
"""

from __future__ import annotations

from collections.abc import Iterator
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FilterError
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
        If a coordinate is nan or infinite: such a point is nobody's neighbour.

    """
    points = np.ascontiguousarray(scan.points, np.float64)
    if not np.isfinite(points).all():
        raise FilterError(
            'a coordinate is nan or infinite; put remove_nan or a box or range before it'
        )
    return points


def search_tree(points: Points) -> Any:
    """Return the search tree of points, (N, 3) finite."""
    from scipy.spatial import cKDTree  # 0.3 s, which chains without neighbours need not pay

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
        Neighbours of each, the point itself or one at the same place among them; at most N.
    max_distance_m : float
        Those farther away do not count.
    epsilon : float
        A neighbour may be farther than the true one by this share.

    Yields
    ------
    rows : slice
        The points of the piece.
    ids : (P, number) int64
        Rows of their neighbours; N where there are no more.
    distances : (P, number) float64, m
        inf where there are no more.

    """
    if not len(points):
        return
    in_tree = np.append(worth_searching(points, number), len(points))
    tree = search_tree(points[in_tree[:-1]])
    # scipy's bound is exclusive, and its square must not vanish
    bound = max(float(np.nextafter(max_distance_m, math.inf)), 1e-150)
    step = max(AT_ONCE // number, 1)
    for start in range(0, len(points), step):
        rows = slice(start, start + step)
        distances, ids = tree.query(
            points[rows], k=number, eps=epsilon, distance_upper_bound=bound
        )
        yield rows, in_tree[ids.reshape(-1, number)], distances.reshape(-1, number)


def worth_searching(points: Points, number: int) -> Ids:
    """Return the rows of points without those that so many others precede at the same place."""
    order = np.lexsort(points.T)
    ordered = points[order]
    begins = np.ones(len(points), np.bool_)
    begins[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    starts = np.flatnonzero(begins)
    before = np.arange(len(points)) - np.repeat(starts, np.diff(starts, append=len(points)))
    return np.sort(order[before < number])
