# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Files of scans: the reader of each format by its ending, and folders of such files.

They state neither time nor frame; the caller supplies both. Formats that numpy does not read are
those of libraries, which extras install.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files import arrays, foreign_points, las, pcd, ply, text_points
from surfel_mapper.files.atomic import by_number
from surfel_mapper.files.point_columns import Columns, named_columns, with_one_colour
from surfel_mapper.files.raw import raw_layout, RawLayout, read_raw

READERS: dict[str, Callable[[Path], Columns]] = {
    '.ply': ply.read_points,
    '.pcd': pcd.read_points,
    **dict.fromkeys(las.SUFFIXES, las.read_points),
    **dict.fromkeys(text_points.SUFFIXES, text_points.read_points),
    **dict.fromkeys(arrays.SUFFIXES, arrays.read_points),
    '.e57': foreign_points.read_e57,
    **dict.fromkeys(('.vtk', '.vtp', '.vtu'), foreign_points.read_vtk),
    '.obj': foreign_points.read_obj,
    '.feather': foreign_points.read_feather,
}
"""The reader of each format but .bin, which takes a layout, by the ending in lower case."""

WRITERS = {'.ply': ply.write_points, '.pcd': pcd.write_points}
"""The writer of points with any columns, by the ending of the file."""

RAW = '.bin'

SUFFIXES = ('.ply', '.pcd', RAW, *list(READERS)[2:])

SHARED = ('.txt', '.csv', *arrays.SUFFIXES, '.obj')
"""Endings of other files too: times, poses, maps, meshes."""

CLOUDCOMPARE = 'scalar_'
"""Prefix of the columns in files of CloudCompare."""

ALIASES = {'Intensity': 'intensity'}

Points = tuple[npt.NDArray[Any], Columns]


def scan_files(directory: Path) -> list[Path]:
    """
    Return the files of scans in a directory, scan2 before scan10.

    Links that lead nowhere are among them, so that their readers report them as damaged. Hidden
    files are not: macOS writes a ._ file beside each. Tables, arrays and OBJ files are scans if
    there are no others and they look like points. If none does and the folder has but one ending,
    all are returned, so that their reader states the fault.
    """
    candidates = (file for file in directory.iterdir() if scan_suffix(file) in SUFFIXES)
    files = [file for file in candidates if file.is_file() or not file.exists()]
    scans = [file for file in files if scan_suffix(file) not in SHARED]
    scans = scans or [*filter(looks_like_points, files)]
    endings = {file.suffix for file in directory.iterdir() if file.name[0] != '.'}
    return sorted(scans or (files if len(endings) == 1 else []), key=by_number)


def looks_like_points(path: Path) -> bool:
    """Return whether a table, an array or an OBJ file may be points, by its beginning or end."""
    suffix = path.suffix.lower()
    try:
        if suffix in text_points.SUFFIXES:
            layout = text_points.text_layout(path)
            return layout is not None and layout.is_points
        return not (arrays.is_map(path) if suffix == '.npz' else foreign_points.has_faces(path))
    except OSError:
        return False


def scan_suffix(path: Path) -> str:
    """Return the ending of a file in lower case; empty for hidden files."""
    return '' if path.name.startswith('.') else path.suffix.lower()


def scan_reader(files: Sequence[Path], bin_columns: int | None = None) -> Callable[[Path], Points]:
    """
    Return a reader of files of one sensor: those of raw numbers have one layout.

    Raises
    ------
    FileFormatError
        If no layout fits them.

    """
    raw = [file for file in files if scan_suffix(file) == RAW]
    is_shared = len(raw) > 1 or bin_columns is not None
    return partial(read_scan, layout=raw_layout(raw, bin_columns) if raw and is_shared else None)


def read_scan(path: str | Path, layout: RawLayout | None = None) -> Points:
    """
    Return the points (N, 3), m, of a scan in a file, and its other columns.

    Parameters
    ----------
    path : str or Path
        A file of a format of SUFFIXES.
    layout : RawLayout, optional
        Columns of a .bin; without, those that fit its values.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is damaged, or has no x, y and z of floating point.

    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == RAW:
        columns = named_columns(read_raw(path, layout or raw_layout([path])))
    elif suffix in READERS:
        columns = READERS[suffix](path)
    else:
        raise FileFormatError(f'{path}: expected a scan ending in {", ".join(SUFFIXES)}')
    return scan_of(path, columns)


def scan_of(path: Path, columns: Columns) -> Points:
    """Return the points and the other columns of a file, named as elsewhere."""
    upper = [name for name in 'XYZ' if name in columns and name.lower() not in columns]
    columns |= {name.lower(): columns.pop(name) for name in upper}
    columns = {n: v.astype(np.float32) if v.dtype == np.float16 else v for n, v in columns.items()}
    missing = [name for name in 'xyz' if name not in columns]
    if missing:
        raise FileFormatError(
            f'{path}: no {", ".join(missing)} among {", ".join(columns)}; expected points'
        )
    xyz = [columns.pop(name) for name in 'xyz']
    if any(values.dtype.kind != 'f' or values.ndim != 1 for values in xyz):
        kinds = ', '.join(str(values.dtype) for values in xyz)
        raise FileFormatError(f'{path}: x, y, z of {kinds}, expected float or double')
    names = {name: name.removeprefix(CLOUDCOMPARE) for name in columns}
    named = {ALIASES.get(names[name], names[name]): values for name, values in columns.items()}
    points = np.stack(xyz).T  # column by column, as clouds are: other layouts compile anew
    return points, with_one_colour(named)
