# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Clouds by voxel: the mean point of every occupied voxel, and the points of each.

The order is that of the voxels, so results do not depend on the order of the points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.filters.grids import KEY_BITS, ScanVoxels
from surfel_mapper.models.growth import VoxelPoints
from surfel_mapper.models.kernels.voxel_means import (
    average_parts,
    average_voxels,
    finite_ends,
    sort_keys,
    spread_labels,
    voxel_keys,
)
from surfel_mapper.models.kernels.voxel_points import neighbour_table

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Thinned:
    """
    Mean point of every occupied voxel, and the P finite points of a cloud by voxel.

    Attributes
    ----------
    means : (V, 3) float64, m
        In the order of the voxels.
    points : (N, 3) float32 or float64, m
        The cloud.
    rows : (P,) int32
        Rows of the finite points of the cloud, voxel by voxel, ascending in each.
    starts : (V + 1,) int64
        First row of each voxel, and P.
    keys : (V,) int64
        Keys of the voxels, ascending: x in the lowest bits, then y and z; of their parts see
        models/kernels/voxel_means.py.
    bits : (3,) int64
        Bits of x, y and z in the keys.
    divisions : int
        Parts of a voxel along each axis; if not 1, all of the above are those of the parts.

    """

    means: Array
    points: npt.NDArray[Any]
    rows: npt.NDArray[np.int32]
    starts: Indices
    keys: Indices
    bits: Indices
    divisions: int = 1

    def by_voxel(self) -> VoxelPoints:
        """Return the finite points by voxel, with the neighbours of voxels."""
        points = np.take(self.points, self.rows, axis=0).astype(np.float64, copy=False)
        number, to_y, to_z = len(self.keys), int(self.bits[0]), int(self.bits[:2].sum())
        ends, near = np.empty(number + 1, np.int64), np.empty(26 * number, np.int32)
        neighbour_table(self.keys, to_y, to_z, ends, near)
        return VoxelPoints(points, self.rows, self.starts, (ends, near))

    def whole_voxels(self) -> Thinned:
        """Return the means of parts as a cloud by voxel."""
        number = len(self.keys)
        starts, keys = np.empty(number + 1, np.int64), np.empty(number, np.int64)
        parts, room = (self.keys, self.means, self.starts), np.empty((number, 3))
        num = average_parts(parts, self.divisions**3, starts, keys, room)
        rows, means = np.arange(number, dtype=np.int32), room[:num].copy()
        ends, own_keys = starts[: num + 1].copy(), keys[:num].copy()
        return Thinned(means, self.means, rows, ends, own_keys, self.bits)

    def point_labels(self, labels: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
        """Return labels of all points from those of the means; -1 if not finite."""
        of_points = np.full(len(self.points), -1, np.int32)
        spread_labels(labels, self.starts, self.rows, of_points)
        return of_points


def thin(points: npt.NDArray[Any], voxel_size_m: float, divisions: int = 1) -> Thinned:
    """Return the means of the points (N, 3) in each voxel, or in the divisions^3 parts of each."""
    points, ends = np.require(points, None, ['C', 'W']), np.empty((2, 3))
    number = finite_ends(points, ends)
    if not number:
        none, bits = np.empty(0, np.int64), np.zeros(3, np.int64)
        return Thinned(
            np.empty((0, 3)), points, none.astype(np.int32), np.zeros(1, np.int64), none, bits
        )
    grid = ScanVoxels.between(ends[0], ends[1], np.full(3, voxel_size_m), 'origin')
    if int(grid.bits.sum()) + (divisions**3 - 1).bit_length() > KEY_BITS:
        divisions = 1
    num_bits = int(grid.bits.sum()) + (divisions**3 - 1).bit_length()
    keys, rows = np.empty((2, number), np.int64), np.empty((2, number), np.int32)
    axes = grid.size, grid.shift, grid.base
    voxel_keys(points, (axes, grid.bits), divisions, keys[0], rows[0])
    last = sort_keys(keys, rows, num_bits)
    starts, means = np.empty(number + 1, np.int64), np.empty((number, 3))
    num = average_voxels(points, rows[last], keys[last], starts, means)
    starts, of_voxels = starts[: num + 1].copy(), keys[last, :num].copy()
    return Thinned(means[:num].copy(), points, rows[last], starts, of_voxels, grid.bits, divisions)
