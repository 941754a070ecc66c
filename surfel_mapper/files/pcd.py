# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surfels and points as PCD, for PCL and tools built on it.

Files are written binary with the columns of ~/normals, including normal_x normal_y normal_z
curvature, the names of PCL's PointNormal. All are float32, as in PCL's point types: PCL silently
drops a field x of doubles. VIEWPOINT, the pose of the sensor, is read and written. All encodings
are read: ascii, binary, and binary_compressed, whose columns are packed with LZF, which the extra
``formats`` installs.

The format is a text header and a table, so numpy alone reads and writes it: a library (pypcd4,
Open3D) would be one more dependency for 200 lines, and neither refuses truncated files. The tests
compare with pypcd4.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
import os
from pathlib import Path
import struct
from typing import Any, BinaryIO, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import MAX_SQUARE_ERROR
from surfel_mapper.budget import open_regular
from surfel_mapper.errors import FileFormatError, refusing
from surfel_mapper.files.atomic import check_names, replace_file
from surfel_mapper.files.point_columns import Columns, table_of
from surfel_mapper.files.text_table import read_table
from surfel_mapper.libraries import library
from surfel_mapper.mapping.channels import RGB
from surfel_mapper.mapping.surfels import file_positions, packed_rgb, surfel_columns

if TYPE_CHECKING:
    from surfel_mapper.mapping.surfels import Surfels

KINDS = {'f': 'F', 'i': 'I', 'u': 'U'}

SIZES = {'F': (4, 8), 'I': (1, 2, 4, 8), 'U': (1, 2, 4, 8)}
"""Valid sizes of each type, bytes."""

MAX_HEADER_BYTES = 65536

MAX_COUNT = 4096
"""Limit of the count of a field; feature histograms have some hundreds."""

MAX_POINT_BYTES = 65536
"""Limit of the size of a point."""

PADDING = 4096
"""Most zero bytes that may follow the points; the Point Cloud Library adds up to a page."""

ORIGIN = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""Viewpoint of points in the frame of the sensor."""


@dataclass(frozen=True, slots=True)
class PcdHeader:
    """Layout, number and encoding of the points and viewpoint, by the text header of a file."""

    layout: np.dtype[Any]
    num_points: int
    encoding: str
    viewpoint: tuple[float, ...]


def write_surfels(
    path: str | Path, surfels: Surfels, origin_m: npt.ArrayLike = (0.0, 0.0, 0.0)
) -> None:
    """
    Write surfels as a binary PCD, atomically.

    Parameters
    ----------
    path : str or Path
        The file; see replace_file.
    surfels : Surfels
        In the frame of the map.
    origin_m : (3,) float, m
        Added to the positions; see file_positions.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    write_points(path, {**surfel_columns(surfels), **file_positions(path, surfels, origin_m)})


def write_points(
    path: str | Path,
    columns: Mapping[str, npt.NDArray[Any]],
    viewpoint: Sequence[float] = ORIGIN,
) -> None:
    """
    Write columns of equal length K as a binary PCD, atomically.

    The bytes red, green and blue become ``rgb``, which PCL and CloudCompare draw.

    Parameters
    ----------
    path : str or Path
        The file; see replace_file.
    columns : mapping of str to (K,) array
        At least one column of integers, float32 or float64.
    viewpoint : 7 floats
        Pose of the sensor, x y z qw qx qy qz.

    Raises
    ------
    FileFormatError
        If the file cannot be written, or the name of a column is not ASCII or has spaces.

    """
    check_names(path, columns)
    if columns.keys() >= {*RGB} and all(columns[name].dtype == np.uint8 for name in RGB):
        rgb = packed_rgb(*(columns[name] for name in RGB))
        columns = {**{k: v for k, v in columns.items() if k not in RGB}, 'rgb': rgb}
    table = table_of(columns)
    types = [values.dtype for values in columns.values()]
    header = (
        '# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n'
        f'FIELDS {" ".join(columns)}\n'
        f'SIZE {" ".join(str(type_.itemsize) for type_ in types)}\n'
        f'TYPE {" ".join(KINDS[type_.kind] for type_ in types)}\n'
        f'COUNT {" ".join("1" for _ in types)}\n'
        f'WIDTH {len(table)}\nHEIGHT 1\nVIEWPOINT {" ".join(f"{v:.16g}" for v in viewpoint)}\n'
        f'POINTS {len(table)}\nDATA binary\n'
    )
    with replace_file(path) as file:
        file.write(header.encode('ascii'))
        file.write(table.view(np.uint8).data)


def read_points(path: str | Path) -> Columns:
    """
    Return the fields of the points of a PCD file, each (K,), or (K, C) if its count is C > 1.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is not a PCD, is truncated or damaged.
    DependencyError
        If it is binary_compressed and the module lzf is not installed.

    """
    with refusing(path), open_regular(path) as file:
        header = read_header(path, file)
        if header.encoding == 'binary_compressed':
            return compressed_columns(path, header, file)
        if header.encoding == 'binary':
            table = binary_table(path, header, file)
        else:
            table = read_table(path, file, header.layout, header.num_points)
        names = header.layout.names or ()
        return {name: np.ascontiguousarray(table[name]) for name in names}


def read_viewpoint(path: str | Path) -> tuple[float, ...]:
    """
    Return the pose of the sensor that a PCD file states, x y z qw qx qy qz; ORIGIN without one.

    Raises
    ------
    FileFormatError
        If the file cannot be read or is not a PCD.

    """
    with refusing(path), open_regular(path) as file:
        return read_header(path, file).viewpoint


def read_header(path: str | Path, file: BinaryIO) -> PcdHeader:
    """Return the parsed header; the file is then at the first point."""
    words: dict[str, list[str]] = {}
    while 'DATA' not in words:
        line = file.readline(MAX_HEADER_BYTES)
        if not line or file.tell() > MAX_HEADER_BYTES:
            raise FileFormatError(f'{path}: not a PCD file, its header is missing')
        keyword, *values = line.decode('ascii', 'replace').partition('#')[0].split() or ['']
        words[keyword] = values
    try:
        names, kinds = words['FIELDS'], words['TYPE']
        sizes = [int(word) for word in words['SIZE']]
        counts = [int(word) for word in words.get('COUNT', ['1'] * len(names))]
        stated = [int(words[name][0]) for name in ('WIDTH', 'HEIGHT') if name in words]
        is_stated = 'POINTS' in words or len(stated) < 2
        num_points = int(words['POINTS'][0]) if is_stated else math.prod(stated)
        if len(stated) == 2 and stated[0] * stated[1] not in (0, num_points):
            raise ValueError(f'WIDTH {stated[0]}, HEIGHT {stated[1]}, POINTS {num_points}')
        (encoding,) = words['DATA']
        viewpoint = tuple(map(float, words.get('VIEWPOINT') or ORIGIN))
        is_pose = len(viewpoint) == 7 and all(map(math.isfinite, viewpoint))
        if not is_pose or abs(math.hypot(*viewpoint[3:]) ** 2 - 1.0) > MAX_SQUARE_ERROR:
            viewpoint = ORIGIN  # some programs write zeros
        fields = [
            field_of(*stated, number)
            for number, stated in enumerate(zip(names, kinds, sizes, counts, strict=True))
        ]
        layout = np.dtype(fields)
        if not fields or layout.itemsize > MAX_POINT_BYTES:
            raise ValueError('no fields' if not fields else f'points of {layout.itemsize} bytes')
    except (LookupError, ValueError) as error:
        problem = f'no {error}' if isinstance(error, KeyError) else error
        raise FileFormatError(f'{path}: inconsistent PCD header: {problem}') from error
    if num_points < 0 or encoding not in ('ascii', 'binary', 'binary_compressed'):
        raise FileFormatError(
            f'{path}: {num_points} points, DATA {encoding}, expected ascii, binary or '
            'binary_compressed'
        )
    return PcdHeader(layout, num_points, encoding, viewpoint)


def field_of(name: str, kind: str, size: int, count: int, number: int) -> tuple[Any, ...]:
    """Return a field for np.dtype; padding, named _, gets a unique name."""
    if size not in SIZES[kind] or not 1 <= count <= MAX_COUNT:
        raise ValueError(f'field {name} of type {kind}, size {size}, count {count}')
    unique = f'_{number}' if name == '_' else name
    code = f'<{kind.lower()}{size}'
    return (unique, code) if count == 1 else (unique, code, (count,))


def binary_table(path: str | Path, header: PcdHeader, file: BinaryIO) -> npt.NDArray[Any]:
    """Return the points of an uncompressed file."""
    num_bytes = os.fstat(file.fileno()).st_size - file.tell()
    size = header.num_points * header.layout.itemsize
    if size > num_bytes:
        raise FileFormatError(
            f'{path}: {num_bytes} bytes after the header, expected {size} for {header.num_points} '
            'points; truncated?'
        )
    content = file.read(size)
    is_padded = num_bytes - size <= PADDING and not any(file.read(PADDING))
    if num_bytes - size >= header.layout.itemsize and not is_padded:
        raise FileFormatError(
            f'{path}: {num_bytes} bytes after the header, expected {size} for {header.num_points} '
            'points; is its header damaged?'
        )
    return np.frombuffer(content, header.layout)


def compressed_columns(path: str | Path, header: PcdHeader, file: BinaryIO) -> Columns:
    """Return the fields of the points of a compressed file, which is stored field by field."""
    lzf = library('lzf', 'unpacks compressed PCD files', "'surfel_mapper[formats]'")
    sizes = file.read(8)
    packed_size, size = struct.unpack('<II', sizes.ljust(8, b'\0'))
    packed = file.read(packed_size)
    expected = header.num_points * header.layout.itemsize
    if len(packed) < packed_size or len(sizes) < 8 or size != expected:
        raise FileFormatError(
            f'{path}: {len(packed)} of {packed_size} packed bytes, for {size} bytes of points, '
            f'expected {expected}; truncated?'
        )
    try:
        content = lzf.decompress(packed, size) if size else b''
    except ValueError as error:
        raise FileFormatError(f'{path}: damaged: {error}') from error
    if content is None or len(content) != size:
        raise FileFormatError(f'{path}: damaged: its points cannot be unpacked')
    columns, at = {}, 0
    for name in header.layout.names or ():
        field = header.layout[name]
        shape = (header.num_points, *field.shape)
        column = np.frombuffer(content, field.base, math.prod(shape), at).reshape(shape).copy()
        columns[name] = column
        at += column.nbytes
    return columns
