# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Columns of points: names for tables without a header, and one form of colour for all formats.

A colour is the column ``rgb``, (N, 3) uint8, whatever the file has: red green blue, diffuse_red
(MeshLab), r g b, as bytes, 16 bits or 0 to 1, or packed into 32 bits as PCL does.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.channels import joined, RGB, three_channels

if TYPE_CHECKING:
    from surfel_mapper.mapping.surfels import Surfels

Columns = dict[str, npt.NDArray[Any]]

PACKED = ('rgb', 'rgba')

NORMALS = ('nx', 'ny', 'nz')

NORMAL_NAMES = (NORMALS, ('normal_x', 'normal_y', 'normal_z'))
"""Names of normals in files."""


def shape_columns(surfels: Surfels) -> Columns:
    """Return normal, planarity and curvature of surfels, float32, and their points, uint32."""
    return {
        **dict(zip(NORMALS, surfels.normal.astype(np.float32).T, strict=True)),
        'planarity': surfels.planarity.astype(np.float32),
        'curvature': surfels.curvature.astype(np.float32),
        'num_points': surfels.num_points.astype(np.uint32),
    }


def normals_in(columns: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.float64] | None:
    """Return the normals in the columns of a file, (N, 3); None without."""
    for names in NORMAL_NAMES:
        if columns.keys() >= {*names}:
            return np.column_stack([columns[name] for name in names]).astype(np.float64)
    return None


def table_of(columns: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[Any]:
    """Return columns of equal length as a structured array of little endian values."""
    layout = np.dtype([(name, v.dtype.newbyteorder('<')) for name, v in columns.items()])
    table = np.empty(len(next(iter(columns.values()))), layout)
    for name, values in columns.items():
        table[name] = values
    return table


def named_columns(table: npt.NDArray[Any]) -> Columns:
    """
    Name the columns of a table (N, C) by their values; the first three are x y z.

    The fourth is the intensity and the fifth the ring, if they can be. The last three of six or
    seven columns are a colour or a normal, if they can be: XYZRGB, PTS.
    """
    width = table.shape[1]
    names = ['x', 'y', 'z', *(f'column_{at}' for at in range(3, width))]
    if width > 3 and (table[:, 3] >= 0.0).all():
        names[3] = 'intensity'
    if width > 4 and is_whole(table[:, 4]):
        names[4] = 'ring'
    for at in (3, 4) if width == 7 else (3,) if width == 6 else ():
        if is_colour(table[:, at : at + 3]):
            names[at : at + 3] = RGB
        elif np.allclose((table[:, at : at + 3] ** 2).sum(axis=1), 1.0, atol=1e-3):
            names[at : at + 3] = NORMALS
    return dict(zip(names, np.ascontiguousarray(table.T), strict=True))


def is_whole(values: npt.NDArray[Any]) -> bool:
    """Return whether values are whole numbers from 0 on."""
    return bool(((values >= 0.0) & (values == np.rint(values))).all())


def is_colour(channels: npt.NDArray[Any]) -> bool:
    """Return whether three columns may be a colour: bytes, or 0 to 1."""
    is_share = bool(((channels >= 0.0) & (channels <= 1.0)).all())
    return is_share or (is_whole(channels) and bool((channels <= 255.0).all()))


def with_one_colour(columns: Mapping[str, npt.NDArray[Any]]) -> Columns:
    """Return columns with ``rgb``, (N, 3) uint8, instead of any form of colour."""
    renamed = dict(columns)
    if names := three_channels(columns):
        uncoloured = {name: values for name, values in columns.items() if name not in names}
        return {**uncoloured, 'rgb': joined(columns, names)}
    for name in PACKED:
        packed = columns.get(name)
        if packed is not None and packed.ndim == 1 and packed.dtype.itemsize == 4:
            bits = np.ascontiguousarray(renamed.pop(name)).view(np.uint32)
            channels = np.stack([bits >> shift & 255 for shift in (16, 8, 0)], axis=1)
            return {**renamed, 'rgb': channels.astype(np.uint8)}
    return renamed
