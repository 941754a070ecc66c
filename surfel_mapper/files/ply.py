# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surfels and points as PLY, for CloudCompare and MeshLab.

Files are binary and little endian, one vertex per surfel: x y z nx ny nz planarity curvature
num_points thickness normal_sigma radius num_scans size, channels and cov_xx to cov_zz. Numbers
are float32, exact to 1e-5 deg for normals, and uint32 for counts. Beyond 8 km
from the origin positions are doubles: float32 rounds by 0.25 m at the northings of UTM, where the
map still resolves 8 micrometres; programs that draw in float32 shift such coordinates on import.

The format is a text header and a table, so numpy alone reads and writes it. It is our own code
because plyfile, the usual library, is under the GPL, which this package is not; the tests compare
with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
import os
from pathlib import Path
import struct
from typing import Any, BinaryIO, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import open_regular
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.atomic import check_names, replace_file
from surfel_mapper.files.point_columns import Columns, RGB
from surfel_mapper.files.text_table import read_table
from surfel_mapper.mapping.surfels import covariance_columns, file_positions, quality_columns

if TYPE_CHECKING:
    from surfel_mapper.mapping.surfels import Surfels
    from surfel_mapper.tsdf.mesh import Mesh

TYPES = {
    'char': 'i1',
    'uchar': 'u1',
    'short': 'i2',
    'ushort': 'u2',
    'int': 'i4',
    'uint': 'u4',
    'float': 'f4',
    'double': 'f8',
    'int8': 'i1',
    'uint8': 'u1',
    'int16': 'i2',
    'uint16': 'u2',
    'int32': 'i4',
    'uint32': 'u4',
    'float32': 'f4',
    'float64': 'f8',
}
"""NumPy dtypes of the scalar types of PLY, each of which has an old and a new name."""

NAMES = {np.dtype(TYPES[name]): name for name in list(TYPES)[:8]}

ORDERS = {'binary_little_endian': '<', 'binary_big_endian': '>', 'ascii': '<'}

MAX_HEADER_BYTES = 65536

MAX_LIST = 65536
"""Limit of the number of values in a list of a row."""


def write_surfels(
    path: str | Path, surfels: Surfels, origin_m: npt.ArrayLike = (0.0, 0.0, 0.0)
) -> None:
    """
    Write surfels as a binary PLY, atomically.

    Parameters
    ----------
    path : str or Path
        The file; see replace_file.
    surfels : Surfels
        In the frame of the map.
    origin_m : (3,) float, m
        Added to the positions, in float64; see SurfelMap and file_positions.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    values = {
        **file_positions(path, surfels, origin_m),
        **dict(zip(('nx', 'ny', 'nz'), surfels.normal.astype(np.float32).T, strict=True)),
        'planarity': surfels.planarity.astype(np.float32),
        'curvature': surfels.curvature.astype(np.float32),
        'num_points': surfels.num_points.astype(np.uint32),
        **quality_columns(surfels),
        **channel_columns(surfels),
        **covariance_columns(surfels),
    }
    write_points(path, values)


def channel_columns(surfels: Surfels) -> dict[str, npt.NDArray[Any]]:
    """Return the mean intensity (float32) and colour (uint8), if the surfels have them."""
    columns: dict[str, npt.NDArray[Any]] = {}
    for name, values in surfels.channels.items():
        is_colour = name != 'intensity'
        columns[name] = (
            np.rint(values).astype(np.uint8) if is_colour else values.astype(np.float32)
        )
    return columns


def write_points(path: str | Path, columns: Mapping[str, npt.NDArray[Any]]) -> None:
    """
    Write columns of equal length K as the vertices of a binary PLY, atomically.

    Parameters
    ----------
    path : str or Path
        The file; see replace_file.
    columns : mapping of str to (K,) array
        At least one column of integers of up to 32 bits, float32 or float64.

    Raises
    ------
    FileFormatError
        If the file cannot be written, or the name of a column is not ASCII or has spaces.

    """
    check_names(path, columns)
    properties, table = as_table(columns)
    header = (
        'ply\nformat binary_little_endian 1.0\ncomment surfel_mapper, metres\n'
        f'element vertex {len(table)}\n{properties}end_header\n'
    )
    with replace_file(path) as file:
        file.write(header.encode('ascii'))
        file.write(table.view(np.uint8).data)


def as_table(columns: Mapping[str, npt.NDArray[Any]]) -> tuple[str, npt.NDArray[Any]]:
    """Return columns as the lines of a header and as a structured array."""
    layout = np.dtype([(name, v.dtype.newbyteorder('<')) for name, v in columns.items()])
    table = np.empty(len(next(iter(columns.values()))), layout)
    for name, values in columns.items():
        table[name] = values
    properties = ''.join(
        f'property {NAMES[values.dtype.newbyteorder("=")]} {name}\n'
        for name, values in columns.items()
    )
    return properties, table


@dataclass(frozen=True, slots=True)
class Element:
    """
    An element of a PLY file.

    Attributes
    ----------
    name, count : str, int
        Name, and number of rows.
    properties : list of (str, dtype, dtype or None)
        Name and type of each property; of a list also the type of its length.

    """

    name: str
    count: int
    properties: list[tuple[str, np.dtype[Any], np.dtype[Any] | None]]

    @property
    def has_lists(self) -> bool:
        """Whether rows may differ in size."""
        return any(length is not None for _, _, length in self.properties)

    @property
    def layout(self) -> np.dtype[Any]:
        """The smallest row: single values, and the lengths of lists."""
        return np.dtype([(name, length or type_) for name, type_, length in self.properties])


def read_points(path: str | Path) -> Columns:
    """
    Return the properties of the vertices of a PLY file, each an array of length K.

    Parameters
    ----------
    path : str or Path
        A PLY file, binary or ascii. Lists among the properties are left out, and all elements but
        the vertices: faces, cameras.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is not a PLY, has no vertices or is truncated.

    """
    columns, _ = read_elements(path, ('vertex',))
    return {name: values for name, values in columns['vertex'].items() if is_single(values)}


def read_mesh(path: str | Path) -> Mesh | None:
    """
    Return the mesh in a PLY file, binary or ascii, or None if the file has no faces.

    A face of more than three corners becomes a fan of triangles.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is damaged, or its faces are no lists of vertices.

    """
    from surfel_mapper.tsdf.mesh import Mesh

    elements, has_all = read_elements(path, ('vertex', 'face'))
    columns = elements['vertex']
    corners = [v for v in elements.get('face', {}).values() if not is_single(v)]
    number = len(next(iter(columns.values())))
    if not has_all or not any(map(len, elements['face'].values())):
        return None
    if not corners or not {'x', 'y', 'z'} <= columns.keys():
        raise FileFormatError(f'{path}: faces without a list of vertices, or no x, y, z')
    triangles = fans(corners[0])
    if not ((triangles >= 0) & (triangles < number)).all():
        raise FileFormatError(f'{path}: faces with other than the {number} vertices')
    colours = [columns[name] for name in RGB if name in columns]
    is_coloured = len(colours) == 3 and all(channel.dtype == np.uint8 for channel in colours)
    return Mesh(
        vertices=np.stack([columns[name].astype(np.float64) for name in 'xyz'], axis=1),
        triangles=triangles.astype(np.int32),
        colors=np.stack(colours, axis=1) if is_coloured else np.empty((0, 3), np.uint8),
        labels=columns['label'].astype(np.int32) if 'label' in columns else np.empty(0, np.int32),
    )


def is_single(values: npt.NDArray[Any]) -> bool:
    """Return whether a property has one value a row; lists have several, or are objects."""
    return values.ndim == 1 and values.dtype != object


def fans(corners: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return the triangles (T, 3) of faces with corners (F, C), or (F,) objects of any number."""
    if corners.dtype == object:
        rows = [(face[0], *pair) for face in corners for pair in pairwise(face[1:])]
        return np.array(rows, np.int64).reshape(-1, 3)
    columns = [[0, k, k + 1] for k in range(1, corners.shape[1] - 1)]
    return corners[:, columns].reshape(-1, 3).astype(np.int64)


def read_elements(path: str | Path, wanted: Sequence[str]) -> tuple[dict[str, Columns], bool]:
    """Return elements up to the last wanted one, and whether all of these are in the file."""
    tables: dict[str, Columns] = {}
    try:
        with open_regular(path) as file:
            elements, is_text = read_header(path, file)
            size = os.fstat(file.fileno()).st_size
            for element in elements:
                is_last = element is elements[-1]
                check_size(path, element, size - file.tell(), is_text=is_text, is_last=is_last)
                if element.has_lists:
                    tables[element.name] = list_columns(path, file, element, is_text=is_text)
                    continue
                if is_text:
                    layout, count = element.layout, element.count
                    table = read_table(path, file, layout, count, is_last=is_last)
                else:
                    content = file.read(element.count * element.layout.itemsize)
                    table = np.frombuffer(content, element.layout)
                tables[element.name] = native(table)
                if {*wanted} <= tables.keys():
                    break
    except OSError as error:
        raise FileFormatError(f'{path}: cannot be read: {error.strerror or error}') from error
    return tables, {*wanted} <= tables.keys()


def native(table: npt.NDArray[Any]) -> Columns:
    """Return the columns of a structured array, in the byte order of the machine."""
    return {
        name: np.ascontiguousarray(table[name], table.dtype[name].base.newbyteorder('='))
        for name in table.dtype.names or ()
    }


def list_columns(path: str | Path, file: BinaryIO, element: Element, *, is_text: bool) -> Columns:
    """Return the properties of an element with lists: (K, C) for lists of C values, or objects."""
    start = file.tell()
    if not is_text and (table := equal_rows(file, element)) is not None:
        lengths = {f'{name} length' for name, _, _ in element.properties}
        return {name: v for name, v in native(table).items() if name not in lengths}
    file.seek(start)
    read_row = text_row if is_text else binary_row
    try:
        rows = [read_row(file, element) for _ in range(element.count)]
    except (ValueError, IndexError, struct.error) as error:
        raise FileFormatError(
            f'{path}: {element.count} x {element.name}: other numbers than stated; truncated?'
        ) from error
    columns: Columns = {}
    for at, (name, type_, length) in enumerate(element.properties):
        values = [row[at] for row in rows]
        is_equal = length is None or len({len(row) for row in values}) == 1
        if is_equal:
            columns[name] = np.array(values).astype(type_.newbyteorder('='))
        else:
            columns[name] = np.empty(len(rows), object)
            columns[name][:] = values
    return columns


def equal_rows(file: BinaryIO, element: Element) -> npt.NDArray[Any] | None:
    """Return the rows of a binary element as a table; None if their lists differ in length."""
    start = file.tell()
    try:
        row = binary_row(file, element) if element.count else []
    except (ValueError, struct.error):
        return None
    fields: list[Any] = []
    for (name, type_, length), value in zip(element.properties, row, strict=False):
        if length is not None:
            fields.append((f'{name} length', length))
        fields.append((name, type_) if length is None else (name, type_, (len(value),)))
    layout = np.dtype(fields)
    file.seek(start)
    content = file.read(element.count * layout.itemsize)
    if not fields or len(content) < element.count * layout.itemsize:
        return None
    table = np.frombuffer(content, layout)
    lengths = [table[name] for name in layout.names or () if name.endswith(' length')]
    return table if all((values == values[0]).all() for values in lengths) else None


def binary_row(file: BinaryIO, element: Element) -> list[Any]:
    """Return the values of the next row, a tuple for a list."""
    row: list[Any] = []
    for _, type_, length in element.properties:
        number = 1 if length is None else unpack(file, length, 1)[0]
        values = unpack(file, type_, number)
        row.append(values[0] if length is None else values)
    return row


def unpack(file: BinaryIO, type_: np.dtype[Any], number: int) -> tuple[Any, ...]:
    """Return a number of values of a type; raise ValueError if there cannot be as many."""
    if not 0 <= number <= MAX_LIST:
        raise ValueError(f'a list of {number}')
    order = '>' if type_.str[0] == '>' else '<'
    return struct.unpack(f'{order}{number}{type_.char}', file.read(number * type_.itemsize))


def text_row(file: BinaryIO, element: Element) -> list[Any]:
    """Return the values of the next line, a list for a list."""
    words, row, at = list(map(float, file.readline().split())), list[Any](), 0
    for _, _, length in element.properties:
        if length is None:
            row.append(words[at])
            at += 1
            continue
        number = int(words[at])
        row.append(words[at + 1 : at + 1 + number])
        at += 1 + number
    if len(words) != at:
        raise ValueError(f'{len(words)} numbers, expected {at}')
    return row


def check_size(
    path: str | Path, element: Element, num_bytes: int, *, is_text: bool, is_last: bool
) -> None:
    """Raise FileFormatError if an element cannot have its rows in the remaining bytes."""
    row_bytes = 2 * len(element.properties) - 1 if is_text else element.layout.itemsize
    size = element.count * row_bytes
    kind = 'vertices' if element.name == 'vertex' else f'x {element.name}'
    expected = f'{num_bytes} bytes after the header, expected {size} for {element.count} {kind}'
    if size > num_bytes and not (is_text and not element.has_lists):  # read_table counts the rows
        raise FileFormatError(f'{path}: {expected}; truncated?')
    if is_last and not is_text and not element.has_lists and num_bytes - size >= row_bytes:
        raise FileFormatError(f'{path}: {expected}; is its header damaged?')


def read_header(path: str | Path, file: BinaryIO) -> tuple[list[Element], bool]:
    """
    Return the elements of a file, the vertices among them, and whether they are text.

    The file is then at the first row.
    """
    header, end, _ = file.read(MAX_HEADER_BYTES).partition(b'end_header')
    lines = [line.split() for line in header.decode('ascii', 'replace').splitlines()]
    if not end or not lines or lines[0] != ['ply']:
        raise FileFormatError(f'{path}: not a PLY file, its header is missing')
    file.seek(len(header))
    file.readline()
    lines = [line for line in lines[1:] if line and line[0] not in ('comment', 'obj_info')]
    elements: list[Element] = []
    try:
        (_, encoding, version), *declarations = lines
        order = ORDERS[encoding]
        for keyword, *words in declarations:
            if keyword == 'element':
                name, count = words
                elements.append(Element(name, int(count), []))
                continue
            *kinds, name = words
            types = [np.dtype(order + TYPES[kind]) for kind in kinds if kind != 'list']
            if keyword != 'property' or len(types) != 1 + (kinds[0] == 'list'):
                raise ValueError(f'{keyword} {" ".join(words)}')
            elements[-1].properties.append(
                (name, types[-1], None if len(types) == 1 else types[0])
            )
        for element in elements:
            _ = element.layout  # a name of two properties is refused
    except (ValueError, LookupError) as error:
        raise FileFormatError(
            f'{path}: not a PLY whose elements have properties: {error}'
        ) from error
    stated = ', '.join(f'{e.count} x {e.name} of {len(e.properties)} properties' for e in elements)
    vertices = [element for element in elements if element.name == 'vertex']
    if (
        version != '1.0'
        or len({element.name for element in elements}) < len(elements)
        or any(element.count < 0 or not element.properties for element in elements)
        or not any(length is None for e in vertices for _, _, length in e.properties)
    ):
        raise FileFormatError(
            f'{path}: version {version}, {stated or "no elements"}, expected 1.0 and vertices of '
            'at least one number each'
        )
    return elements, encoding == 'ascii'
