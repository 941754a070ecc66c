# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LAS and LAZ files of points and surfels, by laspy.

That is an extra: the formats have 30 kinds of records. On its own because it alone imports laspy.
Coordinates are scaled integers, often of a map projection, so they are returned as float64.
"""

from __future__ import annotations

import io
import os
from pathlib import Path
import struct
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import Budget, BYTES_PER_BYTE, open_regular
from surfel_mapper.errors import DependencyError, FileFormatError
from surfel_mapper.files.atomic import replace_file

if TYPE_CHECKING:
    from surfel_mapper.mapping.surfels import Surfels

SUFFIXES = ('.las', '.laz')

RGB = ('red', 'green', 'blue')

RESOLUTION_M = 1e-4
"""Unit of the coordinates that are written, m."""

MAX_STEPS = 2**31 - 1
"""Limit of a coordinate in a file, in units."""

HEADER_BYTES = 375
"""Size of the header of version 1.4; that of 1.2 has 227."""

RECORD_BYTES, EXTENDED_RECORD_BYTES = 54, 60
"""Sizes of the heads of variable length records, before and behind the points."""

PACKED_RATIO = 60
"""Memory per byte of a LAZ file, which packs a point into 3 to 10 bytes."""

COLUMN_BYTES = 40
"""Memory of a point in the columns returned."""


def read_points(path: str | Path) -> dict[str, npt.NDArray[Any]]:
    """
    Return the columns of a LAS or LAZ file.

    Returns
    -------
    dict of str to (N,) array
        x, y, z float64, m; intensity float32; timestamp float64 if the file has GPS times, s;
        red, green, blue uint8 if it has colours.

    Raises
    ------
    FileFormatError
        If it cannot be read.
    DependencyError
        If laspy is not installed.

    """
    laspy = import_laspy(path)
    try:
        check_header(path)
        las = laspy.read(str(path))
    except FileFormatError:
        raise
    except OSError as error:
        raise FileFormatError(f'{path}: cannot be read: {error.strerror or error}') from error
    except Exception as error:  # laspy passes on errors of its decoders, of many types
        raise FileFormatError(f'{path}: no LAS or LAZ file: {error}') from error
    names = set(las.point_format.dimension_names)
    columns: dict[str, npt.NDArray[Any]] = {
        name: np.ascontiguousarray(getattr(las, name), np.float64) for name in 'xyz'
    }
    columns['intensity'] = np.asarray(las.intensity, np.float32)
    if 'gps_time' in names:
        columns['timestamp'] = np.asarray(las.gps_time, np.float64)
    if set(RGB) <= names:
        values = [np.asarray(las[name]) for name in RGB]
        shift = 8 if max((int(v.max()) for v in values if v.size), default=0) > 255 else 0
        columns |= {n: (v >> shift).astype(np.uint8) for n, v in zip(RGB, values, strict=True)}
    return columns


def write_surfels(
    path: str | Path, surfels: Surfels, origin_m: npt.ArrayLike = (0.0, 0.0, 0.0)
) -> None:
    """
    Write surfels as LAS 1.4, packed if the suffix is .laz, atomically.

    Coordinates are multiples of 0.1 mm about a whole metre; normals, planarity, curvature and
    num_points are extra columns, which CloudCompare and PDAL show by name. Intensity is rounded
    to the 16 bits of the format.

    Parameters
    ----------
    path : str or Path
        The file.
    surfels : Surfels
        In the frame of the map.
    origin_m : (3,) float64, m
        Added to the positions; see SurfelMap.

    Raises
    ------
    FileFormatError
        If the file cannot be written, or the surfels are farther apart than 214 km.
    DependencyError
        If laspy is not installed.

    """
    laspy = import_laspy(path)
    has_colour = 'red' in surfels.channels
    header = laspy.LasHeader(point_format=7 if has_colour else 6, version='1.4')
    position = surfels.position + np.asarray(origin_m, np.float64)
    header.scales = np.full(3, RESOLUTION_M)
    header.offsets = np.floor(position.mean(axis=0)) if len(surfels) else np.zeros(3)
    if np.abs(position - header.offsets).max(initial=0.0) / RESOLUTION_M > MAX_STEPS:
        raise FileFormatError(f'{path}: surfels farther apart than 214 km; expected a smaller map')
    extra = {
        **dict(zip(('nx', 'ny', 'nz'), surfels.normal.astype(np.float32).T, strict=True)),
        'planarity': surfels.planarity.astype(np.float32),
        'curvature': surfels.curvature.astype(np.float32),
        'num_points': surfels.num_points.astype(np.uint32),
    }
    header.add_extra_dims([laspy.ExtraBytesParams(n, v.dtype) for n, v in extra.items()])
    las = laspy.LasData(header)
    las.x, las.y, las.z = position.T
    for name, values in extra.items():
        las[name] = values
    if 'intensity' in surfels.channels:
        las.intensity = np.clip(np.rint(surfels.channels['intensity']), 0, 65535)
    for name in RGB if has_colour else ():
        las[name] = np.rint(257.0 * surfels.channels[name]).astype(np.uint16)  # 255 is 65535
    content = io.BytesIO()
    las.write(content, do_compress=Path(path).suffix == '.laz')
    with replace_file(path) as file:
        file.write(content.getvalue())


def import_laspy(path: str | Path) -> Any:
    """Return the module laspy, or raise DependencyError with the command to install it."""
    try:
        import laspy
    except ImportError as error:
        raise DependencyError(
            f'{path}: laspy cannot be loaded ({error}). It reads and writes LAS and LAZ; install '
            "it with `pip install 'surfel_mapper[las]'`"
        ) from error
    return laspy


def check_header(path: str | Path) -> None:
    """
    Raise FileFormatError if the counts in the header do not fit the size of the file.

    laspy loops over as many records as the header states, and reads the points that are there.
    Source: the specification of LAS 1.4 of the ASPRS, table 3.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        header = file.read(HEADER_BYTES).ljust(HEADER_BYTES, b'\0')
    start, num_records, point_format, point_size, count = struct.unpack_from('<IIBHI', header, 96)
    num_extended = 0
    if header[24:26] >= b'\x01\x04':
        num_extended, count = struct.unpack_from('<IQ', header, 243)
    if num_records * RECORD_BYTES + num_extended * EXTENDED_RECORD_BYTES > size:
        raise FileFormatError(
            f'{path}: {num_records} and {num_extended} records of variable length in a file of '
            f'{size} bytes; damaged?'
        )
    is_packed = point_format & 0xC0
    if start + count * point_size > size and not is_packed:
        raise FileFormatError(
            f'{path}: {size} bytes, expected {start + count * point_size} for {count} points of '
            f'{point_size} bytes; truncated?'
        )
    ratio = PACKED_RATIO if is_packed else BYTES_PER_BYTE
    needed = count * (2 * point_size + COLUMN_BYTES)
    Budget(path, size, FileFormatError, ratio=ratio).take(needed, f'{count} points')
