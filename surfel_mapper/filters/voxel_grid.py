# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
VoxelGrid: one point for the points of every voxel.

Occupied voxels are hashed, so that memory follows the points and not the extent of the scan;
libpointmatcher's dense grid wraps at 2^32 voxels. Its mode of voxel centres writes them into the
wrong coordinates and forgets the lowest corner; here they are the centres.

A 2-D cloud is one whose z are all 0: it is one layer of voxels.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import ConfigError, FilterError
from surfel_mapper.filters.base import Filter, with_points
from surfel_mapper.filters.merging import Groups, MergedColumns
from surfel_mapper.filters.parameters import parameter
from surfel_mapper.filters.registry import register
from surfel_mapper.kernels.voxel_grid import group_points
from surfel_mapper.scan import Scan

AXIS_BITS = 31
"""At most 2^31 voxels along an axis: the conversion that is done several at once ends there."""

KEY_BITS = 62
"""At most 2^62 voxels in the box of a scan, each axis rounded up to a power of two."""


@register(theirs='VoxelGridDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class VoxelGrid(Filter):
    """Replace the points of every voxel by one, in the order in which voxels first appear."""

    size_x_m: float = parameter(1.0, 'Edge along x, m.', low=0.001, theirs='vSizeX')
    size_y_m: float = parameter(1.0, 'Edge along y, m.', low=0.001, theirs='vSizeY')
    size_z_m: float = parameter(1.0, 'Edge along z, m.', low=0.001, theirs='vSizeZ')
    use_centroid: bool = parameter(
        True, '1: the mean of the points; 0: the centre of the voxel.', theirs='useCentroid'
    )
    average_columns: bool = parameter(
        True,
        '1: average the columns; 0: keep those of the first point.',
        theirs='averageExistingDescriptors',
    )
    unit_normals: bool = parameter(
        True,
        '1: averaged normals get unit length again; 0: they stay as short as they become.',
        their_default=False,
    )
    anchor: str = parameter(
        'origin',
        'Where voxels begin: at the origin, so that they stay where they are, or at the lowest '
        'coordinates of each scan.',
        choices=('origin', 'minimum'),
        their_default='minimum',
    )

    def check(self) -> None:
        """Refuse voxels that have no centre."""
        if not self.use_centroid and not all(map(math.isfinite, self._size)):
            raise ConfigError(f'{self.name}: a voxel of infinite size has no centre')

    @property
    def _size(self) -> tuple[float, float, float]:
        return self.size_x_m, self.size_y_m, self.size_z_m

    def apply(self, scan: Scan) -> Scan:
        """
        Return a point for every voxel with points.

        Raises
        ------
        FilterError
            If a coordinate is not finite, or the scan extends over too many voxels.

        """
        if not len(scan):
            return scan
        grid = Grid.over(scan.points, np.array(self._size), self.anchor)
        with_rows = bool(scan.columns) and self.average_columns
        keys, sums, groups = grid.group(scan.points, with_rows)
        means = sums[:, :3] / sums[:, 3:] if self.use_centroid else grid.centres(keys)
        unit = self.unit_normals
        columns = MergedColumns(scan.columns, groups, average=with_rows, unit=unit)
        return with_points(scan, means, columns)


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """The voxels over a scan: index = floor(x / size - shift) - base along each axis."""

    size: npt.NDArray[np.float64]
    shift: npt.NDArray[np.float64]
    base: npt.NDArray[np.float64]
    bits: npt.NDArray[np.int64]

    @classmethod
    def over(cls, points: npt.NDArray[Any], size: npt.NDArray[np.float64], anchor: str) -> Grid:
        """Return the grid that holds all points; refuse what no key can number."""
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
    ) -> Grid:
        """Return the grid that holds what lies between two corners; refuse as over does."""
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise FilterError(
                'a coordinate is nan or infinite; put remove_nan or a box or range before it'
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
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64], Groups]:
        """Return keys, sums of x y z and counts, and which points are in each voxel."""
        number = len(points)
        keys, first = np.empty((2, number), np.int64)
        sums = np.empty((number, 4))
        rows = np.empty(number if with_rows else 0, np.int32)
        found = group_points(
            points.T, self.size, self.shift, self.base, self.bits, keys, sums, first, rows
        )
        sums = sums[:found]
        return keys[:found], sums, Groups(rows, first[:found], sums[:, 3])

    def centres(self, keys: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """Return the centres of voxels, (K, 3) m."""
        ends = np.cumsum(self.bits)
        index = (keys[:, None] >> (ends - self.bits)) & ((1 << self.bits) - 1)
        return np.asarray((index + (self.base + self.shift + 0.5)) * self.size)
