# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LAS and LAZ files of points and surfels, by laspy.

That is an extra: the formats have 30 kinds of records. Coordinates are scaled integers, often of a
map projection, so they are returned as float64.
"""

from __future__ import annotations

import io
import logging
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import open_regular
from surfel_mapper.errors import FileFormatError, refusing
from surfel_mapper.files.atomic import replace_file
from surfel_mapper.files.point_columns import Columns, shape_columns
from surfel_mapper.libraries import library
from surfel_mapper.mapping.channels import RGB
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
    laspy = import_laspy()
    lazrs = laspy.LazBackend.Lazrs
    with (
        refusing(path),
        open_regular(path) as file,
        laspy.open(file, laz_backend=lazrs) as reader,
    ):
        stated = reader.header.point_count
        las = reader.read()
    if len(las) < stated:
        raise FileFormatError(f'{path}: {len(las)} points, expected {stated}; truncated?')
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
    laspy = import_laspy()
    has_colour = 'red' in surfels.channels
    header = laspy.LasHeader(point_format=7 if has_colour else 6, version='1.4')
    position = surfels.position + np.asarray(origin_m, np.float64)
    header.scales = np.full(3, RESOLUTION_M)
    header.offsets = np.floor(position.mean(axis=0)) if len(surfels) else np.zeros(3)
    if np.abs(position - header.offsets).max(initial=0.0) / RESOLUTION_M > MAX_STEPS:
        raise FileFormatError(f'{path}: surfels farther apart than 214 km; expected a smaller map')
    extra = {**shape_columns(surfels), **quality_columns(surfels)}
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


def import_laspy() -> Any:
    """Return the module laspy, or raise DependencyError."""
    return library('laspy', 'reads and writes LAS and LAZ', "'surfel_mapper[las]'")
