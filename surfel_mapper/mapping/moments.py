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
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.kernels.layout import BITS, INDEX_BITS, INDEX_MASK, INDEX_OFFSET


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

    def select(self, voxels: slice | npt.NDArray[Any]) -> ScanMoments:
        """Return the moments of some voxels: a slice, a mask (K,) bool or row numbers."""
        names = ('key', 'count', 'total', 'product', 'view', 'channels')
        return replace(self, **{name: getattr(self, name)[voxels] for name in names})


def point_keys(
    points: npt.NDArray[Any], T_map_sensor: npt.NDArray[np.float64], voxel_size_m: float
) -> npt.NDArray[np.int64]:
    """Return the key of the voxel of each point, (N,); -1 where it is in none."""
    x, y, z = points.astype(np.float64).T
    scale = (1 << BITS) / voxel_size_m
    with np.errstate(invalid='ignore'):  # nan and inf are in no voxel
        lattice = [
            np.floor((((r[0] * x + r[1] * y) + r[2] * z) + r[3]) * scale) for r in T_map_sensor[:3]
        ]
        inside = np.all([np.abs(a) < INDEX_OFFSET << BITS for a in lattice], axis=0)
    keys = np.full(len(points), -1)
    index = [a[inside].astype(np.int64) >> BITS for a in lattice]
    keys[inside] = pack_keys(np.stack(index, axis=1))
    return keys


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
