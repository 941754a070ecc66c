# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reducer: reduces the points of a scan to moments.

The scratch memory is kept from scan to scan. A scan with more points of a voxel than the packed
sums hold is reduced once more in parts: a wall 0.6 m from a camera of 640 x 480, 77,000 points a
voxel, takes four times as long as one at 1.2 m, with 48,000 (4.8 and 1.2 ms).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_array, as_numbers
from surfel_mapper.errors import MapLimitError
from surfel_mapper.geometry import check_rigid
from surfel_mapper.kernels.grouping import AHEAD, build_table, CHUNK
from surfel_mapper.kernels.lanes import FULL, WIDEST, WORDS
from surfel_mapper.kernels.layout import BITS, MAX_SCAN_COUNT
from surfel_mapper.kernels.prefetch import LINE_BYTES
from surfel_mapper.mapping.channels import channel_names, quantised
from surfel_mapper.mapping.kernels.reduction import (
    BEYOND,
    NOT_FINITE,
    pack_moments,
    reduce_points,
    sum_channels,
    TOO_FAR,
    TOO_NEAR,
)
from surfel_mapper.mapping.moments import ScanMoments

ENTRIES = 4
"""Table entries for each voxel: real lidars change the voxel with almost every point, and a table
at most a quarter full instead of half saves 10 % of a reduction."""

CAUSES = {
    'not_finite': NOT_FINITE,
    'too_near': TOO_NEAR,
    'too_far': TOO_FAR,
    'beyond_map': BEYOND,
}
"""Causes why points are left out, and the rows in which the kernel counts them."""


IDENTITY, UNKNOWN = np.eye(4), np.full(3, np.nan)
"""Pose of points that are in the map frame, and place of an unknown sensor."""

NO_LIMITS = np.array([0.0, np.inf])
"""Squared limits of the range by default."""

Quantisation = tuple[npt.NDArray[np.float64], float, npt.NDArray[np.float64]]
"""Pose (4, 4), lattice units a metre, smallest and largest squared range (2,)."""


class Scratch:
    """Scratch memory of a kernel that sums points by voxel."""

    def __init__(self) -> None:
        self.left_out = np.zeros(4, np.int64)
        self._chunk = (
            np.zeros(CHUNK + 1, np.int64),
            np.empty(CHUNK, np.int64),
            np.zeros(CHUNK + AHEAD, np.int32),
            np.zeros(CHUNK + AHEAD, np.int32),
        )
        self.reserve(2048)

    def reserve(self, num_voxels: int) -> None:
        """Allocate room for num_voxels voxels; previous content is lost."""
        self.table = np.full(ENTRIES * num_voxels, -1, np.int32)
        self.keys = np.empty(num_voxels + 2, np.int64)
        memory = np.empty((num_voxels + 2) * WORDS + LINE_BYTES // 8, np.int64)
        first = -(memory.ctypes.data // 8) % (LINE_BYTES // 8)  # each voxel in one cache line
        self.sums = memory[first:][: (num_voxels + 2) * WORDS].reshape(-1, WORDS)

    def fill(self, xyz: npt.NDArray[Any], quantisation: Quantisation) -> int:
        """Sum points by voxel, enlarging the memory if needed; return the number of voxels."""
        while True:
            arrays = self.table, self.keys, self.sums, *self._chunk
            num = reduce_points(xyz, *quantisation, arrays, self.left_out)
            if num >= 0:
                return int(num)
            self.reserve(2 * (len(self.sums) - 2))


class Reducer:
    """
    Reduces scans to moments, reusing its scratch memory.

    Parameters
    ----------
    voxel_size_m : float
        Edge of a voxel.
    columns : tuple of str
        Columns of the points to sum in addition.

    """

    def __init__(self, voxel_size_m: float, columns: tuple[str, ...] = ()) -> None:
        self.voxel_size_m = voxel_size_m
        self._columns = columns
        self._scratch: Scratch | None = Scratch()

    def reduce(
        self,
        points: npt.ArrayLike,
        T_map_sensor: npt.NDArray[np.float64] | None = None,
        *,
        origin: npt.ArrayLike | None = None,
        min_range_m: float = 0.0,
        max_range_m: float = math.inf,
        columns: Mapping[str, npt.NDArray[Any]] | None = None,
    ) -> ScanMoments:
        """
        Return the moments of points; see SurfelMap.reduce.

        Raises
        ------
        ValueError
            If shapes or types are wrong, the pose is not a rigid transform, the origin is not
            finite, a limit of the range is negative or nan, or a column is missing.
        MapLimitError
            If a voxel gets more than 2^23 points of one scan.

        """
        points = as_points(points)
        if columns is not None and not isinstance(columns, Mapping):
            raise TypeError(f'columns: a {type(columns).__name__}, expected arrays by name')
        pose = IDENTITY
        if T_map_sensor is not None:
            check_rigid('T_map_sensor', T_map_sensor)
            pose = np.ascontiguousarray(T_map_sensor, np.float64)
        values = (
            quantised({} if columns is None else columns, self._columns, len(points))
            if self._columns
            else None
        )
        scale = (1 << BITS) / self.voxel_size_m
        quantisation = (pose, scale, squared_limits(min_range_m, max_range_m))
        seen_from = UNKNOWN if origin is None else as_origin(origin)
        scratch, self._scratch = self._scratch or Scratch(), None  # an error leaves it in disorder
        moments = self._moments(points.T, quantisation, seen_from, scratch)
        if values is not None:
            if ENTRIES * len(moments) > len(scratch.table):
                scratch.reserve(1 << len(moments).bit_length())
            build_table(moments.key, scratch.table)
            sums = np.empty((len(moments), values.shape[1]), np.int64)
            sum_channels(points.T, *quantisation, moments.key, scratch.table, values, sums)
            scratch.table.fill(-1)
            moments = replace(moments, channel_names=channel_names(self._columns), channels=sums)
        self._scratch = scratch
        num_reduced = len(points) - sum(moments.left_out.values())
        object.__setattr__(moments, 'num_reduced', num_reduced)
        return moments

    def _moments(
        self,
        xyz: npt.NDArray[Any],
        quantisation: Quantisation,
        origin: npt.NDArray[np.float64],
        scratch: Scratch,
    ) -> ScanMoments:
        """Return the moments of points (3, N); see SurfelMap.reduce."""
        num_points, size = xyz.shape[1], WIDEST
        if num_points <= WIDEST:
            num = scratch.fill(xyz, quantisation)
            left_out: dict[str, int] = {}
            for cause, row in CAUSES.items():
                if scratch.left_out[row]:
                    left_out[cause] = int(scratch.left_out[row])
            key, count = np.empty(num, np.int64), np.empty(num, np.int32)
            total, product = np.empty((num, 3), np.int32), np.empty((num, 6), np.int64)
            view = np.empty((num, 3), np.int16)
            outputs = key, count, total, product, view
            keys, sums = scratch.keys[2 : num + 2], scratch.sums[1 : num + 1]
            largest = pack_moments(keys, sums, origin, self.voxel_size_m, outputs)
            if largest <= FULL:
                return ScanMoments(
                    voxel_size_m=self.voxel_size_m,
                    key=key,
                    count=count,
                    total=total,
                    product=product,
                    view=view,
                    left_out=left_out,
                )
            size = max(FULL, num_points * FULL // (2 * largest))  # half full on average
        starts = range(0, num_points, size)
        chunks = (np.ascontiguousarray(xyz[:, i : i + size]) for i in starts)
        return summed_moments([self._moments(p, quantisation, origin, scratch) for p in chunks])


def summed_moments(chunks: Sequence[ScanMoments]) -> ScanMoments:
    """
    Return the moments of the points of all chunks of a scan.

    Raises
    ------
    MapLimitError
        If a voxel gets more than 2^23 points.

    """
    keys = np.concatenate([chunk.key for chunk in chunks])
    key, first, rows = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first)  # of first appearance
    key, rows = key[order], np.argsort(order)[rows]

    def summed(name: str) -> npt.NDArray[np.int64]:
        values = np.concatenate([getattr(chunk, name) for chunk in chunks])
        sums = np.zeros((len(key), *values.shape[1:]), np.int64)
        np.add.at(sums, rows, values)
        return sums

    count, total = summed('count'), summed('total')
    largest = count.max(initial=0)
    if largest > MAX_SCAN_COUNT:
        raise MapLimitError(
            f'{largest} points in one voxel of one scan; '
            f'at most {MAX_SCAN_COUNT}: use smaller voxels or split the scan'
        )
    view = np.empty((len(key), 3), np.int16)  # equal in all chunks
    view[rows] = np.concatenate([chunk.view for chunk in chunks])
    causes = [cause for cause in CAUSES if any(cause in chunk.left_out for chunk in chunks)]
    return replace(
        chunks[0],
        key=key,
        count=count.astype(np.int32),
        total=total if largest > FULL else total.astype(np.int32),
        product=summed('product'),
        view=view,
        channels=np.empty((len(key), 0), np.int64),
        left_out={
            cause: sum(chunk.left_out.get(cause, 0) for chunk in chunks) for cause in causes
        },
    )


def within(
    points: npt.NDArray[Any], min_range_m: float, max_range_m: float
) -> npt.NDArray[np.bool_]:
    """Return which points (N, 3) are within range, by the rule of the kernel; max 0: no limit."""
    x, y, z = points.astype(np.float64).T
    range_sq = (x * x + y * y) + z * z
    far_sq = max_range_m**2 if max_range_m else np.inf
    return np.asarray(np.isfinite(range_sq) & (range_sq >= min_range_m**2) & (range_sq <= far_sq))


def squared_limits(min_range_m: float, max_range_m: float) -> npt.NDArray[np.float64]:
    """Return the squares of the limits of the range; ValueError unless they are zero or more."""
    if min_range_m == 0.0 and max_range_m == math.inf:
        return NO_LIMITS
    if type(min_range_m) is float is type(max_range_m) and min_range_m >= 0.0 <= max_range_m:
        return np.array([min_range_m * min_range_m, max_range_m * max_range_m])  # the usual case
    limits = as_numbers('min_range_m, max_range_m', (min_range_m, max_range_m)).tolist()
    if not all(isinstance(limit, float) and limit >= 0.0 for limit in limits):  # also nan
        raise ValueError(
            f'min_range_m {min_range_m!r}, max_range_m {max_range_m!r}, expected zero or more'
        )
    return np.array([limit * limit for limit in limits])


def as_origin(origin: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the position of the sensor as the kernels take it; ValueError if it is none."""
    is_usual = type(origin) is np.ndarray and origin.dtype == np.float64
    position = np.ascontiguousarray(origin if is_usual else as_numbers('origin', origin))
    if position.shape != (3,) or not all(map(math.isfinite, position.tolist())):
        raise ValueError('origin: expected the finite position of the sensor, x y z')
    return position


def as_points(points: npt.ArrayLike) -> npt.NDArray[Any]:
    """
    Return points as the kernels take them: (N, 3) float32 or float64 in Fortran order.

    Arrays that fulfil this and are writeable are not copied.
    """
    if type(points) is np.ndarray and points.dtype == np.float32 and points.ndim == 2:
        flags = points.flags  # the usual case; the general one takes 20 us in a cold cache
        if points.shape[1] == 3 and flags.f_contiguous and flags.aligned and flags.writeable:
            return points
    array = as_array('points', points)
    if array.dtype.names:  # Surfels, or a structured array
        columns = ', '.join(array.dtype.names[:4])
        raise ValueError(
            f'points: a {type(points).__name__} of columns {columns}, ..., expected (N, 3) numbers'
        )
    if array.size == 0 and array.ndim < 2:
        array = array.reshape(0, 3)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f'points: shape {array.shape}, expected (N, 3)')
    if array.dtype.kind not in 'fiu':
        raise ValueError(f'points: dtype {array.dtype}, expected numbers')
    dtype = np.float32 if array.dtype in (np.float32, np.float16) else np.float64
    return np.require(array, dtype, ['F', 'A', 'W'])
