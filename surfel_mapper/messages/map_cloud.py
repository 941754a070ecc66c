# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Exact moments as fields of a cloud, and back.

A PointField holds no 64-bit integer. So each integer is a field of two uint32, the low half
first: its bytes in little-endian order. The number of points is ``num_points``, the voxel three
int32, and what the map sums of its channels follows under their names.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import CloudFormatError
from surfel_mapper.mapping.moments import pack_keys, ScanMoments
from surfel_mapper.mapping.surfel_columns import surfel_columns
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.messages.appended import appended
from surfel_mapper.messages.pointcloud2 import CloudBytes, from_columns, UINT32

VOXEL = ('voxel_x', 'voxel_y', 'voxel_z')

TOTAL = ('sum_x', 'sum_y', 'sum_z')

PRODUCT = ('sum_xx', 'sum_xy', 'sum_xz', 'sum_yy', 'sum_yz', 'sum_zz')

VIEW = ('view_x', 'view_y', 'view_z')

Columns = dict[str, npt.NDArray[Any]]


def voxel_columns(voxel_index: npt.NDArray[np.int32], voxel_size_m: float) -> Columns:
    """Return the columns of ~/removed: the centres of voxels as x y z, and their indices."""
    centers = ((voxel_index + 0.5) * voxel_size_m).astype(np.float32)
    index = np.asarray(voxel_index, np.int32)
    return dict(zip((*'xyz', *VOXEL), (*centers.T, *index.T), strict=True))


def moment_cloud(
    surfels: Surfels, moments: ScanMoments, removed: npt.NDArray[np.int32]
) -> CloudBytes:
    """
    Return the cloud of ~/normals and ~/changed where moments are asked for.

    Parameters
    ----------
    surfels : Surfels
        Of every voxel once.
    moments : ScanMoments
        Of the same voxels, sorted by voxel, as SurfelMap.moments returns them.
    removed : (E, 3) int32
        Voxels that hold nothing any more; a row of 0 points each, nan and 0 throughout.

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
    return appended(from_columns(columns), halves(sums), fields)


def moments_in(columns: Columns, voxel_size_m: float, channels: tuple[str, ...]) -> ScanMoments:
    """
    Return the moments in the columns of a cloud; those of removed voxels have 0 points.

    Parameters
    ----------
    columns : dict of str to array
        Of a decoded cloud, x, y and z among them.
    voxel_size_m : float
        Of the map.
    channels : tuple of str
        What else the map sums: intensity; red, green, blue.

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
    count = columns['num_points'].astype(np.int64)
    check_size(columns, index, count > 0, voxel_size_m)
    sums = np.stack([whole(columns[name]) for name in names], axis=1)
    total, product, view, rest = np.split(sums, (3, 9, 12), axis=1)
    return ScanMoments(
        voxel_size_m=voxel_size_m,
        key=pack_keys(index),
        count=count,
        total=np.ascontiguousarray(total),
        product=np.ascontiguousarray(product),
        view=np.ascontiguousarray(view),
        channel_names=channels,
        channels=np.ascontiguousarray(rest),
    )


def check_size(
    columns: Columns,
    index: npt.NDArray[np.int32],
    rows: npt.NDArray[np.bool_],
    voxel_size_m: float,
) -> None:
    """Refuse surfels that do not lie in their voxels."""
    position = np.stack([columns[name] for name in 'xyz'], axis=1)[rows].astype(np.float64)
    offset = np.abs(position - (index[rows] + 0.5) * voxel_size_m)
    slack = 1e-6 * (np.abs(position) + voxel_size_m)  # positions are float32
    if (offset > 0.5 * voxel_size_m + slack).any():
        raise CloudFormatError(
            f'surfels that lie outside of their voxels of {voxel_size_m:g} m; has the map of the '
            'node another map.voxel_size_m?'
        )


def halves(values: npt.NDArray[np.int64]) -> npt.NDArray[np.uint32]:
    """Return the columns of integers (K, C) as pairs, (K, 2 C) uint32: the low half first."""
    return np.ascontiguousarray(values, '<i8').view('<u4').astype(np.uint32, copy=False)


def whole(pairs: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return the integers of pairs, (K,)."""
    return np.ascontiguousarray(pairs, '<u4').view('<i8').reshape(-1).astype(np.int64)


def extended(values: npt.NDArray[Any], number: int) -> npt.NDArray[Any]:
    """Return a column with so many more rows: nan where it has such, else 0."""
    filling = np.nan if values.dtype.kind == 'f' else 0
    return np.concatenate([values, np.full(number, filling, values.dtype)])
