# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Dynamic objects as a layer: voxels that later scans see through are cleared.

The voxels of the map are compared with the points of every scan. A voxel gains a
count if the rays around it end behind it or met nothing, and loses all counts when it is seen or
hit again. A short window forgets dynamic objects anyway; this is for windows longer than objects
stand still.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.geometry import inverse
from surfel_mapper.layers.dynamic_objects.free_space import look_through, SEEN, THROUGH
from surfel_mapper.layers.layer import InsertedScan, Layer, Surroundings
from surfel_mapper.layers.sensor_models import measured
from surfel_mapper.mapping.moments import unpack_keys
from surfel_mapper.scan import Scan

Keys = npt.NDArray[np.int64]


class DynamicObjectsLayer(Layer):
    """Counts, for each voxel, the scans in a row that saw through it."""

    name = 'dynamic'
    needs_free_rays = True

    def __init__(self, config: Config, around: Surroundings) -> None:
        super().__init__(config, around)
        self.clear()

    def clear(self) -> None:
        """Forget all counts."""
        self._keys = np.empty(0, np.int64)
        self._counts: Keys = np.empty(0, np.int64)

    def voxels_to_clear(self, inserted: InsertedScan) -> npt.NDArray[np.int32]:
        """
        Count the voxels that a scan sees through; return the voxels to clear, (E, 3).

        Raises
        ------
        PoseError
            If ``layers.tsdf.sensor_frame`` is not connected with the frame of the scan.

        """
        keys = self.around.surfel_map.keys()
        return self.count(inserted.scan, inserted.T_map_sensor, keys, inserted.keys)

    def count(
        self, scan: Scan, T_map_sensor: npt.NDArray[np.float64], keys: Keys, hit: Keys
    ) -> npt.NDArray[np.int32]:
        """
        Count the voxels that a scan sees through; return those seen through often enough, (E, 3).

        Parameters
        ----------
        scan : Scan
            In its own frame; ``SensorModels.centered`` finds the sensor in it.
        T_map_sensor : (4, 4) float64
            The pose of that frame in the map.
        keys : (K,) int64
            Packed indices of all voxels of the map.
        hit : (H,) int64
            Those of the voxels that hold points of the scan.

        Raises
        ------
        PoseError
            If ``layers.tsdf.sensor_frame`` is not connected with the frame of the scan.

        """
        verdict = self._verdict(scan, T_map_sensor, keys)
        stay = np.concatenate([keys[verdict == SEEN], hit])
        kept = ~np.isin(self._keys, stay) & np.isin(self._keys, keys)
        through = np.setdiff1d(keys[verdict == THROUGH], hit)
        candidates = np.concatenate([self._keys[kept], through])
        counts = np.concatenate([self._counts[kept], np.ones(len(through), np.int64)])
        self._keys, inverse = np.unique(candidates, return_inverse=True)
        self._counts = np.bincount(inverse, counts, len(self._keys)).astype(np.int64)
        empty = self._counts >= self.config.dynamic.min_scans
        return unpack_keys(self._keys[empty])

    def _verdict(
        self, scan: Scan, T_map_sensor: npt.NDArray[np.float64], keys: Keys
    ) -> npt.NDArray[np.int8]:
        """Return the verdict of a scan on each voxel, (K,) int8: SEEN, THROUGH or unknown."""
        scan, T_map_sensor = self.around.sensors.centered(scan, T_map_sensor)
        tsdf, voxel_size_m = self.config.tsdf, self.around.surfel_map.voxel_size_m
        axes = [2, 0, 1] if scan.camera else [0, 1, 2]  # x ahead
        points = measured(scan, tsdf.max_range_m)[:, axes].astype(np.float32)
        ranges = np.linalg.norm(points, axis=1)
        kept = (ranges >= tsdf.min_range_m) & (ranges < np.inf)
        scales = np.minimum(tsdf.max_range_m / ranges[kept], 1.0)  # unknown beyond
        T = inverse(T_map_sensor)
        centers = (unpack_keys(keys).astype(np.float64) + 0.5) * voxel_size_m
        voxels_m = (centers @ T[:3, :3].T + T[:3, 3])[:, axes].astype(np.float32)
        near = np.linalg.norm(voxels_m, axis=1) <= tsdf.max_range_m
        margin_m = self.config.dynamic.margin_m or math.sqrt(3.0) * voxel_size_m
        verdict = np.zeros(len(keys), np.int8)
        verdict[near] = look_through(points[kept] * scales[:, None], voxels_m[near], margin_m)
        return verdict
