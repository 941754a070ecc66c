# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters that replace the points of a cell by one: VoxelGrid and OctreeGrid.

VoxelGrid hashes occupied voxels, so that memory follows the points and not the extent of the
scan; libpointmatcher's dense grid wraps at 2^32 voxels. Its centres of voxels are written into the
wrong coordinates and lack the lowest corner; here they are the centres.

OctreeGrid starts from the smallest cube about the middle of the points' bounding box that holds
them all. A cube with too many points and too large is cut into eight; cubes not cut further are
the leaves. No tree is built: points are sorted by the path from the root to them, three bits a
level, so that a cube of any level is a run of the sorted points. Paths end after 21 levels, the
capacity of a 64-bit number: points that share a cube of a two-millionth of the scan's extent stay
together. libpointmatcher cuts on, without end if points coincide.

A 2-D cloud is one whose z are all 0: it is one layer of voxels, and the octree is a quadtree.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import ConfigError, FilterError
from surfel_mapper.filters.base import FiniteFilter, generator, parameter, select, with_points
from surfel_mapper.filters.kernels.voxel_grid import group_points
from surfel_mapper.filters.merging import merged_columns, PointGroups
from surfel_mapper.filters.neighbours import coordinates, Ids, Points
from surfel_mapper.filters.registry import register
from surfel_mapper.scan import Scan

AXIS_BITS = 31
"""At most 2^31 voxels along an axis: the limit of the vectorised conversion to int32."""

KEY_BITS = 62
"""At most 2^62 voxels in the box of a scan, each axis rounded up to a power of two."""


@register(libpointmatcher='VoxelGridDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class VoxelGrid(FiniteFilter):
    """Replace the points of every voxel by one, in the order in which voxels first appear."""

    size_x_m: float = parameter(1.0, 'Edge along x, m.', low=0.001, libpointmatcher='vSizeX')
    size_y_m: float = parameter(1.0, 'Edge along y, m.', low=0.001, libpointmatcher='vSizeY')
    size_z_m: float = parameter(1.0, 'Edge along z, m.', low=0.001, libpointmatcher='vSizeZ')
    use_centroid: bool = parameter(
        True,
        '1: the mean of the points; 0: the centre of the voxel.',
        libpointmatcher='useCentroid',
    )
    average_columns: bool = parameter(
        True,
        '1: average the columns; 0: keep those of the first point.',
        libpointmatcher='averageExistingDescriptors',
    )
    unit_normals: bool = parameter(
        True,
        '1: scale averaged normals to unit length; 0: leave them shorter.',
        libpointmatcher_default=False,
    )
    min_points: int = parameter(1, 'Voxels of fewer points are dropped.', low=1, high=2**31 - 1)
    anchor: str = parameter(
        'origin',
        'Corner of the grid: the origin, the same for all scans, or the minimum of the '
        'coordinates of each scan.',
        choices=('origin', 'minimum'),
        libpointmatcher_default='minimum',
    )

    def check(self) -> None:
        """Refuse infinite voxels without centroids."""
        if not self.use_centroid and not all(map(math.isfinite, self._size)):
            raise ConfigError(
                f'{self.name}: a voxel of infinite size has no centre; set use_centroid'
            )

    @property
    def _size(self) -> tuple[float, float, float]:
        return self.size_x_m, self.size_y_m, self.size_z_m

    def apply_finite(self, scan: Scan) -> Scan:
        """
        Return one point for every occupied voxel.

        Raises
        ------
        FilterError
            If the scan extends over too many voxels.

        """
        if not len(scan):
            return scan
        grid = ScanVoxels.over(scan.points, np.array(self._size), self.anchor)
        with_rows = bool(scan.columns) and self.average_columns
        keys, sums, groups = grid.group(scan.points, with_rows)
        if self.use_centroid:
            means = sums[:, :3] / sums[:, 3:]
        else:
            means = grid.centres(keys)
        unit = self.unit_normals
        columns = merged_columns(scan.columns, groups, average=with_rows, unit=unit)
        reduced = with_points(scan, means, columns)
        return reduced if self.min_points == 1 else select(reduced, sums[:, 3] >= self.min_points)


@dataclass(frozen=True, slots=True, eq=False)
class ScanVoxels:
    """Voxel grid over a scan: index = floor(x / size - shift) - base along each axis."""

    size: npt.NDArray[np.float64]
    shift: npt.NDArray[np.float64]
    base: npt.NDArray[np.float64]
    bits: npt.NDArray[np.int64]

    @classmethod
    def over(
        cls, points: npt.NDArray[Any], size: npt.NDArray[np.float64], anchor: str
    ) -> ScanVoxels:
        """Return the grid over all points; refuse an extent beyond the range of keys."""
        low = np.array([axis.min() for axis in points.T], np.float64)
        high = np.array([axis.max() for axis in points.T], np.float64)
        return cls.between(low, high, size, anchor)

    @classmethod
    def between(
        cls,
        low: npt.NDArray[np.float64],
        high: npt.NDArray[np.float64],
        size: npt.NDArray[np.float64],
        anchor: str,
    ) -> ScanVoxels:
        """Return the grid over the box between two corners; refuse as over does."""
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise FilterError(
                'a coordinate is nan or infinite; drop such points with filters.finite'
            )
        shift = low / size if anchor == 'minimum' else np.zeros(3)
        base = np.floor(low / size - shift)
        number = np.floor(high / size - shift) - base + 1.0
        bits = np.ceil(np.log2(number)).astype(np.int64)
        if bits.max() > AXIS_BITS or bits.sum() > KEY_BITS:
            extent = ' x '.join(f'{n:.4g}' for n in number)
            raise FilterError(
                f'the scan extends over {extent} voxels, at most 2^{AXIS_BITS} along an axis and '
                f'2^{KEY_BITS} in all can be numbered; use larger ones or drop far points before'
            )
        return cls(size, shift, base, bits)

    def group(
        self, points: npt.NDArray[Any], with_rows: bool
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64], PointGroups]:
        """Return keys, sums of x y z with counts, and the points of each voxel."""
        number = len(points)
        keys, first = np.empty((2, number + 2), np.int64)
        sums: npt.NDArray[np.float64] = np.empty((number + 1, 4))
        rows = np.empty(number if with_rows else 0, np.int32)
        xyz = np.ascontiguousarray(points.T)  # as decoded; the kernel is compiled for one layout
        num_voxels = group_points(
            xyz, self.size, self.shift, self.base, self.bits, keys, sums, first, rows
        )
        sums = sums[:num_voxels]
        return keys[1 : num_voxels + 1], sums, PointGroups(rows, first[:num_voxels], sums[:, 3])

    def centres(self, keys: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """Return the centres of voxels, (K, 3) m."""
        ends = np.cumsum(self.bits)
        index = (keys[:, None] >> (ends - self.bits)) & ((1 << self.bits) - 1)
        return np.asarray((index + (self.base + self.shift + 0.5)) * self.size)


LEVELS = 21

FIRST, RANDOM, CENTROID, MEDOID = range(4)


@register(libpointmatcher='OctreeGridDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class OctreeGrid(FiniteFilter):
    """
    Replace the points of every leaf of an octree by one, in the order of leaves' first points.

    The first point, a random one and the medoid keep their columns; for the centroid columns are
    averaged.
    """

    build_parallel: bool = parameter(True, 'No effect here.', libpointmatcher='buildParallel')
    max_points: int = parameter(
        1,
        'A cube with more points is cut into eight.',
        low=1,
        high=2**32 - 1,
        libpointmatcher='maxPointByNode',
    )
    max_size_m: float = parameter(
        0.0,
        'A cube with an edge up to this long is not cut, m.',
        low=0.0,
        libpointmatcher='maxSizeByNode',
    )
    sampling_method: int = parameter(
        0,
        'Point that replaces a leaf, 0: its first point; 1: a random one; 2: the mean; 3: the one '
        'nearest to the mean.',
        low=0,
        high=3,
        libpointmatcher='samplingMethod',
    )
    seed: int = parameter(0, 'Seed of the random numbers.', low=0, high=2**31 - 1)

    def apply_finite(self, scan: Scan) -> Scan:
        """Return one point for every leaf."""
        points = coordinates(scan)
        rows, number = leaves(points, self.max_points, self.max_size_m)
        groups = PointGroups.of(rows, number)
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
        return with_points(scan, means, merged_columns(scan.columns, groups))


def leaves(points: Points, max_points: int, max_size_m: float) -> tuple[Ids, int]:
    """
    Return the leaf of every point, (N,) int64, and the number of leaves.

    Leaves are numbered in the order in which their first points appear.
    """
    if not len(points):
        return np.empty(0, np.int64), 0
    path, edge_m = paths(points)
    order = np.argsort(path, kind='stable')
    path = path[order]
    starts = np.zeros(len(path), np.bool_)  # whether a leaf starts here in the sorted points
    open_: npt.NDArray[np.int64] = np.arange(len(path))  # points not assigned to a leaf yet
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
    corner[low == high] = low[low == high]  # a layer is not cut in half
    cells = ((points - corner) / edge_m * 2.0**LEVELS).astype(np.int64)
    cells = np.clip(cells, 0, 2**LEVELS - 1)  # points on the highest faces belong to the last cube
    path = np.zeros(len(points), np.int64)
    for axis in range(3):
        path |= spread(cells[:, axis]) << np.int64(axis)
    return path, edge_m


def spread(values: Ids) -> npt.NDArray[np.int64]:
    """Return 21-bit numbers with two zeros inserted before each bit."""
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
    """Return the point with the least value of each group, the first of equal ones."""
    order = np.lexsort((values, rows))
    starts = np.searchsorted(rows[order], np.arange(number))
    return np.asarray(order[starts], np.int64)
