# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
OctreeGrid: one point for every leaf of an octree.

The root is the smallest cube about the middle of the points' bounding box that holds them all. A
cube with too many points and too large is cut into eight; those that are not cut further are the
leaves. No tree is built: points are sorted by the path from the root to them, three bits a level,
so that a cube of any level is a run of the sorted points.

Paths end after 21 levels, where a 64-bit number ends: points that share a cube of a two-millionth
of the scan's extent stay together. libpointmatcher cuts on, without end where points coincide.
A 2-D cloud, one whose z are all 0, fills one layer: cubes are squares.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surfel_mapper.filters.base import Filter, generator, select, with_points
from surfel_mapper.filters.merging import Groups, MergedColumns
from surfel_mapper.filters.neighbours import coordinates, Ids, Points
from surfel_mapper.filters.parameters import parameter
from surfel_mapper.filters.registry import register
from surfel_mapper.scan import Scan

LEVELS = 21

FIRST, RANDOM, CENTROID, MEDOID = range(4)


@register(theirs='OctreeGridDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class OctreeGrid(Filter):
    """
    Replace the points of every leaf of an octree by one, in the order of leaves' first points.

    The first, a random one and the medoid are points of the scan and keep their columns; for the
    centroid columns are averaged.
    """

    build_parallel: bool = parameter(True, 'Makes no difference here.', theirs='buildParallel')
    max_points: int = parameter(
        1,
        'A cube with more points is cut into eight.',
        low=1,
        high=2**32 - 1,
        theirs='maxPointByNode',
    )
    max_size_m: float = parameter(
        0.0, 'A cube with an edge up to this long is not cut, m.', low=0.0, theirs='maxSizeByNode'
    )
    sampling_method: int = parameter(
        0,
        'What stands for a leaf, 0: its first point; 1: a random one; 2: the mean; 3: the one '
        'nearest the mean.',
        low=0,
        high=3,
        theirs='samplingMethod',
    )
    seed: int = parameter(0, 'Of the random numbers.', low=0, high=2**31 - 1)

    def apply(self, scan: Scan) -> Scan:
        """Return a point for every leaf; nan and infinite points are refused."""
        points = coordinates(scan)
        rows, number = leaves(points, self.max_points, self.max_size_m)
        groups = Groups.of(rows, number)
        if self.sampling_method == FIRST:
            return select(scan, groups.first)
        if self.sampling_method == RANDOM:
            draws = generator(scan, self.seed).random(len(scan))
            return select(scan, least_of_each(draws, rows, number))
        means = np.stack(
            [np.bincount(rows, axis, number) / groups.count for axis in points.T], axis=1
        )
        if self.sampling_method == MEDOID:
            apart_sq = ((points - means[rows]) ** 2).sum(axis=1)
            return select(scan, least_of_each(apart_sq, rows, number))
        return with_points(scan, means, MergedColumns(scan.columns, groups))


def leaves(points: Points, max_points: int, max_size_m: float) -> tuple[Ids, int]:
    """
    Return the leaf of every point, (N,) int64, and how many there are.

    Leaves are numbered in the order in which their first points appear.
    """
    if not len(points):
        return np.empty(0, np.int64), 0
    path, edge_m = paths(points)
    order = np.argsort(path, kind='stable')
    path = path[order]
    starts = np.zeros(len(path), np.bool_)  # where a leaf starts among the sorted points
    open_ = np.arange(len(path))  # points whose leaf is not found yet
    for level in range(LEVELS + 1):
        cube = path[open_] >> np.int64(3 * (LEVELS - level))
        first = np.flatnonzero(np.diff(cube, prepend=-1))
        count = np.diff(first, append=len(cube))
        is_leaf = count <= max_points
        if edge_m / 2**level <= max_size_m or level == LEVELS:
            is_leaf[:] = True
        starts[open_[first[is_leaf]]] = True
        open_ = open_[np.repeat(~is_leaf, count)]
    leaf = np.empty(len(path), np.int64)
    leaf[order] = np.cumsum(starts) - 1
    _, first, rows = np.unique(leaf, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[rows], len(first)


def paths(points: Points) -> tuple[Ids, float]:
    """Return the paths of points from the root down, (N,) int64, and the edge of the root, m."""
    low, high = points.min(axis=0), points.max(axis=0)
    edge_m = float((high - low).max())
    if edge_m == 0.0:
        return np.zeros(len(points), np.int64), 0.0
    corner = 0.5 * low + 0.5 * high - 0.5 * edge_m
    corner[low == high] = low[low == high]  # a layer is not cut in the middle
    cells = ((points - corner) / edge_m * 2.0**LEVELS).astype(np.int64)
    cells = np.clip(cells, 0, 2**LEVELS - 1)  # the highest faces belong to the last cube
    path = np.zeros(len(points), np.int64)
    for axis in range(3):
        path |= spread(cells[:, axis]) << np.int64(axis)
    return path, edge_m


def spread(values: Ids) -> npt.NDArray[np.int64]:
    """Return numbers of 21 bits with two zeros put before each bit."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        values = (values | (values << np.int64(shift))) & np.int64(mask)
    return values


def least_of_each(values: Points, rows: Ids, number: int) -> Ids:
    """Return the point with the least value of each group, the first one where several have it."""
    order = np.lexsort((values, rows))
    starts = np.searchsorted(rows[order], np.arange(number))
    return np.asarray(order[starts], np.int64)
