# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Folders of scans, one file each: PLY, PCD, LAS, LAZ, and the raw float32 of KITTI and nuScenes.

Such files state neither time nor frame; the caller supplies both.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import open_regular
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files import las, pcd, ply
from surfel_mapper.files.atomic import by_number

SUFFIXES = ('.ply', '.pcd', '.bin', *las.SUFFIXES)

RAW_COLUMNS = {'.bin': 4, '.pcd.bin': 5}
"""Float32 numbers per point: KITTI x y z intensity, nuScenes x y z intensity ring."""

EXTRA = ('intensity', 'ring')

ALIASES = {'scalar_intensity': 'intensity', 'scalar_Intensity': 'intensity'}
"""Names of columns in files of CloudCompare, and ours."""

Columns = dict[str, npt.NDArray[Any]]


def scan_files(directory: Path) -> list[Path]:
    """
    Return the files of scans in a directory, scan2 before scan10.

    Links that lead nowhere are among them, so that their readers report them as damaged.
    """
    found = (file for file in directory.iterdir() if scan_suffix(file) in SUFFIXES)
    files = [file for file in found if file.is_file() or not file.exists()]
    return sorted(files, key=by_number)


def scan_suffix(path: Path) -> str:
    """Return the ending of a file in lower case: some programs write .PCD."""
    return path.suffix.lower()


def read_scan(path: str | Path) -> tuple[npt.NDArray[Any], Columns]:
    """
    Return the points (N, 3), m, of a scan in a file, and its other columns.

    Parameters
    ----------
    path : str or Path
        A .ply, .pcd, .las or .laz, a .bin of four or a .pcd.bin of five float32 a point; the
        ending in capitals or not.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is damaged, or has no x, y and z of floating point.

    """
    suffix = scan_suffix(Path(path))
    if suffix == '.bin':
        return read_raw(Path(path))
    if suffix not in SUFFIXES:
        raise FileFormatError(f'{path}: expected a scan ending in {", ".join(SUFFIXES)}')
    readers = {'.ply': ply.read_points, '.pcd': pcd.read_points}
    columns = readers.get(suffix, las.read_points)(path)
    missing = [name for name in 'xyz' if name not in columns]
    if missing:
        raise FileFormatError(
            f'{path}: no {", ".join(missing)} among {", ".join(columns)}; expected points'
        )
    xyz = [columns.pop(name) for name in 'xyz']
    if any(values.dtype.kind != 'f' or values.ndim != 1 for values in xyz):
        kinds = ', '.join(str(values.dtype) for values in xyz)
        raise FileFormatError(f'{path}: x, y, z of {kinds}, expected float or double')
    if {'red', 'green', 'blue'} <= columns.keys():
        columns['rgb'] = np.stack([columns.pop(n) for n in ('red', 'green', 'blue')], axis=1)
    points = np.stack(xyz).T  # column by column, as clouds are: other layouts compile anew
    return points, {ALIASES.get(n, n): values for n, values in columns.items()}


def read_raw(path: Path) -> tuple[npt.NDArray[Any], Columns]:
    """Return points and columns of a file of raw float32."""
    width = RAW_COLUMNS['.pcd.bin' if path.name.lower().endswith('.pcd.bin') else '.bin']
    try:
        with open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size % (4 * width):
                raise FileFormatError(
                    f'{path}: {size} bytes, expected {4 * width} for every point ({width} float32)'
                )
            table = np.fromfile(file, '<f4').reshape(-1, width)
    except OSError as error:
        raise FileFormatError(f'{path}: cannot be read: {error.strerror or error}') from error
    extra = {name: table[:, 3 + at].copy() for at, name in enumerate(EXTRA[: width - 3])}
    return np.asfortranarray(table[:, :3]), extra
