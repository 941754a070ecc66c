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
from typing import Any, BinaryIO, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import open_regular
from surfel_mapper.errors import FileFormatError, refusing
from surfel_mapper.files.atomic import check_names, replace_file
from surfel_mapper.files.point_columns import Columns, shape_columns, table_of
from surfel_mapper.files.text_table import read_table
from surfel_mapper.mapping.channels import RGB
from surfel_mapper.mapping.surfels import covariance_columns, file_positions, quality_columns

if TYPE_CHECKING:
    from surfel_mapper.mapping.surfels import Surfels
    from surfel_mapper.tsdf.mesh import Mesh

CODES = ('i1', 'u1', 'i2', 'u2', 'i4', 'u4', 'f4', 'f8')

OLD_NAMES = ('char', 'uchar', 'short', 'ushort', 'int', 'uint', 'float', 'double')

NEW_NAMES = ('int8', 'uint8', 'int16', 'uint16', 'int32', 'uint32', 'float32', 'float64')

TYPES = {**dict(zip(OLD_NAMES, CODES, strict=True)), **dict(zip(NEW_NAMES, CODES, strict=True))}
"""NumPy dtypes of the scalar types of PLY, each of which has an old and a new name."""

NAMES = {np.dtype(code): name for name, code in zip(OLD_NAMES, CODES, strict=True)}

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
        **shape_columns(surfels),
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
    table = table_of(columns)
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
    return read_elements(path, ('vertex',))['vertex']


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

    elements = read_elements(path, ('vertex', 'face'))
    columns, triangles = elements['vertex'], elements.get('face', {}).get('corners')
    if triangles is None or not len(triangles):
        return None
    if not {'x', 'y', 'z'} <= columns.keys():
        raise FileFormatError(f'{path}: faces, but no x, y, z of vertices')
    number = len(columns['x'])
    if not ((triangles >= 0) & (triangles < number)).all():
        raise FileFormatError(f'{path}: faces with other than the {number} vertices')
    colours = [columns[name] for name in RGB if name in columns]
    is_coloured = len(colours) == 3 and all(channel.dtype == np.uint8 for channel in colours)
    return Mesh(
        vertices=np.stack([columns[name].astype(np.float64) for name in 'xyz'], axis=1),
        triangles=triangles.astype(np.int32),
        colors=np.stack(colours, axis=1) if is_coloured else np.empty((0, 3), np.uint8),
        labels=columns.get('label', np.empty(0)).astype(np.int32),
    )


def read_elements(path: str | Path, wanted: Sequence[str]) -> dict[str, Columns]:
    """Return the elements of a file up to the last wanted one; those of faces as triangles."""
    tables: dict[str, Columns] = {}
    with refusing(path), open_regular(path) as file:
        elements, is_text = read_header(path, file)
        size = os.fstat(file.fileno()).st_size
        for element in elements:
            is_last = element is elements[-1]
            check_size(path, element, size - file.tell(), is_text=is_text, is_last=is_last)
            if element.name == 'face' and 'face' in wanted:
                tables['face'] = {'corners': read_faces(path, file, element, is_text=is_text)}
            else:
                columns = read_columns(path, file, element, is_text=is_text, is_last=is_last)
                tables[element.name] = columns
            if {*wanted} <= tables.keys():
                break
    return tables


def read_columns(
    path: str | Path, file: BinaryIO, element: Element, *, is_text: bool, is_last: bool
) -> Columns:
    """Return the properties of the next element of a file, without those that are lists."""
    if element.has_lists:
        singles = [(n, t) for n, t, length in element.properties if length is None]
        at = [row for row, (_, _, length) in enumerate(element.properties) if length is None]
        rows = list_rows(path, file, element, is_text=is_text)
        return native(np.array([tuple(row[k] for k in at) for row in rows], np.dtype(singles)))
    if is_text:
        return native(read_table(path, file, element.layout, element.count, is_last=is_last))
    content = file.read(element.count * element.layout.itemsize)
    return native(np.frombuffer(content, element.layout))


def read_faces(
    path: str | Path, file: BinaryIO, element: Element, *, is_text: bool
) -> npt.NDArray[Any]:
    """Return the triangles (T, 3) of the next element, whose first list has the corners."""
    lists = [at for at, (_, _, length) in enumerate(element.properties) if length is not None]
    if not lists:
        raise FileFormatError(f'{path}: faces without a list of vertices')
    if not is_text and (table := rows_of_three(file, element)) is not None:
        return np.asarray(table[element.properties[lists[0]][0]])
    faces = [row[lists[0]] for row in list_rows(path, file, element, is_text=is_text)]
    fans = [(face[0], *pair) for face in faces for pair in pairwise(face[1:])]
    return np.array(fans, np.int64).reshape(-1, 3)


def rows_of_three(file: BinaryIO, element: Element) -> npt.NDArray[Any] | None:
    """Return the rows of a binary element as a table; None if a list has not three values."""
    fields: list[Any] = []
    for name, type_, length in element.properties:
        fields += [(name, type_)] if length is None else []
        fields += [] if length is None else [(f'{name} length', length), (name, type_, (3,))]
    start, layout = file.tell(), np.dtype(fields)
    content = file.read(element.count * layout.itemsize)
    if len(content) == element.count * layout.itemsize:
        table = np.frombuffer(content, layout)
        if all((table[n] == 3).all() for n in layout.names or () if n.endswith(' length')):
            return table
    file.seek(start)
    return None


def native(table: npt.NDArray[Any]) -> Columns:
    """Return the columns of a structured array, in the byte order of the machine."""
    return {
        name: np.ascontiguousarray(table[name], table.dtype[name].base.newbyteorder('='))
        for name in table.dtype.names or ()
    }


def list_rows(
    path: str | Path, file: BinaryIO, element: Element, *, is_text: bool
) -> list[list[Any]]:
    """Return the rows of an element with lists, each a list of numbers and of arrays or lists."""
    read_row = text_row if is_text else binary_row
    try:
        return [read_row(file, element) for _ in range(element.count)]
    except (ValueError, IndexError) as error:
        raise FileFormatError(
            f'{path}: {element.count} x {element.name}: other numbers than stated; truncated?'
        ) from error


def binary_row(file: BinaryIO, element: Element) -> list[Any]:
    """Return the values of the next row, an array for a list."""
    row: list[Any] = []
    for _, type_, length in element.properties:
        number = 1 if length is None else int(unpack(file, length, 1)[0])
        values = unpack(file, type_, number)
        row.append(values[0] if length is None else values)
    return row


def unpack(file: BinaryIO, type_: np.dtype[Any], number: int) -> npt.NDArray[Any]:
    """Return a number of values of a type; raise ValueError if there cannot be as many."""
    if not 0 <= number <= MAX_LIST:
        raise ValueError(f'a list of {number}')
    return np.frombuffer(file.read(number * type_.itemsize), type_, number)


def text_row(file: BinaryIO, element: Element) -> list[Any]:
    """Return the values of the next line, a list for a list."""
    words, row = list(map(float, file.readline().split())), list[Any]()
    for _, _, length in element.properties:
        if length is None:
            row.append(words.pop(0))
            continue
        number = int(words[0])
        if not 0 <= number < len(words):
            raise ValueError(f'a list of {number}')
        row.append(words[1 : 1 + number])
        del words[: 1 + number]
    if words:
        raise ValueError(f'{len(words)} numbers too many')
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
