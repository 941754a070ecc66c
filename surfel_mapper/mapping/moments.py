# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
ScanMoments: a scan reduced to the exact moments of its voxels.

Some 10^4 voxels stand for 10^5 points, in 78 bytes each. A map adds them, a window keeps them,
and a removal subtracts them again, so the cost of a scan depends on neither the length of the
window nor the size of the map.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import MapLimitError
from surfel_mapper.kernels.channels import sum_channels
from surfel_mapper.kernels.layout import (
    BITS,
    INDEX_BITS,
    INDEX_MASK,
    INDEX_OFFSET,
    MAX_SCAN_COUNT,
)
from surfel_mapper.kernels.moments import (
    BEYOND,
    NOT_FINITE,
    pack_moments,
    reduce_points,
    TOO_FAR,
    TOO_NEAR,
)
from surfel_mapper.kernels.queries import build_table
from surfel_mapper.mapping.channels import channel_names, quantised

NARROW_COUNT = 1 << 16
"""Below so many points in every voxel the sums fit into int32."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ScanMoments:
    """
    Exact moments of the points of K voxels; each voxel stands once.

    Attributes
    ----------
    voxel_size_m : float
        Voxel size of the map that they are for.
    level : int
        The lattice unit is ``voxel_size_m / 2^(16 + level)``; 0 for all scans.
    key : (K,) int64
        Voxel indices, packed.
    count : (K,) int32 or int64
        Points in each voxel.
    total : (K, 3) int32 or int64
        Sum of the places q of the points, in lattice units about the voxel centre.
    product : (K, 6) int64
        Sum of q q^T, order xx xy xz yy yz zz.
    view : (K, 3) int16 or int64
        int16: 2^14 times the unit vector to the sensor, the same for all points of the voxel;
        int64: the sum of these over the points.
    channel_names : tuple of str
        Names of the channels, where the map has any: intensity, red, green, blue.
    channels : (K, C) int64
        Their sums over the points; see mapping/channels.py for the units.
    left_out : mapping of str to int
        Points that are not in here, by cause: not_finite, too_near, too_far, beyond_map.

    """

    voxel_size_m: float
    level: int = 0
    key: npt.NDArray[np.int64]
    count: npt.NDArray[Any]
    total: npt.NDArray[Any]
    product: npt.NDArray[np.int64]
    view: npt.NDArray[Any]
    channel_names: tuple[str, ...] = ()
    channels: npt.NDArray[np.int64] = None  # type: ignore[assignment]  # none: (K, 0)
    left_out: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Without channels every voxel has a row of none."""
        if self.channels is None:
            object.__setattr__(self, 'channels', np.empty((len(self.key), 0), np.int64))

    def __len__(self) -> int:
        """Return the number of voxels."""
        return len(self.key)

    @property
    def num_voxels(self) -> int:
        """Number of voxels."""
        return len(self.key)

    @property
    def num_points(self) -> int:
        """Number of points."""
        return int(self.count.sum(dtype=np.int64))

    @property
    def voxel_index(self) -> npt.NDArray[np.int32]:
        """Voxel indices, (K, 3) int32."""
        return unpack_keys(self.key)

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return sum(a.nbytes for a in self.arrays) + self.channels.nbytes

    @property
    def arrays(self) -> tuple[npt.NDArray[Any], ...]:
        """The arrays as the kernels take them: key, count, total, product, view."""
        return self.key, self.count, self.total, self.product, self.view

    @property
    def view_is_sum(self) -> int:
        """1 where the view is a sum over points already, 0 where it is one point's."""
        return int(self.view.dtype == np.int64)

    def first(self, num_voxels: int) -> ScanMoments:
        """Return the moments of the first so many voxels."""
        names = ('key', 'count', 'total', 'product', 'view', 'channels')
        return replace(self, **{name: getattr(self, name)[:num_voxels] for name in names})


class Reducer:
    """
    Reduces scans to moments, over and over in the same scratch memory.

    Parameters
    ----------
    voxel_size_m : float
        Edge of a voxel.
    columns : tuple of str
        Columns of the points to sum as well.

    """

    def __init__(self, voxel_size_m: float, columns: tuple[str, ...] = ()) -> None:
        """Start with room for few voxels; it grows with the scans."""
        self.voxel_size_m = voxel_size_m
        self._columns = columns
        self._reserve(2048)

    def _reserve(self, num_voxels: int) -> None:
        table = np.full(2 * num_voxels, -1, np.int32)
        self._scratch = (table, np.empty(num_voxels, np.int64), np.empty((num_voxels, 10)))
        self._left_out = np.zeros(4, np.int64)

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
            If shapes or types are wrong, pose or origin are not finite, or a column is missing.
        MapLimitError
            If a voxel gets more than 2^23 points of one scan.

        """
        points = as_points(points)
        pose = np.eye(4) if T_map_sensor is None else np.asarray(T_map_sensor, np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError('T_map_sensor: expected a finite (4, 4) transform')
        seen_from = np.full(3, np.nan) if origin is None else np.asarray(origin, np.float64)
        if seen_from.shape != (3,) or (origin is not None and not np.isfinite(seen_from).all()):
            raise ValueError('origin: expected the finite position of the sensor, x y z')
        range_sq = np.array([min_range_m**2, max_range_m**2])
        values = quantised(columns or {}, self._columns, len(points)) if self._columns else None
        pose = np.ascontiguousarray(pose[:3])
        num = self._reduce(points, pose, range_sq)
        moments = self._pack(num, np.ascontiguousarray(seen_from))
        if values is None:
            return moments
        sums = self._sum_channels(points, pose, range_sq, moments.key, values)
        return replace(moments, channel_names=channel_names(self._columns), channels=sums)

    def _reduce(self, points: npt.NDArray[Any], pose: Any, range_sq: Any) -> int:
        """Fill the scratch memory, made larger until the voxels fit; return their number."""
        scale = (1 << BITS) / self.voxel_size_m
        while True:
            num = int(
                reduce_points(points.T, pose, scale, range_sq, self._scratch, self._left_out)
            )
            if num >= 0:
                return num
            self._reserve(len(self._scratch[0]))

    def _pack(self, num: int, origin: npt.NDArray[np.float64]) -> ScanMoments:
        """Turn the scratch memory into integers."""
        _, keys, sums = self._scratch
        key, sums = keys[:num].copy(), sums[:num]
        largest = sums[:, 0].max(initial=0.0)
        if largest > MAX_SCAN_COUNT:
            raise MapLimitError(
                f'{largest:.0f} points in one voxel of one scan; '
                f'at most {MAX_SCAN_COUNT}: use smaller voxels or split the scan'
            )
        moments = ScanMoments(
            voxel_size_m=self.voxel_size_m,
            key=key,
            count=np.empty(num, np.int32),
            total=np.empty((num, 3), np.int32 if largest < NARROW_COUNT else np.int64),
            product=np.empty((num, 6), np.int64),
            view=np.empty((num, 3), np.int16),
            left_out=self._causes(),
        )
        pack_moments(
            key,
            sums,
            origin,
            self.voxel_size_m,
            moments.count,
            moments.total,
            moments.product,
            moments.view,
        )
        return moments

    def _sum_channels(
        self,
        points: npt.NDArray[Any],
        pose: Any,
        range_sq: Any,
        key: npt.NDArray[np.int64],
        values: npt.NDArray[np.int32],
    ) -> npt.NDArray[np.int64]:
        """Return the sums of the channels of the points in each voxel, (K, C)."""
        table = self._scratch[0]
        build_table(key, table)
        sums = np.empty((len(key), values.shape[1]), np.int64)
        scale = (1 << BITS) / self.voxel_size_m
        sum_channels(points.T, pose, scale, range_sq, key, table, values, sums)
        table[:] = -1
        return sums

    def _causes(self) -> dict[str, int]:
        """Return how many points were left out, by cause; causes that did not occur are not in."""
        names = {
            'not_finite': NOT_FINITE,
            'too_near': TOO_NEAR,
            'too_far': TOO_FAR,
            'beyond_map': BEYOND,
        }
        counts = {name: int(self._left_out[row]) for name, row in names.items()}
        return {name: number for name, number in counts.items() if number}


def as_points(points: npt.ArrayLike) -> npt.NDArray[Any]:
    """
    Return points as the kernels take them: (N, 3) float32 or float64, column by column.

    Arrays that are so already (Fortran order, writeable) are not copied.
    """
    array = np.asarray(points)
    if array.size == 0 and array.ndim < 2:
        array = array.reshape(0, 3)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f'points: shape {array.shape}, expected (N, 3)')
    if array.dtype.kind not in 'fiu':
        raise ValueError(f'points: dtype {array.dtype}, expected numbers')
    dtype = np.float32 if array.dtype in (np.float32, np.float16) else np.float64
    return np.require(array, dtype, ['F', 'A', 'W'])


def pack_keys(voxel_index: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return the keys (K,) int64 of voxel indices (K, 3), each in [-2^20, 2^20)."""
    shifted = voxel_index.astype(np.int64) + INDEX_OFFSET
    packed = (shifted[:, 0] << (2 * INDEX_BITS)) | (shifted[:, 1] << INDEX_BITS) | shifted[:, 2]
    return np.asarray(packed, np.int64)


def unpack_keys(key: npt.NDArray[np.int64]) -> npt.NDArray[np.int32]:
    """Return the voxel indices (K, 3) int32 of keys (K,) int64."""
    shifts = np.array([2 * INDEX_BITS, INDEX_BITS, 0])
    index = ((key[:, None] >> shifts) & INDEX_MASK) - INDEX_OFFSET
    return np.asarray(index, np.int32)
