# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The TSDF that a mapper keeps beside its surfels.

A scan enters at once, or where ``layers.tsdf.when_final`` asks for it, when it leaves the window
and its pose can change no more: what is fused cannot be moved. The sensor is the camera that a
scan names, else the lidar that its first points show; see tsdf/fitting.py.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import TsdfConfig
from surfel_mapper.mapping.channels import quantised
from surfel_mapper.mapping.window import Eviction, WindowedScan
from surfel_mapper.pipeline.sensor_models import measured, SensorModels
from surfel_mapper.scan import Scan
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.integrator import Integrated, Integrator
from surfel_mapper.tsdf.mesh import Mesh, Mesher
from surfel_mapper.tsdf.range_image import from_points, RangeImage


class TsdfLayer:
    """
    A signed distance field, fed scan by scan.

    Parameters
    ----------
    config : TsdfConfig
        Its settings.
    sensors : SensorModels, optional
        What the scans come from, where others look at them too.

    """

    def __init__(self, config: TsdfConfig, sensors: SensorModels | None = None) -> None:
        """Begin with an empty field."""
        self.config = config
        self._sensors = sensors or SensorModels(config)
        self.clear()

    def clear(self) -> None:
        """Forget everything but the sensors."""
        self.blocks = BlockMap(self.config)
        self._integrator = Integrator(self.blocks)
        self._mesher = Mesher(self.blocks)
        self._waiting: dict[int, Scan] = {}
        self._num_scans = self._num_refused = self._num_labels_lost = 0

    def follow(
        self, scan: Scan, T_map_sensor: npt.NDArray[np.float64], evictions: Iterable[Eviction]
    ) -> None:
        """
        Take the scan that was mapped, or those that have left the window.

        Raises
        ------
        CloudFormatError
            If the sensor cannot be told from the points of a scan.
        MapLimitError
            If the field cannot hold a scan; it is as before then.

        """
        if not self.config.when_final:
            self.insert(scan, T_map_sensor)
            return
        self._waiting[scan.stamp_ns] = scan
        for eviction in evictions:
            self._settle(eviction.scan)

    def finish(self, window: Iterable[WindowedScan]) -> None:
        """Take the scans that still wait, at the poses they have in the window."""
        for scan in window:
            self._settle(scan)
        self._waiting.clear()

    def insert(self, scan: Scan, T_map_sensor: npt.NDArray[np.float64]) -> Integrated:
        """
        Fuse a scan, and let go of the blocks that the window leaves behind.

        Raises
        ------
        CloudFormatError, MapLimitError
            See follow.

        """
        image = self._range_image(scan)
        self.blocks.clear_updated()
        done = self._integrator.integrate(image, T_map_sensor, scan.stamp_ns)
        self.blocks.evict(T_map_sensor[:3, 3], scan.stamp_ns)
        self._num_scans += 1
        self._num_refused += done.num_refused
        self._num_labels_lost += done.num_labels_lost
        return done

    def mesh(self) -> Mesh:
        """Return the surface; blocks that have not changed since the last call cost little."""
        self._mesher.update()
        return self._mesher.mesh()

    def warm_up(self) -> None:
        """Compile the kernels, for points of either type."""
        turn = np.linspace(0.0, 2.0 * np.pi, 64)
        ring = np.stack([10.0 * np.cos(turn), 10.0 * np.sin(turn), np.linspace(-1, 1, 64)], 1)
        for dtype in (np.float32, np.float64):
            layer = TsdfLayer(self.config)
            layer.insert(Scan(points=ring.astype(dtype), stamp_ns=0, frame_id=''), np.eye(4))
        layer.mesh()

    def summary(self) -> dict[str, Any]:
        """Return what the field is, for files, reports and diagnostics."""
        return {
            'scans': self._num_scans,
            'waiting': len(self._waiting),
            'blocks': self.blocks.num_blocks,
            'blocks_refused': self._num_refused,
            'labels_lost': self._num_labels_lost,
            'bytes': self.blocks.nbytes,
            'voxel_size_m': self.config.voxel_size_m,
        }

    def _range_image(self, scan: Scan) -> RangeImage:
        """Return what the sensor of a scan measured: its points, and where it found nothing."""
        columns, sensor = scan.columns, self._sensors.of(scan)
        points = measured(scan, sensor.max_range_m)
        num_free = len(points) - len(scan)
        colors = colors_of(scan) if self.config.color else None
        labels = columns.get('label') if self.config.semantics != 'none' else None
        if colors is not None:
            colors = np.pad(colors, ((0, num_free), (0, 0)))
        if labels is not None:
            labels = np.pad(labels, (0, num_free), constant_values=-1)
        return from_points(sensor, points, colors=colors, labels=labels)

    def _settle(self, windowed: WindowedScan) -> None:
        scan = self._waiting.pop(windowed.stamp_ns, None)
        if scan is not None:
            self.insert(scan, windowed.T_map_sensor)


def colors_of(scan: Scan) -> npt.NDArray[np.uint8] | None:
    """
    Return the colours of the points, (N, 3), or (N, 4) with the fourth 0 where there is none.

    Alpha tells which have one, unless it is 0 everywhere: some drivers leave it so.
    """
    columns = scan.columns
    if not {'rgb', 'rgba'} & columns.keys():
        return None
    colors = quantised(columns, ('rgb',), len(scan)).astype(np.uint8)
    packed = columns['rgba'] if 'rgb' not in columns else None
    if packed is None or packed.dtype != np.uint32 or not (packed >> 24).any():
        return colors
    return np.column_stack([colors, (packed >> 24).astype(np.uint8)])
