# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Points as arrays of numpy, .npy and .npz.

A .npy is an array (N, 3 or more), organised (H, W, 3 or more), or with fields x, y, z. An .npz has
such an array, by its name or the longest, perhaps with one of colours and of other columns, or
arrays x, y and z.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
import zipfile

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import open_regular
from surfel_mapper.errors import FileFormatError, refusing
from surfel_mapper.files.point_columns import Columns, named_columns, NORMALS
from surfel_mapper.files.state import MANIFEST
from surfel_mapper.mapping.channels import RGB

SUFFIXES = ('.npy', '.npz')

NAMES = ('points', 'xyz', 'pc', 'pcd', 'pcl', 'cloud', 'pointcloud', 'point_cloud', 'coords')
"""Names of the points among several arrays; else the longest array is taken."""

TRIPLES = {'colors': RGB, 'colours': RGB, 'rgb': RGB, 'normals': NORMALS}
"""Names of arrays (N, 3) beside the points, and of their columns."""

MAX_COLUMNS = 64
"""Limit of the columns of points; longer rows are images."""


def is_map(path: Path) -> bool | None:
    """Return whether an .npz is a map of this package; None if it cannot be read."""
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            return MANIFEST in archive.namelist()
    except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError):
        return None


def is_cloud(path: Path) -> bool:
    """Return whether a file is an .npz of points; others may be maps, damaged ones too."""
    return path.suffix.lower() == '.npz' and is_map(path) is False


def read_points(path: str | Path) -> Columns:
    """
    Return the columns of points in a file of numpy.

    Raises
    ------
    FileFormatError
        If it cannot be read, has no such array, pickled objects, or a map.

    """
    with refusing(path), open_regular(path) as file:
        if Path(path).suffix.lower() == '.npy':
            return columns_of(path, np.load(file, allow_pickle=False))
        if is_map(Path(path)):
            raise FileFormatError(
                f'{path}: a map, expected points; merge, extract, evaluate and view read maps'
            )
        with np.load(file, allow_pickle=False) as archive:
            return columns_of_arrays(path, {name: archive[name] for name in archive.files})


def columns_of(path: str | Path, array: npt.NDArray[Any]) -> Columns:
    """Return the columns of one array."""
    if array.dtype.names is not None:
        return {name.lower(): np.ascontiguousarray(array[name]) for name in array.dtype.names}
    if array.ndim < 2 or not 3 <= array.shape[-1] <= MAX_COLUMNS or array.dtype.kind != 'f':
        raise FileFormatError(
            f'{path}: {array.dtype} {array.shape}, expected floats (N, 3) to (N, {MAX_COLUMNS})'
        )
    return named_columns(array.reshape(-1, array.shape[-1]))


def columns_of_arrays(path: str | Path, arrays: Mapping[str, npt.NDArray[Any]]) -> Columns:
    """Return the columns of several arrays: those of points, and those of the same length."""
    if {*'xyz'} <= arrays.keys():
        columns: Columns = {axis: np.ravel(arrays[axis]) for axis in 'xyz'}
    else:
        shaped = {
            name: len(array)
            for name, array in arrays.items()
            if (array.ndim == 2 or (array.ndim == 3 and name in NAMES)) and name not in TRIPLES
            if 3 <= array.shape[-1] <= MAX_COLUMNS
        }
        longest = [name for name in shaped if shaped[name] == max(shaped.values())]
        named = [name for name in NAMES if name in shaped] or longest
        if not named or (len(named) > 1 and named == longest):
            shapes = ', '.join(f'{name} {array.shape}' for name, array in arrays.items())
            raise FileFormatError(f'{path}: arrays {shapes}, expected one of (N, 3) named points')
        columns = columns_of(path, arrays[named[0]])
    number = len(columns['x'])
    for name, array in arrays.items():
        if name in TRIPLES and array.shape == (number, 3):
            columns |= dict(zip(TRIPLES[name], array.T, strict=True))
        elif array.shape == (number,):
            columns[name] = array
    return columns
