# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The camera or lidar of each scan, and its measurements: points and free rays."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import TsdfConfig
from surfel_mapper.scan import Scan
from surfel_mapper.tsdf.fitting import fitted_lidar
from surfel_mapper.tsdf.sensors import CameraModel, LidarModel

MAX_LIDARS = 64
"""Frames whose lidars are kept; frame names may change without end."""


class SensorModels:
    """
    The sensors of the scans so far.

    Parameters
    ----------
    config : TsdfConfig
        Rows, columns and ranges of the sensors, as far as configured.

    """

    def __init__(self, config: TsdfConfig) -> None:
        self._config = config
        self._lidars: dict[str, LidarModel] = {}

    def of(self, scan: Scan) -> CameraModel | LidarModel:
        """
        Return the sensor of a scan: its camera, else the lidar fitted to the first of its frame.

        Raises
        ------
        CloudFormatError
            If no lidar fits the points of the first.

        """
        config = self._config
        ranges = {'min_range_m': config.min_range_m, 'max_range_m': config.max_range_m}
        if scan.camera:
            width, height, fx, fy, cx, cy = scan.camera
            return CameraModel(
                columns=int(width), rows=int(height), fx=fx, fy=fy, cx=cx, cy=cy, **ranges
            )
        if scan.frame_id not in self._lidars:
            if len(self._lidars) >= MAX_LIDARS:
                del self._lidars[next(iter(self._lidars))]
            self._lidars[scan.frame_id] = fitted_lidar(
                scan.points,
                scan.columns.get('ring'),
                rows=config.sensor_rows,
                columns=config.sensor_columns,
                **ranges,
            )
        return self._lidars[scan.frame_id]


def measured(scan: Scan, max_range_m: float) -> npt.NDArray[Any]:
    """Return the points of a scan, then a point beyond the range on each ray that met nothing."""
    if scan.free is None:
        return scan.points
    beyond = 2.0 * max_range_m * scan.free
    return np.concatenate([scan.points, beyond.astype(scan.points.dtype)])
