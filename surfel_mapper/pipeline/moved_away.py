# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Voxels that later scans see through: what was there has moved away.

Every scan is turned into a range image, and the voxels of the map are looked up in it. One whose
rays end behind it, or met nothing, gains a count; one that is seen or hit again loses all. A map
that has a window forgets what moved anyway; this is for windows longer than things stand still.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import DynamicConfig, TsdfConfig
from surfel_mapper.geometry import inverse
from surfel_mapper.layers.dynamic_objects.kernels.free_space import look_through, SEEN, THROUGH
from surfel_mapper.mapping.moments import unpack_keys
from surfel_mapper.pipeline.sensor_models import measured, SensorModels
from surfel_mapper.scan import Scan
from surfel_mapper.tsdf.range_image import from_points

Keys = npt.NDArray[np.int64]


class MovedAway:
    """
    Counts by how many scans in a row each voxel was seen through.

    Parameters
    ----------
    config : DynamicConfig
        From how many on a voxel is empty.
    voxel_size_m : float
        Of the map.
    sensors : SensorModels
        What the scans came from.

    """

    def __init__(self, config: DynamicConfig, voxel_size_m: float, sensors: SensorModels) -> None:
        """Begin with no counts."""
        self._config = config
        self._voxel_size_m = voxel_size_m
        self._sensors = sensors
        self.clear()

    def clear(self) -> None:
        """Forget all counts."""
        self._keys = np.empty(0, np.int64)
        self._counts: Keys = np.empty(0, np.int64)

    def warm_up(self) -> None:
        """Compile the kernels, for points of either type."""
        turn = np.linspace(0.0, 2.0 * np.pi, 64)
        ring = np.stack([9.0 * np.cos(turn), 9.0 * np.sin(turn), np.linspace(-1, 1, 64)], axis=1)
        for dtype in (np.float32, np.float64):
            scan = Scan(points=ring.astype(dtype), stamp_ns=0, frame_id='')
            fresh = MovedAway(self._config, self._voxel_size_m, SensorModels(TsdfConfig()))
            fresh.look(scan, np.eye(4), np.zeros(1, np.int64), np.zeros(1, np.int64))

    def look(
        self, scan: Scan, T_map_sensor: npt.NDArray[np.float64], keys: Keys, hit: Keys
    ) -> npt.NDArray[np.int32]:
        """
        Count what a scan sees through; return the voxels that are empty by now, (E, 3).

        Parameters
        ----------
        scan : Scan
            What was measured.
        T_map_sensor : (4, 4) float64
            From where.
        keys : (K,) int64
            Of all voxels of the map.
        hit : (H,) int64
            Of the voxels that have points of the scan.

        Raises
        ------
        CloudFormatError
            If the sensor cannot be told from the points.

        """
        verdict = self._verdict(scan, T_map_sensor, keys)
        stay = np.concatenate([keys[verdict == SEEN], hit])
        known = ~np.isin(self._keys, stay) & np.isin(self._keys, keys)
        through = np.setdiff1d(keys[verdict == THROUGH], hit)
        found = np.concatenate([self._keys[known], through])
        counts = np.concatenate([self._counts[known], np.ones(len(through), np.int64)])
        self._keys, place = np.unique(found, return_inverse=True)
        self._counts = np.bincount(place, counts, len(self._keys)).astype(np.int64)
        empty = self._counts >= self._config.min_scans
        return unpack_keys(self._keys[empty])

    def _verdict(
        self, scan: Scan, T_map_sensor: npt.NDArray[np.float64], keys: Keys
    ) -> npt.NDArray[np.int8]:
        """Return what a scan says of each voxel."""
        sensor = self._sensors.of(scan)
        image = from_points(sensor, measured(scan, sensor.max_range_m)).range_m
        image = np.minimum(image, np.float32(sensor.max_range_m))  # beyond it nothing is known
        T = inverse(T_map_sensor)
        centers = (unpack_keys(keys).astype(np.float64) + 0.5) * self._voxel_size_m
        x, y, z = (centers @ T[:3, :3].T + T[:3, 3]).astype(np.float32).T.copy()
        margin_m = self._config.margin_m or math.sqrt(3.0) * self._voxel_size_m
        verdict = np.empty(len(keys), np.int8)
        look_through(
            *(x, y, z, sensor.projection, image, sensor.columns, np.float32(margin_m), verdict)
        )
        return verdict
