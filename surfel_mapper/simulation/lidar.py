# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Lidar: a spinning lidar of many beams in an analytic world.

A scan is organised: one point for every beam and column, beam by beam, nan for rays without a
return, so that row and column of a point are its beam and azimuth. Points are float32 in the frame
of the sensor, as drivers send them: at 64 to 128 m that rounds by up to 3.8 micrometres an axis,
as much as the quantisation of the map with 0.5 m voxels.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import ConfigError
from surfel_mapper.scan import Scan
from surfel_mapper.simulation.world import World

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Lidar:
    """
    The properties of a spinning lidar.

    Attributes
    ----------
    beams, columns : int
        Points a scan: beams from the lowest to the highest elevation, ring 0 lowest; columns
        clockwise seen from above, the first and the last straight behind.
    elevation_deg : (2,) float
        Elevation of the lowest and the highest beam.
    rate_hz : float
        Revolutions a second.
    range_noise_m : float
        Standard deviation of the range.
    min_range_m, max_range_m : float
        Nearer and farther surfaces have no return; noise is added afterwards.
    seed : int
        Seed of the noise, together with the number of the scan.

    Raises
    ------
    ConfigError
        If a value is out of bounds.

    """

    beams: int = 64
    columns: int = 2048
    elevation_deg: tuple[float, float] = (-22.5, 22.5)
    rate_hz: float = 10.0
    range_noise_m: float = 0.0
    min_range_m: float = 0.3
    max_range_m: float = 100.0
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every value."""
        low, high = self.elevation_deg
        nearest = self.min_range_m
        checks = (
            ('beams', 1 <= self.beams <= 1024, 'from 1 to 1024'),
            ('columns', 1 <= self.columns <= 65536, 'from 1 to 65536'),
            ('elevation_deg', -90.0 < low <= high < 90.0, 'ascending, between -90 and 90'),
            ('rate_hz', 0.0 < self.rate_hz <= 1000.0, 'positive, at most 1000'),
            ('range_noise_m', 0.0 <= self.range_noise_m < math.inf, 'zero or positive, finite'),
            ('min_range_m', 0.0 <= nearest < math.inf, 'zero or positive, finite'),
            ('max_range_m', nearest < self.max_range_m < math.inf, f'over {nearest}, finite'),
            ('seed', self.seed >= 0, 'zero or positive'),
        )
        for name, holds, expected in checks:
            if not holds:
                raise ConfigError(f'{name}: {getattr(self, name)}, expected {expected}')

    def directions(self) -> FloatArray:
        """Return the unit vector of every beam and column, (beams, columns, 3), sensor frame."""
        elevation = np.deg2rad(np.linspace(*self.elevation_deg, self.beams))[:, None]
        column = np.arange(self.columns)
        azimuth = np.pi - 2.0 * np.pi * (column + 0.5) / self.columns
        level = np.cos(elevation)
        unit = np.empty((self.beams, self.columns, 3))
        unit[:, :, 0] = level * np.cos(azimuth)
        unit[:, :, 1] = level * np.sin(azimuth)
        unit[:, :, 2] = np.sin(elevation)
        return unit

    def column_times(self) -> FloatArray:
        """Return the time of each column since the start of the turn, (columns,) s."""
        return np.arange(self.columns) / (self.columns * self.rate_hz)

    def scan(
        self,
        world: World,
        T_world_sensor: FloatArray,
        *,
        stamp_ns: int = 0,
        frame_id: str = 'lidar',
        number: int = 0,
    ) -> Scan:
        """
        Return the measurements of one turn.

        Parameters
        ----------
        world : World
            The world around the lidar.
        T_world_sensor : (4, 4) or (columns, 4, 4) float64
            Pose of the sensor: one for all points, or one for each column.
        stamp_ns, frame_id
            Stamp and frame of the scan.
        number : int
            Number of the scan, which seeds its noise together with ``seed``.

        Returns
        -------
        Scan
            beams * columns points, beam by beam, nan for rays without a return. Columns: intensity
            float32 in [0, 255]; ring uint16; time float32, s after the stamp, or 0 with a single
            pose; surface int64, the true surface, -1 for none.

        Raises
        ------
        ValueError
            If the poses have another shape.

        """
        T = np.asarray(T_world_sensor, dtype=np.float64)
        if T.shape not in ((4, 4), (self.columns, 4, 4)):
            raise ValueError(f'T_world_sensor: {T.shape}, expected (4, 4) or (columns, 4, 4)')
        start, ahead = self._rays(T)
        range_m, surface, normal = world.raycast(start, ahead, self.max_range_m)
        missed = (surface < 0) | (range_m < self.min_range_m)
        surface[missed], range_m[missed] = -1, np.nan
        facing = np.abs(np.einsum('ij,ij->i', normal, ahead))
        intensity = np.where(missed, 0.0, 255.0 * world.reflectivity(surface) * facing)
        time = self.column_times() if T.ndim == 3 else np.zeros(self.columns)
        columns: dict[str, npt.NDArray[Any]] = {
            'intensity': intensity.astype(np.float32),
            'ring': np.repeat(np.arange(self.beams, dtype=np.uint16), self.columns),
            'time': np.tile(time.astype(np.float32), self.beams),
            'surface': surface,
        }
        if self.range_noise_m > 0.0:
            rng = np.random.default_rng((self.seed, number))
            range_m += rng.normal(0.0, self.range_noise_m, len(range_m))
        points = self.directions().reshape(-1, 3) * range_m[:, None]
        return Scan(
            points=points.astype(np.float32), stamp_ns=stamp_ns, frame_id=frame_id, columns=columns
        )

    def _rays(self, T_world_sensor: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return origins, (3,) or (N, 3) m, and directions (N, 3) of all points in the world."""
        unit = self.directions()
        if T_world_sensor.ndim == 2:
            ahead = np.einsum('ij,rcj->rci', T_world_sensor[:3, :3], unit)
            return T_world_sensor[:3, 3], ahead.reshape(-1, 3)
        ahead = np.einsum('cij,rcj->rci', T_world_sensor[:, :3, :3], unit)
        return np.tile(T_world_sensor[:, :3, 3], (self.beams, 1)), ahead.reshape(-1, 3)
