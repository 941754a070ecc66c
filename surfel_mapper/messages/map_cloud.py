# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Exact moments as fields of a cloud, and MapMirror: a client's exact copy of the map of a node.

A PointField has no 64-bit integer. So each integer is a field of two uint32, the low half
first: its bytes in little-endian order. The numbers of points and scans are ``num_points`` and
``num_scans``, the voxel three int32; the sums of the map's channels follow under their names.

``~/changed`` holds the present moments of all voxels that a scan changed, not the difference, so a
message applied twice, or after a newer full map, does no harm. ``~/normals`` regularly holds the
full map: it starts a copy, and repairs one that has missed a change. Both carry the moments if
``publish.moments`` is set.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from itertools import dropwhile
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import CloudFormatError, MapError
from surfel_mapper.mapping.channels import channel_names
from surfel_mapper.mapping.moments import check_possible, pack_keys, ScanMoments, within_reach
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import COVARIANCE, QUALITY, surfel_columns, Surfels
from surfel_mapper.messages.pointcloud2 import (
    append_fields,
    CloudBytes,
    from_columns,
    to_scan,
    UINT32,
)

VOXEL = ('voxel_x', 'voxel_y', 'voxel_z')

TOTAL = ('sum_x', 'sum_y', 'sum_z')

PRODUCT = ('sum_xx', 'sum_xy', 'sum_xz', 'sum_yy', 'sum_yz', 'sum_zz')

VIEW = ('view_x', 'view_y', 'view_z')

NORMAL = ('normal_x', 'normal_y', 'normal_z')

FIELDS = ('x', 'y', 'z', *NORMAL, 'curvature', 'planarity', 'num_points')
"""Fields that each message of surfels has."""

Columns = dict[str, npt.NDArray[Any]]


def voxel_columns(voxel_index: npt.NDArray[np.int32], size_m: npt.ArrayLike) -> Columns:
    """Return the columns of ~/removed: centres of voxels or cells, indices and sizes, m."""
    size = np.broadcast_to(np.asarray(size_m, np.float64), len(voxel_index))
    centers = ((voxel_index + 0.5) * size[:, None]).astype(np.float32)
    columns = dict(zip('xyz', centers.T, strict=True))
    return {**columns, **index_columns(voxel_index), 'size': size.astype(np.float32)}


def index_columns(voxel_index: npt.NDArray[Any]) -> Columns:
    """Return the columns of voxel indices (K, 3)."""
    return dict(zip(VOXEL, np.asarray(voxel_index, np.int32).T, strict=True))


def adaptive_cloud(surfels: Surfels) -> CloudBytes:
    """Return the cloud of adaptive surfels, with their indices floor(point / size)."""
    return from_columns({**surfel_columns(surfels), **index_columns(surfels.voxel_index)})


def moment_cloud(
    surfels: Surfels, moments: ScanMoments, removed: npt.NDArray[np.int32]
) -> CloudBytes:
    """
    Return the cloud of ~/normals and ~/changed with moments (publish.moments).

    Parameters
    ----------
    surfels : Surfels
        One for each voxel.
    moments : ScanMoments
        Of the same voxels, sorted by voxel, as SurfelMap.moments returns them.
    removed : (E, 3) int32
        Voxels that are empty now; each becomes a row with 0 points, all else nan or 0.

    """
    order = np.argsort(pack_keys(surfels.voxel_index))
    index = np.concatenate([moments.voxel_index, removed])
    columns = {
        name: extended(values, len(removed))
        for name, values in surfel_columns(surfels.select(order)).items()
    }
    columns.update(zip(VOXEL, index.T, strict=True))
    names = (*TOTAL, *PRODUCT, *VIEW, *(f'sum_{name}' for name in moments.channel_names))
    arrays = (moments.total, moments.product, moments.view, moments.channels)
    sums = np.zeros((len(index), len(names)), np.int64)
    np.concatenate(arrays, axis=1, out=sums[: len(moments)])
    fields = [(name, UINT32, 2) for name in names]
    return append_fields(from_columns(columns), halves(sums), fields)


def surfels_in(msg: Any) -> Surfels:
    """Return the surfels of a message of ~/normals or ~/changed; see Surfels.from_message."""
    scan = to_scan(msg, 'surfels')
    columns: Columns = dict(zip('xyz', scan.points.T, strict=True)) | dict(scan.columns)
    if not len(scan):
        columns = dict.fromkeys(FIELDS, np.empty(0))
    if missing := [name for name in FIELDS if name not in columns]:
        raise CloudFormatError(f'no field {", ".join(missing)}, expected a cloud of ~/normals')
    kept = columns['num_points'] > 0
    columns = {name: values[kept] for name, values in columns.items()}
    count = columns['num_points'].astype(np.int64)
    unknown = np.full(len(count), np.iinfo(np.int32).min, np.int32)
    nan = np.full(len(count), np.nan)

    def stacked(names: Iterable[str]) -> npt.NDArray[np.float64]:
        return np.stack([columns[name] for name in names], axis=1).astype(np.float64)

    return Surfels(
        position=stacked('xyz'),
        normal=stacked(NORMAL),
        planarity=columns['planarity'].astype(np.float64),
        curvature=columns['curvature'].astype(np.float64),
        eigenvalues=np.full((len(count), 3), np.nan),
        num_points=count,
        voxel_index=np.stack([columns.get(name, unknown) for name in VOXEL], axis=1),
        quality=tuple([columns.get(name, nan).astype(np.float64) for name in QUALITY[:3]]),
        num_scans=columns.get('num_scans', np.zeros(len(count))).astype(np.int64),
        size=columns.get('size', nan).astype(np.float64),
        covariance=stacked(COVARIANCE) if columns.keys() >= {*COVARIANCE} else None,
        channels=means_in(columns),
    )


def means_in(columns: Columns) -> dict[str, npt.NDArray[np.float64]]:
    """Return the means of the channels of a map: ``intensity``; ``red``, ``green``, ``blue``."""
    means = {}
    if 'intensity' in columns:
        means['intensity'] = columns['intensity'].astype(np.float64)
    if 'rgb' in columns:
        packed = np.ascontiguousarray(columns['rgb'], np.float32).view(np.uint32)
        for shift, name in ((16, 'red'), (8, 'green'), (0, 'blue')):
            means[name] = ((packed >> shift) & 255).astype(np.float64)
    return means


def moments_in(columns: Columns, voxel_size_m: float, channels: tuple[str, ...]) -> ScanMoments:
    """
    Return the moments in the columns of a cloud; those of removed voxels have 0 points.

    Parameters
    ----------
    columns : dict of str to array
        Columns of a decoded cloud, with x, y and z.
    voxel_size_m : float
        Of the map.
    channels : tuple of str
        Further channels that the map sums: intensity; red, green, blue.

    Raises
    ------
    CloudFormatError
        If a column is missing, or the voxels are of another size.

    """
    names = (*TOTAL, *PRODUCT, *VIEW, *(f'sum_{name}' for name in channels))
    missing = [name for name in ('num_points', *VOXEL, *names) if name not in columns]
    if missing:
        raise CloudFormatError(
            f'no field {", ".join(missing)}; does the node publish.moments, and does its map sum '
            f'{", ".join(channels) or "no channels"}?'
        )
    index = np.stack([columns[name] for name in VOXEL], axis=1).astype(np.int32)
    if not within_reach(index).all():
        raise CloudFormatError('voxel indices beyond 21 bits, expected those of a map')
    count = columns['num_points'].astype(np.int64)
    check_size(columns, index, count > 0, voxel_size_m)
    sums = np.stack([whole(columns[name]) for name in names], axis=1)
    total, product, view, channel_sums = np.split(sums, (3, 9, 12), axis=1)
    return ScanMoments(
        voxel_size_m=voxel_size_m,
        key=pack_keys(index),
        count=count,
        total=np.ascontiguousarray(total),
        product=np.ascontiguousarray(product),
        view=np.ascontiguousarray(view),
        channel_names=channels,
        channels=np.ascontiguousarray(channel_sums),
        num_scans=columns['num_scans'].astype(np.int64) if 'num_scans' in columns else None,
    )


def check_size(
    columns: Columns,
    index: npt.NDArray[np.int32],
    rows: npt.NDArray[np.bool_],
    voxel_size_m: float,
) -> None:
    """Raise CloudFormatError if surfels do not lie in their voxels."""
    position = np.stack([columns[name] for name in 'xyz'], axis=1)[rows].astype(np.float64)
    offset = np.abs(position - (index[rows] + 0.5) * voxel_size_m)
    slack = 1e-6 * (np.abs(position) + voxel_size_m)  # positions are float32
    if (offset > 0.5 * voxel_size_m + slack).any():
        raise CloudFormatError(
            f'surfels outside of their voxels of {voxel_size_m:g} m; does the node have another '
            'map.voxel_size_m?'
        )


def halves(values: npt.NDArray[np.int64]) -> npt.NDArray[np.uint32]:
    """Return the columns of integers (K, C) as pairs, (K, 2 C) uint32: the low half first."""
    return np.ascontiguousarray(values, '<i8').view('<u4').astype(np.uint32, copy=False)


def whole(pairs: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return the integers of pairs, (K,)."""
    return np.ascontiguousarray(pairs, '<u4').view('<i8').reshape(-1).astype(np.int64)


def extended(values: npt.NDArray[Any], number: int) -> npt.NDArray[Any]:
    """Return a column with ``number`` further rows: nan for floats, 0 for integers."""
    filling = np.nan if values.dtype.kind == 'f' else 0
    return np.concatenate([values, np.full(number, filling, values.dtype)])


MAX_RECENT = 100
"""Number of changes kept in case an older full map arrives after them: 5 s at 20 Hz."""


RESET_NS = 10**9
"""A stamp that is older by more than this means that time was set back; less, another sensor."""


class MapMirror:
    """
    A copy of a map that follows another.

    Parameters
    ----------
    voxel_size_m : float
        ``map.voxel_size_m`` of the node.
    columns : tuple of str
        ``map.columns`` of the node: ``intensity``, ``rgb``.

    Attributes
    ----------
    map : SurfelMap
        The copy, to be read only.
    stamp_ns : int
        Stamp of the newest scan in it; 0 at first.
    is_complete : bool
        Whether a full map has come; until then the copy has only the changes since the start.

    Examples
    --------
    >>> mirror = MapMirror(voxel_size_m=0.5)
    >>> mirror.is_complete, mirror.map.num_points
    (False, 0)

    """

    def __init__(self, voxel_size_m: float, columns: tuple[str, ...] = ()) -> None:
        self.map = SurfelMap(voxel_size_m, columns=columns)
        self.stamp_ns = 0
        self.is_complete = False
        self._channels = channel_names(columns)
        self._recent: deque[tuple[int, ScanMoments]] = deque(maxlen=MAX_RECENT)

    def __repr__(self) -> str:
        """Return the copy, and whether a full map has come."""
        return f'MapMirror({self.map!r}, {"" if self.is_complete else "not yet "}complete)'

    def replace(self, msg: Any) -> None:
        """
        Take the full map of a message on ~/normals; changes since then are applied to it.

        Parameters
        ----------
        msg : sensor_msgs/PointCloud2
            From rclpy or rosbags.

        Raises
        ------
        CloudFormatError
            If it has no moments, or moments of another voxel size; the copy is unchanged then.

        """
        stamp_ns, moments = self._read(msg)
        self.map.clear()
        self.map.insert(moments)
        self.stamp_ns = stamp_ns
        for changed_ns, changed in dropwhile(lambda change: change[0] < stamp_ns, self._recent):
            self._put(changed)
            self.stamp_ns = max(self.stamp_ns, changed_ns)
        self.is_complete = True

    def change(self, msg: Any) -> None:
        """Apply a message on ~/changed; see replace."""
        stamp_ns, moments = self._read(msg)
        if stamp_ns < self.stamp_ns - RESET_NS:
            self._recent.clear()
            self.stamp_ns = stamp_ns
        self._recent.append((stamp_ns, moments))
        self._put(moments)
        self.stamp_ns = max(self.stamp_ns, stamp_ns)

    def _read(self, msg: Any) -> tuple[int, ScanMoments]:
        """Return the stamp and the moments in a message."""
        scan = to_scan(msg)
        if not len(scan):
            return scan.stamp_ns, self.map.moments(np.empty((0, 3), np.int32))
        columns = {**dict(zip('xyz', scan.points.T, strict=True)), **scan.columns}
        moments = moments_in(columns, self.map.voxel_size_m, self._channels)
        try:
            check_possible(moments.select(moments.count > 0))
        except MapError as error:
            raise CloudFormatError(str(error)) from error
        return scan.stamp_ns, moments

    def _put(self, moments: ScanMoments) -> None:
        """Replace the moments of voxels in the copy."""
        self.map.remove(self.map.moments(moments.voxel_index))
        self.map.insert(moments.select(moments.count > 0))
