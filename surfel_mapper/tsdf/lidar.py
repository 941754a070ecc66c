# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The spinning lidar.

Frame: x ahead, y left, z up; rows from the highest beam to the lowest, columns clockwise seen from
above. One that looks all around has no seam: its last column is the neighbour of its first.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import itertools
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import ConfigError
from surfel_mapper.kernels.projection import LIDAR, LIDAR_TABLE
from surfel_mapper.tsdf.sensor_checks import range_checks, refuse_unless

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Lidar:
    """
    A spinning lidar.

    Attributes
    ----------
    rows : int
        Beams; as many as beam_elevations_deg where those are given.
    columns : int
        Steps of azimuth.
    vertical_fov_deg : float
        Angle between the highest and the lowest beam.
    vertical_fov_top_deg : float
        Elevation of the highest beam; nan: half of vertical_fov_deg.
    horizontal_fov_deg : float
        360 for all around, otherwise the angle between the first and the last column.
    first_azimuth_deg : float
        Azimuth of column 0, counted from x to y; nan: half of horizontal_fov_deg.
    beam_elevations_deg : tuple of float
        Elevation of each beam from the highest to the lowest, where they are not evenly spaced.
    min_range_m, max_range_m : float
        What is nearer is ignored; what is farther says that there is nothing up to max_range_m.

    Raises
    ------
    ConfigError
        If a value is out of bounds.

    """

    rows: int = 64
    columns: int = 2048
    vertical_fov_deg: float = 45.0
    vertical_fov_top_deg: float = math.nan
    horizontal_fov_deg: float = 360.0
    first_azimuth_deg: float = math.nan
    beam_elevations_deg: tuple[float, ...] = ()
    min_range_m: float = 0.5
    max_range_m: float = 100.0

    def __post_init__(self) -> None:
        """Check every value; missing angles follow from the others."""
        beams = tuple(float(value) for value in self.beam_elevations_deg)
        object.__setattr__(self, 'beam_elevations_deg', beams)
        if beams:
            object.__setattr__(self, 'vertical_fov_top_deg', beams[0])
            object.__setattr__(self, 'vertical_fov_deg', beams[0] - beams[-1])
        if math.isnan(self.vertical_fov_top_deg):
            object.__setattr__(self, 'vertical_fov_top_deg', self.vertical_fov_deg / 2.0)
        if math.isnan(self.first_azimuth_deg):
            object.__setattr__(self, 'first_azimuth_deg', self.horizontal_fov_deg / 2.0)
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
            ('horizontal_fov_deg', 0.0 < self.horizontal_fov_deg <= 360.0, 'in (0, 360]'),
            ('first_azimuth_deg', -360.0 <= self.first_azimuth_deg <= 360.0, 'in [-360, 360]'),
        ]
        refuse_unless(self, checks)

    @classmethod
    def from_resolution(
        cls,
        *,
        vertical_fov_deg: float,
        vertical_resolution_deg: float,
        horizontal_resolution_deg: float,
        **properties: Any,
    ) -> Lidar:
        """
        Return a lidar of which the angles between neighbouring rays are known.

        Beams span one gap less than they are: 30 deg in steps of 2 deg are 16 beams.

        Raises
        ------
        ConfigError
            If an angle is not positive and finite, or another property is out of bounds.

        """
        angles = (vertical_fov_deg, vertical_resolution_deg, horizontal_resolution_deg)
        if not all(0.0 < angle < math.inf for angle in angles):
            raise ConfigError(f'Lidar: angles {angles} deg, expected positive ones')
        across = properties.get('horizontal_fov_deg', 360.0)
        gaps = round(across / horizontal_resolution_deg)
        return cls(
            rows=round(vertical_fov_deg / vertical_resolution_deg) + 1,
            columns=gaps if across == 360.0 else gaps + 1,
            vertical_fov_deg=vertical_fov_deg,
            **properties,
        )

    @property
    def wraps(self) -> bool:
        """Whether the first column follows the last."""
        reach = self.horizontal_fov_deg * self.columns / (self.columns - 1)
        return reach > 360.0 - 1e-6

    @property
    def kind(self) -> int:
        """How the kernels project, see kernels/projection.py."""
        return LIDAR_TABLE if self.beam_elevations_deg else LIDAR

    @cached_property
    def azimuths_rad(self) -> Float64:
        """Azimuth of each column."""
        steps = np.arange(self.columns, dtype=np.float64) * self._column_rad
        return math.radians(self.first_azimuth_deg) - steps

    @property
    def _column_rad(self) -> float:
        if self.wraps:
            return 2.0 * math.pi / self.columns
        return math.radians(self.horizontal_fov_deg) / (self.columns - 1)

    @cached_property
    def elevations_rad(self) -> Float64:
        """Elevation of each row, from the highest to the lowest."""
        if self.beam_elevations_deg:
            return np.deg2rad(self.beam_elevations_deg)
        top = self.vertical_fov_top_deg
        return np.deg2rad(np.linspace(top, top - self.vertical_fov_deg, self.rows))

    @cached_property
    def elevations(self) -> Float32:
        """Elevation of each row, rad."""
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
        """What the kernels need to project, see kernels/projection.py."""
        row_rad = math.radians(self.vertical_fov_deg) / (self.rows - 1)
        top_rad, first_rad = self.elevations_rad[0], math.radians(self.first_azimuth_deg)
        turn, lowest = 2.0 * math.pi / self._column_rad, 0.0 if self.wraps else -0.5
        angles = [first_rad, self._column_rad, top_rad, row_rad]
        return np.array([*angles, self.columns, self.rows, turn, lowest], np.float32)

    @property
    def projection(self) -> tuple[Any, ...]:
        """What the kernels take: kind, parameters, elevations."""
        return self.kind, self.parameters, self.elevations

    @property
    def density(self) -> float:
        """Rays that a face of 1 m^2 at range 1 m meets, as virtual focal lengths have it."""
        across = self.columns * 90.0 / self.horizontal_fov_deg / 2.0
        return across * self.rows * 90.0 / self.vertical_fov_deg / 2.0

    @property
    def pitch_rad(self) -> tuple[float, float]:
        """Largest angles between neighbouring rows and columns."""
        return float(-np.diff(self.elevations_rad).min()), self._column_rad

    def sees(self, centres: Float64, inflation_m: float) -> npt.NDArray[np.bool_]:
        """Return which balls about (K, 3) centres in its frame reach into its view."""
        distance = np.linalg.norm(centres, axis=1)
        ball = np.arcsin(np.minimum(inflation_m / np.maximum(distance, inflation_m), 1.0))
        half_top, half_bottom = -np.diff(self.elevations_rad)[[0, -1]] / 2.0
        elevation = np.arcsin(np.clip(centres[:, 2] / np.maximum(distance, 1e-12), -1.0, 1.0))
        above = elevation - ball > self.elevations_rad[0] + half_top
        below = elevation + ball < self.elevations_rad[-1] - half_bottom
        seen: npt.NDArray[np.bool_] = ~(above | below) | (distance <= inflation_m)
        return seen
