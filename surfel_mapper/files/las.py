# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LAS and LAZ files of points, read by laspy (an extra: the formats have 30 kinds of records).

On its own because it alone imports laspy. Coordinates are scaled integers, often of a map
projection, so they are returned as float64.
"""

from __future__ import annotations

import os
from pathlib import Path
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import Budget, BYTES_PER_BYTE
from surfel_mapper.errors import DependencyError, FileFormatError

SUFFIXES = ('.las', '.laz')

RGB = ('red', 'green', 'blue')


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
    try:
        import laspy
    except ImportError as error:
        raise DependencyError(
            f'{path}: laspy cannot be loaded ({error}). It reads LAS and LAZ; install it with '
            "`pip install 'surfel_mapper[las]'`"
        ) from error
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


def check_header(path: str | Path) -> None:
    """
    Raise FileFormatError if the counts in the header do not fit the size of the file.

    laspy loops over as many records as the header states, and reads the points that are there.
    Source: the specification of LAS 1.4 of the ASPRS, table 3.
    """
    with open(path, 'rb') as file:
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
