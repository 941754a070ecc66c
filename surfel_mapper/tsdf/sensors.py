# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Projection models of the sensors: which ray each pixel of a range image stands for.

Camera: x right, y down, z ahead. An integer pixel (column u, row v) is the ray through (u, v),
without half-pixel offsets, both when a range image is made and when it is read.

Lidar: x ahead, y left, z up; rows from the highest beam to the lowest, columns clockwise seen from
above. With a field of view of 360 deg the last column is the neighbour of the first.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
import itertools
import math
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import ConfigError
from surfel_mapper.kernels.projection import CAMERA, LIDAR, LIDAR_TABLE

Check = tuple[str, bool, str]
"""Name of a property, whether it is valid, and the values expected."""

MAX_PIXELS = 1 << 26
"""Limit of rows * columns: a range image of 256 MB."""


def refuse_unless(sensor: object, checks: Iterable[Check]) -> None:
    """Raise ConfigError for the first property that is not valid."""
    for name, holds, expected in checks:
        if not holds:
            kind = type(sensor).__name__
            raise ConfigError(f'{kind}.{name}: {getattr(sensor, name)}, expected {expected}')


def range_checks(sensor: Sensor) -> list[Check]:
    """Return the checks of the properties that all sensor models have."""
    return [
        ('rows', sensor.rows >= 1, 'at least 1'),
        ('columns', sensor.columns >= 1, 'at least 1'),
        ('columns', sensor.rows * sensor.columns <= MAX_PIXELS, f'at most {MAX_PIXELS} pixels'),
        ('min_range_m', 0.0 < sensor.min_range_m < math.inf, 'positive, finite'),
        (
            'max_range_m',
            sensor.min_range_m < sensor.max_range_m < math.inf,
            'more than min_range_m, finite',
        ),
    ]


Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

NO_ELEVATIONS: Float32 = np.zeros(0, np.float32)
"""The rows of a camera are not at one elevation."""


@dataclass(frozen=True, kw_only=True)
class CameraModel:
    """
    Projection model of a pinhole depth camera.

    Attributes
    ----------
    columns, rows : int
        Size of its images.
    fx, fy, cx, cy : float
        Intrinsics, pixels.
    min_range_m, max_range_m : float
        Nearer returns are ignored; farther ones only free the space up to max_range_m.

    Raises
    ------
    ConfigError
        If a value is out of bounds.

    """

    columns: int
    rows: int
    fx: float
    fy: float
    cx: float
    cy: float
    min_range_m: float = 0.1
    max_range_m: float = 8.0

    wraps = False
    kind = CAMERA

    def __post_init__(self) -> None:
        """Check every value."""
        checks = [
            *range_checks(self),
            ('fx', 0.0 < self.fx < math.inf, 'positive, finite'),
            ('fy', 0.0 < self.fy < math.inf, 'positive, finite'),
            ('cx', 0.0 < self.cx <= self.columns, 'positive, at most the number of columns'),
            ('cy', 0.0 < self.cy <= self.rows, 'positive, at most the number of rows'),
        ]
        refuse_unless(self, checks)

    @cached_property
    def ray_length(self) -> Float32:
        """Range of each pixel at depth 1, (rows, columns)."""
        x = (np.arange(self.columns) - self.cx) / self.fx
        y = (np.arange(self.rows) - self.cy) / self.fy
        length: Float32 = np.asarray(np.sqrt(x * x + (y * y)[:, None] + 1.0), np.float32)
        return length

    @cached_property
    def directions(self) -> Float32:
        """Unit vector of each pixel, (rows, columns, 3)."""
        rays = np.empty((self.rows, self.columns, 3))
        rays[:, :, 0] = (np.arange(self.columns) - self.cx) / self.fx
        rays[:, :, 1] = ((np.arange(self.rows) - self.cy) / self.fy)[:, None]
        rays[:, :, 2] = 1.0
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        return rays.astype(np.float32)

    @cached_property
    def parameters(self) -> Float32:
        """Parameters of the projection, see kernels/projection.py."""
        return np.array(
            [self.fx, self.fy, self.cx, self.cy, self.columns, self.rows, 0.0, 0.0], np.float32
        )

    @property
    def projection(self) -> tuple[Any, ...]:
        """Kind, parameters and no elevations, the form that kernels take."""
        return self.kind, self.parameters, NO_ELEVATIONS

    @property
    def pitch_rad(self) -> tuple[float, float]:
        """Largest angles between neighbouring rows and columns."""
        return 1.0 / self.fy, 1.0 / self.fx


@dataclass(frozen=True, kw_only=True)
class LidarModel:
    """
    Projection model of a spinning lidar.

    Attributes
    ----------
    rows : int
        Number of beams; the length of beam_elevations_deg if that is given.
    columns : int
        Steps of azimuth.
    vertical_fov_deg : float
        Angle between the highest and the lowest beam.
    vertical_fov_top_deg : float
        Elevation of the highest beam; nan means half of vertical_fov_deg.
    first_azimuth_deg : float
        Azimuth of column 0, from x towards y; the columns are a full circle.
    beam_elevations_deg : tuple of float
        Elevation of each beam, descending; empty for evenly spaced beams.
    min_range_m, max_range_m : float
        Nearer returns are ignored; farther ones only free the space up to max_range_m.

    Raises
    ------
    ConfigError
        If a value is out of bounds.

    """

    wraps: ClassVar[bool] = True
    rows: int = 64
    columns: int = 2048
    vertical_fov_deg: float = 45.0
    vertical_fov_top_deg: float = math.nan
    first_azimuth_deg: float = 180.0
    beam_elevations_deg: tuple[float, ...] = ()
    min_range_m: float = 0.5
    max_range_m: float = 100.0

    def __post_init__(self) -> None:
        """Check every value; derive missing angles from the others."""
        beams = tuple(float(value) for value in self.beam_elevations_deg)
        object.__setattr__(self, 'beam_elevations_deg', beams)
        if beams:
            object.__setattr__(self, 'vertical_fov_top_deg', beams[0])
            object.__setattr__(self, 'vertical_fov_deg', beams[0] - beams[-1])
        if math.isnan(self.vertical_fov_top_deg):
            object.__setattr__(self, 'vertical_fov_top_deg', self.vertical_fov_deg / 2.0)
        top, bottom = self.vertical_fov_top_deg, self.vertical_fov_top_deg - self.vertical_fov_deg
        descends = all(high > low for high, low in itertools.pairwise(beams))
        checks = [
            *range_checks(self),
            ('beam_elevations_deg', len(beams) in (0, self.rows), 'one for each row'),
            ('beam_elevations_deg', descends, 'descending'),
            ('rows', self.rows >= 2, 'at least 2 beams'),
            ('columns', self.columns >= 2, 'at least 2'),
            ('vertical_fov_deg', 0.0 < self.vertical_fov_deg < 180.0, 'between 0 and 180'),
            ('vertical_fov_top_deg', bottom > -90.0 and top < 90.0, 'beams between -90 and 90'),
            ('first_azimuth_deg', -360.0 <= self.first_azimuth_deg <= 360.0, 'in [-360, 360]'),
        ]
        refuse_unless(self, checks)

    @property
    def kind(self) -> int:
        """Kind of projection, see kernels/projection.py."""
        return LIDAR_TABLE if self.beam_elevations_deg else LIDAR

    @cached_property
    def azimuths_rad(self) -> Float64:
        """Azimuth of each column, (columns,)."""
        steps = np.arange(self.columns, dtype=np.float64) * self._column_rad
        return math.radians(self.first_azimuth_deg) - steps

    @property
    def _column_rad(self) -> float:
        return 2.0 * math.pi / self.columns

    @cached_property
    def elevations_rad(self) -> Float64:
        """Elevation of each row, descending, (rows,)."""
        if self.beam_elevations_deg:
            return np.deg2rad(self.beam_elevations_deg)
        top = self.vertical_fov_top_deg
        beams = np.linspace(top, top - self.vertical_fov_deg, self.rows, dtype=np.float64)
        return np.asarray(np.deg2rad(beams), np.float64)

    @cached_property
    def elevations(self) -> Float32:
        """Elevation of each row as float32 for kernels, rad."""
        return self.elevations_rad.astype(np.float32)

    @cached_property
    def directions(self) -> Float32:
        """Unit vector of each pixel, (rows, columns, 3)."""
        rays = np.empty((self.rows, self.columns, 3))
        level = np.cos(self.elevations_rad)[:, None]
        rays[:, :, 0] = level * np.cos(self.azimuths_rad)
        rays[:, :, 1] = level * np.sin(self.azimuths_rad)
        rays[:, :, 2] = np.sin(self.elevations_rad)[:, None]
        return rays.astype(np.float32)

    @cached_property
    def parameters(self) -> Float32:
        """Parameters of the projection, see kernels/projection.py."""
        row_rad = math.radians(self.vertical_fov_deg) / (self.rows - 1)
        top_rad, first_rad = self.elevations_rad[0], math.radians(self.first_azimuth_deg)
        turn, lowest = 2.0 * math.pi / self._column_rad, 0.0
        angles = [first_rad, self._column_rad, top_rad, row_rad]
        return np.array([*angles, self.columns, self.rows, turn, lowest], np.float32)

    @property
    def projection(self) -> tuple[Any, ...]:
        """Kind, parameters and elevations, the form that kernels take."""
        return self.kind, self.parameters, self.elevations

    @property
    def pitch_rad(self) -> tuple[float, float]:
        """Largest angles between neighbouring rows and columns."""
        return float(-np.diff(self.elevations_rad).min()), self._column_rad


Sensor = CameraModel | LidarModel
"""Either sensor model."""
