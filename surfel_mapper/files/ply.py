# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surfels and points as PLY, for CloudCompare and MeshLab.

Files are binary and little endian, one vertex per surfel: x y z nx ny nz planarity curvature
num_points. Positions are doubles: float32 rounds by 0.5 mm at 10 km from the origin and by 0.25 m
at the northings of UTM, where the map still resolves 8 micrometres; programs that draw in float32
shift such coordinates on import. The other properties are float32, exact to 1e-5 deg for normals,
and uint32 for counts.

The format is a text header and a table, so numpy alone reads and writes it. It is our own code
because plyfile, the usual library, is under the GPL, which this package is not; the tests compare
with it.
"""

from __future__ import annotations

from collections.abc import Mapping
import os
from pathlib import Path
from typing import Any, BinaryIO, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import open_regular
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.atomic import check_names, replace_file
from surfel_mapper.files.text_table import read_table

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

RGB = ('red', 'green', 'blue')


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
        Added to the positions, in float64; see SurfelMap.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    values = {
        **dict(zip('xyz', (surfels.position + np.asarray(origin_m)).T, strict=True)),
        **dict(zip(('nx', 'ny', 'nz'), surfels.normal.astype(np.float32).T, strict=True)),
        'planarity': surfels.planarity.astype(np.float32),
        'curvature': surfels.curvature.astype(np.float32),
        'num_points': surfels.num_points.astype(np.uint32),
        **channel_columns(surfels),
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


def read_points(path: str | Path) -> dict[str, npt.NDArray[Any]]:
    """
    Return the properties of the vertices of a PLY file, each an array of length K.

    Parameters
    ----------
    path : str or Path
        A PLY file, binary or ascii. Its first element must be the vertices, with scalar
        properties; later elements (faces) are not read.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is not a PLY, has another structure or is truncated.

    """
    try:
        with open_regular(path) as file:
            file_size = os.fstat(file.fileno()).st_size
            count, layout, is_text, is_last = read_header(path, file)
            if is_text:
                table = read_table(path, file, layout, count, is_last=is_last)
            else:
                left = file_size - file.tell()
                check_size(path, count, layout, left, is_last=is_last)
                table = np.frombuffer(file.read(count * layout.itemsize), layout)
            return {
                name: np.ascontiguousarray(table[name], layout[name].newbyteorder('='))
                for name in layout.names or ()
            }
    except OSError as error:
        raise FileFormatError(f'{path}: cannot be read: {error.strerror or error}') from error


def read_mesh(path: str | Path) -> Mesh | None:
    """
    Return the mesh in a binary PLY file, or None if the file has no faces.

    Parameters
    ----------
    path : str or Path
        A PLY file whose first element is the vertices and whose second one is the faces, triangles
        with the property vertex_indices (or vertex_index) only.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is damaged, a text file with faces, or has other faces.

    """
    from surfel_mapper.tsdf.mesh import Mesh

    try:
        with open_regular(path) as file:
            layout, count = read_faces_header(path, file)
            if layout is None or not count:
                return None
            number, vertex, is_text, _ = read_header(path, file)
            if is_text:
                raise FileFormatError(f'{path}: faces as text, expected a binary PLY')
            file_size = os.fstat(file.fileno()).st_size
            needed = number * vertex.itemsize + count * layout.itemsize
            if needed > file_size - file.tell():
                raise FileFormatError(
                    f'{path}: {file_size - file.tell()} bytes after the header, expected {needed} '
                    f'for {number} vertices and {count} triangles'
                )
            columns = np.frombuffer(file.read(number * vertex.itemsize), vertex)
            faces = np.frombuffer(file.read(count * layout.itemsize), layout)
    except OSError as error:
        raise FileFormatError(f'{path}: cannot be read: {error.strerror or error}') from error
    corners = faces['corners'].astype(np.int32)
    if (faces['count'] != 3).any() or (corners < 0).any() or (corners >= number).any():
        raise FileFormatError(f'{path}: faces with other than 3 of the {number} vertices')
    names = vertex.names or ()
    if not {'x', 'y', 'z'} <= set(names):
        raise FileFormatError(f'{path}: vertices without x, y, z')
    colours = [columns[name] for name in RGB if name in names]
    is_coloured = len(colours) == 3 and all(each.dtype == np.uint8 for each in colours)
    return Mesh(
        vertices=np.stack([columns[name].astype(np.float64) for name in 'xyz'], axis=1),
        triangles=corners,
        colors=np.stack(colours, axis=1) if is_coloured else np.empty((0, 3), np.uint8),
        labels=columns['label'].astype(np.int32) if 'label' in names else np.empty(0, np.int32),
    )


def read_faces_header(path: str | Path, file: BinaryIO) -> tuple[np.dtype[Any] | None, int]:
    """Return layout and number of the faces, None if there are none; the file is at its begin."""
    header, found, _ = file.read(MAX_HEADER_BYTES).partition(b'end_header')
    file.seek(0)
    lines = [line.split() for line in header.decode('ascii', 'replace').splitlines()]
    at = next((i for i, line in enumerate(lines) if line[:2] == ['element', 'face']), None)
    if not found or at is None:
        return None, 0
    try:
        order = next(ORDERS[line[1]] for line in lines if line[:1] == ['format'])
        (_, _, count), (_, kind, of_count, of_corner, name), *others = lines[at:]
        layout = np.dtype(
            [('count', order + TYPES[of_count]), ('corners', order + TYPES[of_corner], (3,))]
        )
        number = int(count)
    except (ValueError, KeyError, StopIteration) as error:
        raise FileFormatError(f'{path}: faces that are no list of vertices') from error
    if kind != 'list' or 'property' in [line[0] for line in others if line] or number < 0:
        raise FileFormatError(f'{path}: faces with properties beside {name}, expected that only')
    return layout, number


def check_size(
    path: str | Path, count: int, layout: np.dtype[Any], left: int, *, is_last: bool
) -> None:
    """Raise FileFormatError if the vertices of a binary file do not fill the bytes left."""
    size = count * layout.itemsize
    if size > left:
        raise FileFormatError(
            f'{path}: {left} bytes after the header, expected {size} for {count} vertices; '
            'truncated?'
        )
    if is_last and left - size >= layout.itemsize:
        raise FileFormatError(
            f'{path}: {left} bytes after the header, expected {size} for {count} vertices; is its '
            'header damaged?'
        )


def read_header(path: str | Path, file: BinaryIO) -> tuple[int, np.dtype[Any], bool, bool]:
    """
    Return number and layout of the vertices, and whether they are text and the last element.

    The file is then at the first vertex.
    """
    header, found, _ = file.read(MAX_HEADER_BYTES).partition(b'end_header')
    lines = [line.split() for line in header.decode('ascii', 'replace').splitlines()]
    if not found or not lines or lines[0] != ['ply']:
        raise FileFormatError(f'{path}: not a PLY file, its header is missing')
    file.seek(len(header))
    file.readline()
    lines = [line for line in lines[1:] if line and line[0] not in ('comment', 'obj_info')]
    try:
        (_, encoding, version), (_, element, count), *others = lines
        after = [i for i, line in enumerate(others) if line[0] == 'element']
        properties = others[: after[0]] if after else others
        layout = np.dtype([(name, ORDERS[encoding] + TYPES[kind]) for _, kind, name in properties])
        number = int(count)
    except (ValueError, KeyError) as error:
        raise FileFormatError(
            f'{path}: not a PLY whose first element has scalar properties only'
        ) from error
    if version != '1.0' or element != 'vertex' or number < 0 or not properties:
        raise FileFormatError(
            f'{path}: version {version}, first element {count} x {element} of {len(properties)} '
            'properties, expected 1.0 and vertices of at least one'
        )
    return number, layout, encoding == 'ascii', not after
