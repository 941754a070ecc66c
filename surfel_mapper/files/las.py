# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LAS and LAZ files of points, read by laspy (an extra: the formats have 30 kinds of records).

On its own because it alone imports laspy. Coordinates are scaled integers, often of a map
projection, so they are returned as float64.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import DependencyError, FileFormatError

SUFFIXES = ('.las', '.laz')

RGB = ('red', 'green', 'blue')


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
        las = laspy.read(str(path))
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
