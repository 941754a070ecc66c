# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LAS and LAZ files of points and surfels, by laspy.

That is an extra: the formats have 30 kinds of records. lazrs, its decoder of LAZ, ends the process
if it cannot get memory, so all sizes by which lazrs allocates are compared with the file first;
and it decodes by one thread, which allocates by fewer. Coordinates are scaled integers, often of a
map projection, so they are returned as float64.
"""

from __future__ import annotations

import io
import logging
import math
import os
from pathlib import Path
import struct
from typing import Any, BinaryIO, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import open_regular
from surfel_mapper.errors import ConfigError, DependencyError, FileFormatError
from surfel_mapper.files.atomic import replace_file
from surfel_mapper.files.point_columns import Columns, RGB
from surfel_mapper.mapping.surfels import quality_columns

if TYPE_CHECKING:
    from surfel_mapper.mapping.surfels import Surfels

SUFFIXES = ('.las', '.laz')

ATTRIBUTES = ('classification', 'return_number', 'number_of_returns')
"""Fields of every point, which become columns of their names."""

MODEL_KEY, GEOGRAPHIC = 1024, 2
"""GeoTIFF's key of the kind of coordinates, and its value for degrees."""

UNIT_KEYS = (3076, 4099)
"""GeoTIFF's keys of the units of x and y, and of z."""

LINEAR_UNITS = {9001: 1.0, 9002: 0.3048, 9003: 1200.0 / 3937.0}
"""EPSG codes of metre, foot and US survey foot; others are found by pyproj."""

logger = logging.getLogger(__name__)

RESOLUTION_M = 1e-4
"""Unit of the coordinates that are written, m."""

MAX_STEPS = 2**31 - 1
"""Limit of a coordinate in a file, in units."""

HEADER_BYTES = 375
"""Size of the header of version 1.4; that of 1.2 has 227."""

RECORD_BYTES, EXTENDED_RECORD_BYTES = 54, 60
"""Sizes of the heads of variable length records, before and behind the points."""

POINT_FORMAT_AT, PACKED = 104, 0xC0
"""Place of the format of points in the header, and its bits of LAZ."""

LASZIP_RECORD = (b'laszip encoded', 22204)
"""Name and number of the record that says how points are packed."""

LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Layers of the items of a point by their type; type 14, further bytes, has one for each byte."""


def read_points(path: str | Path) -> Columns:
    """
    Return the columns of a LAS or LAZ file.

    Returns
    -------
    dict of str to (N,) array
        x, y, z float64, m; intensity float32; classification, return_number, number_of_returns;
        timestamp float64 if the file has GPS times, s; red, green, blue if it has colours;
        extra columns by their names. Points that are marked as withheld are left out.

    Raises
    ------
    FileFormatError
        If it cannot be read, or its coordinates are degrees.
    DependencyError
        If laspy is not installed.

    """
    laspy = import_laspy(path)
    try:
        check_header(path)
        las = laspy.read(str(path), laz_backend=laspy.LazBackend.Lazrs)
    except (FileFormatError, ConfigError, KeyboardInterrupt, SystemExit):
        raise
    except OSError as error:
        raise FileFormatError(f'{path}: cannot be read: {error.strerror or error}') from error
    except BaseException as error:  # of decoders; a panic of Rust is no Exception
        raise FileFormatError(f'{path}: no LAS or LAZ file: {error}') from error
    is_kept = np.asarray(las.withheld) == 0
    if not is_kept.all():
        logger.info('%s: %d points are withheld and left out', path, len(las) - is_kept.sum())
    return {name: np.array(values)[is_kept] for name, values in las_columns(path, las).items()}


def las_columns(path: str | Path, las: Any) -> Columns:
    """Return the columns of all points of a file."""
    names = set(las.point_format.dimension_names)
    factors = metres_of(path, las.header)
    columns: Columns = {
        name: np.ascontiguousarray(getattr(las, name), np.float64) * factor
        for name, factor in zip('xyz', factors, strict=True)
    }
    columns['intensity'] = np.asarray(las.intensity, np.float32)
    columns |= {name: np.asarray(las[name]) for name in ATTRIBUTES}
    if 'gps_time' in names:
        columns['timestamp'] = np.asarray(las.gps_time, np.float64)
    if set(RGB) <= names:
        columns |= {name: np.asarray(las[name]) for name in RGB}
    for name in las.point_format.extra_dimension_names:
        columns.setdefault(name, np.asarray(las[name]))
    return columns


def metres_of(path: str | Path, header: Any) -> tuple[float, float, float]:
    """
    Return the metres in a unit of x, y and z, by the coordinate system; 1 if there is none.

    Heights without a unit of their own have that of x and y.

    Raises
    ------
    FileFormatError
        If coordinates are degrees.

    """
    directories = header.vlrs.get('GeoKeyDirectoryVlr')
    keys = {key.id: key.value_offset for vlr in directories for key in vlr.geo_keys}
    factor, height = (LINEAR_UNITS.get(keys.get(key, 0)) for key in UNIT_KEYS)
    is_geographic = keys.get(MODEL_KEY) == GEOGRAPHIC
    if factor is None and not is_geographic:
        try:
            crs = header.parse_crs()
        except Exception as error:  # of pyproj, or pyproj is missing
            logger.warning('%s: unit of its coordinates: %s; metres are assumed', path, error)
            crs = None
        if crs is not None:
            is_geographic = crs.is_geographic
            factors = [axis.unit_conversion_factor for axis in crs.axis_info]
            factor, height = factors[0], height or factors[-1]
    if is_geographic:
        raise FileFormatError(
            f'{path}: longitudes and latitudes in degrees, expected coordinates of a map '
            'projection; convert it, as with `pdal translate --filter reprojection`'
        )
    elif factor is None and any(keys.get(key) for key in UNIT_KEYS):
        logger.warning('%s: units %s of EPSG are not known; metres are assumed', path, keys)
    factor = factor or 1.0
    height = height or factor
    if (factor, height) != (1.0, 1.0):
        logger.warning(
            '%s: coordinates in units of %.7g m, heights of %.7g m, are converted to metres',
            *(path, factor, height),
        )
    return factor, factor, height


def write_surfels(
    path: str | Path, surfels: Surfels, origin_m: npt.ArrayLike = (0.0, 0.0, 0.0)
) -> None:
    """
    Write surfels as LAS 1.4, packed if the suffix is .laz, atomically.

    Coordinates are multiples of 0.1 mm about a whole metre; normals, planarity, curvature,
    num_points and the columns of QUALITY are extra columns, which CloudCompare and PDAL show by
    name. Intensity is rounded to the 16 bits of the format.

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
        **quality_columns(surfels),
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
    las.write(content, do_compress=Path(path).suffix.lower() == '.laz')
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
        header = file.read(HEADER_BYTES)
        if len(header) >= POINT_FORMAT_AT and header[POINT_FORMAT_AT] & PACKED:
            room = check_packed(path, file, header, size)
    header = header.ljust(HEADER_BYTES, b'\0')
    if header[24] != 1:  # laspy looks at the second number alone, which selects the counts
        raise FileFormatError(f'{path}: version {header[24]}.{header[25]}, expected 1.0 to 1.4')
    start, num_records, point_format, point_size, count = struct.unpack_from('<IIBHI', header, 96)
    num_extended = 0
    if header[24:26] >= b'\x01\x04':
        num_extended, count = struct.unpack_from('<IQ', header, 243)
    if num_records * RECORD_BYTES + num_extended * EXTENDED_RECORD_BYTES > size:
        raise FileFormatError(
            f'{path}: {num_records} and {num_extended} records of variable length in a file of '
            f'{size} bytes; damaged?'
        )
    check_units(path, header)
    header_size = struct.unpack_from('<H', header, 94)[0]
    if not header_size + num_records * RECORD_BYTES <= start <= size:
        raise FileFormatError(
            f'{path}: points from byte {start} of {size} on, behind a header of {header_size} '
            f'bytes and {num_records} records; truncated, or damaged?'
        )
    is_packed = point_format & PACKED
    if is_packed and (count > room or (room and not count)):
        raise FileFormatError(f'{path}: {count} points in chunks of {room}; damaged?')
    waveforms = struct.unpack_from('<Q', header, 227)[0] if header[24:26] >= b'\x01\x03' else 0
    stored = (size - start) // max(point_size, 1)
    if not is_packed and (count > stored or (count < stored and not num_extended | waveforms)):
        raise FileFormatError(
            f'{path}: {size} bytes, expected {start + count * point_size} for {count} points of '
            f'{point_size} bytes; truncated, or is its header damaged?'
        )


def check_units(path: str | Path, header: bytes) -> None:
    """Raise FileFormatError unless the units and offsets of coordinates are usable numbers."""
    numbers = struct.unpack_from('<6d', header, 131)
    if not all(map(math.isfinite, numbers)) or not all(numbers[:3]):
        raise FileFormatError(
            f'{path}: units {numbers[:3]} and offsets {numbers[3:]} of coordinates, expected '
            'finite numbers, and units that are not 0'
        )


def check_packed(path: str | Path, file: BinaryIO, header: bytes, size: int) -> int:
    """
    Return the number of points that the chunks of a LAZ file have room for.

    The decoder allocates by the size of a point, the number of chunks, and the sizes of chunks
    and of the layers in them; it would read more points than stated from chunks of any size. Each
    chunk begins with a point as it is. Source: the specification of LAZ 1.4, compressed data.

    Raises
    ------
    FileFormatError
        If one of them does not fit the file.

    """
    import lazrs

    start, point_size = struct.unpack_from('<I', header, 96)[0], header[105] + (header[106] << 8)
    record = laszip_record(file, header, min(start, size))
    items = [struct.unpack_from('<HHH', record, at) for at in range(34, len(record) - 5, 6)]
    stated = sum(item_size for _, item_size, _ in items)
    if len(items) != struct.unpack_from('<H', record.ljust(34, b'\0'), 32)[0] or (
        stated != point_size
    ):
        raise FileFormatError(
            f'{path}: items of {stated} bytes in points of {point_size}; damaged?'
        )
    table_at = read_number(file, start, '<q')
    table_at = read_number(file, size - 8, '<q') if table_at == -1 else table_at
    is_inside = start < table_at <= size - 8
    num_chunks = read_number(file, table_at + 4, '<I') if is_inside else 0
    if not is_inside or (num_chunks - 1) * point_size > size:
        raise FileFormatError(
            f'{path}: {num_chunks} chunks of points at byte {table_at} of {size}; damaged?'
        )
    file.seek(start)
    chunks = lazrs.read_chunk_table(file, lazrs.LazVlr(record)) if num_chunks else []
    num_layers = sum(
        item_size if kind == 14 else LAYERS.get(kind, 0) for kind, item_size, _ in items
    )
    at, head = start + 8, point_size + 4 * (1 + num_layers)
    for number, (_, chunk_size) in enumerate(chunks):
        file.seek(at + point_size + 4)
        layers = np.frombuffer(file.read(4 * num_layers).ljust(4 * num_layers, b'\0'), '<u4')
        if at + chunk_size > size or (
            num_layers and head + int(layers.sum(dtype=np.int64)) != chunk_size
        ):
            raise FileFormatError(
                f'{path}: chunk {number} of the points has another size than its layers, or ends '
                'beyond the file; damaged?'
            )
        at += chunk_size
    return sum(num_points for num_points, _ in chunks)


def laszip_record(file: BinaryIO, header: bytes, end: int) -> bytes:
    """Return the record of LAZ among those of variable length, or none."""
    at, num_records = struct.unpack_from('<H4xI', header, 94)
    for _ in range(num_records):
        if at + RECORD_BYTES > end:
            break
        file.seek(at)
        name, number, length = struct.unpack_from('<2x16sHH', file.read(RECORD_BYTES))
        if (name.rstrip(b'\0'), number) == LASZIP_RECORD:
            return file.read(length)
        at += RECORD_BYTES + length
    return b''


def read_number(file: BinaryIO, at: int, code: str) -> int:
    """Return a number at a place of a file; bytes behind its end are 0."""
    length = struct.calcsize(code)
    file.seek(max(at, 0))
    number: int = struct.unpack(code, file.read(length).ljust(length, b'\0'))[0]
    return number
