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

from surfel_mapper.filters.grids import ScanVoxels
from surfel_mapper.models.growth import VoxelPoints
from surfel_mapper.models.kernels.voxel_means import (
    average_runs,
    CHUNK,
    finite_ends,
    label_points,
    row_bits,
    sorted_runs,
    voxel_keys,
    voxel_runs,
)
from surfel_mapper.models.kernels.voxel_points import gather_voxels

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Thinned:
    """
    Mean point of every occupied voxel.

    Attributes
    ----------
    means : (M, 3) float64, m
        In the order of the voxels.
    runs : (R,) int64
        Rows of the cloud by voxel; see models/kernels/voxel_means.py.
    num_points : int
        Number of all points, finite or not.
    points : (N, 3) float32 or float64, m
        The cloud.
    keys : (V,) int64, optional
        Keys of the voxels, if runs have their ranks instead.
    bits : (3,) int64
        Bits of x, y and z in the keys.

    """

    means: Array
    runs: Indices
    num_points: int
    points: npt.NDArray[Any]
    keys: Indices | None
    bits: Indices

    def by_voxel(self) -> VoxelPoints:
        """Return the finite points by voxel, with the neighbours of voxels."""
        number = len(self.means)
        held = int((self.runs & (CHUNK - 1)).sum()) + len(self.runs)
        points = np.empty((held, 3), self.points.dtype)
        rows, starts = np.empty(held, np.int32), np.empty(number + 1, np.int64)
        keys, to_key = np.empty(number, np.int64), row_bits(self.num_points)
        gather_voxels(self.points, self.runs, to_key, points, rows, starts, keys)
        full = keys if self.keys is None else self.keys[keys]
        return VoxelPoints.of(points, rows, starts, full, self.bits)

    def point_labels(self, labels: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
        """Return labels of all points from those of the means; -1 if not finite."""
        found = np.full(self.num_points, -1, np.int32)
        label_points(self.runs, row_bits(self.num_points), labels, found)
        return found


def thin(points: npt.NDArray[Any], voxel_size_m: float) -> Thinned:
    """Return the means of the points (N, 3) in each voxel."""
    points, ends = np.ascontiguousarray(points), np.empty((2, 3))
    if not finite_ends(points, ends):
        none = np.empty(0, np.int64)
        return Thinned(np.empty((0, 3)), none, len(points), points, None, np.zeros(3, np.int64))
    grid = ScanVoxels.between(ends[0], ends[1], np.full(3, voxel_size_m), 'origin')
    keys, to_key = np.empty(len(points), np.int64), row_bits(len(points))
    voxel_keys(points, grid.size, grid.shift, grid.base, grid.bits, keys)
    key_bits, unique = int(grid.bits.sum()), None
    if key_bits + to_key > 63:  # keys too long: renumber the occupied voxels
        held = keys >= 0
        unique, keys[held] = np.unique(keys[held], return_inverse=True)
        key_bits = len(points).bit_length()
    num = voxel_runs(keys, to_key)
    runs = sorted_runs(keys[:num], key_bits, to_key)
    means = np.empty((num, 3))
    means = means[: average_runs(points, runs, to_key, means)]
    return Thinned(means, runs, len(points), points, unique, grid.bits)
