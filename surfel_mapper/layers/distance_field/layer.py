# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The truncated signed distance field as a layer: fused from the scans, published as mesh and slice.

A scan is fused at once or, with ``layers.tsdf.when_final``, when it leaves the window and its pose
is final: fusion cannot be undone. The scan of a depth
camera is fused as an image, any other as points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.files.mesh_ply import write_mesh
from surfel_mapper.files.state import save_state
from surfel_mapper.files.tsdf_state import load_tsdf, tsdf_content
from surfel_mapper.layers.distance_field.field import DistanceField
from surfel_mapper.layers.distance_field.live_mesh import LiveMesh, WholeMesh
from surfel_mapper.layers.distance_field.obstacles import clearance_slice, slice_at
from surfel_mapper.layers.drawings import Drawing, MeshDrawing
from surfel_mapper.layers.layer import (
    Contains,
    Images,
    InsertedScan,
    Layer,
    Moment,
    Publication,
    Surroundings,
)
from surfel_mapper.layers.sensor_models import (
    camera_model,
    measured_channels,
    range_image,
    SensorModels,
    two_beams,
)
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.mapping.window import WindowedScan
from surfel_mapper.memory import machine_bytes
from surfel_mapper.messages.grids import occupancy_grid
from surfel_mapper.messages.pointcloud2 import cloud_bytes, from_columns
from surfel_mapper.scan import Scan
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.euclidean import EuclideanField
from surfel_mapper.tsdf.measurements import Integrated
from surfel_mapper.tsdf.mesh import Mesh

IMAGE_TOLERANCE_S = 0.02
"""An image belongs to a scan if their stamps differ by no more, s: less than half an image."""

LEAST_BYTES = 16 << 20
"""Memory that the field has at least: 20 m about the sensor at 0.25 m."""

MESHES_KEPT = 8
"""Messages of ~/mesh that its publisher keeps for slow readers: 32 MiB."""


def limit_bytes(config: Config) -> int:
    """Return the bytes that ``map.max_bytes`` allows; 0: no limit."""
    wanted = config.map.max_bytes
    return machine_bytes() // 2 if wanted < 0 else wanted


class TsdfLayer(Layer):
    """
    A signed distance field, fused scan by scan.

    Attributes
    ----------
    blocks : BlockMap
        The voxels.
    field : DistanceField
        The field, to query, save or fuse into; a new one after the layer was cleared.

    """

    name = 'tsdf'
    needs_free_rays = True

    def __init__(self, config: Config, around: Surroundings) -> None:
        super().__init__(config, around)
        self.clear()

    @property
    def images(self) -> Images:
        """Colour and label images, if configured."""
        config = self.config.tsdf
        return Images(
            topics=config.image_topics,
            tolerance_s=IMAGE_TOLERANCE_S,
            setting='layers.tsdf.color_topic, label_topic',
        )

    def clear(self) -> None:
        """Forget everything but the sensors."""
        self._begin(BlockMap(self.config.tsdf))

    def _begin(self, blocks: BlockMap) -> None:
        """Continue with a field."""
        self.blocks = blocks
        self.field = DistanceField(blocks=blocks)
        self._live_mesh = LiveMesh(self.blocks)
        self._whole_mesh = WholeMesh(self.blocks)
        esdf = self.config.esdf
        self._esdf = EuclideanField(self.blocks, max_m=esdf.max_m, radius_m=esdf.radius_m)
        self._position: npt.NDArray[np.float64] = np.zeros(3)
        self._waiting: dict[tuple[str, int], Scan] = {}
        self._num_scans = 0

    def follow(self, inserted: InsertedScan) -> list[Integrated]:
        """
        Fuse the scan that was inserted, or those that have left the window.

        Raises
        ------
        CloudFormatError
            If a column of a scan is of the wrong kind.
        MapLimitError
            If the field cannot hold a scan; it is as before then.
        PoseError
            If ``sensor_frame`` is not connected with the frame of a scan.

        """
        if len(inserted.cleared):
            self._clear_voxels(inserted.cleared)
        if not (self.config.tsdf.when_final and self.around.window.keeps_scans):
            return [self.insert(inserted.scan, inserted.T_map_sensor)]
        self._waiting[inserted.scan.frame_id, inserted.scan.stamp_ns] = inserted.scan
        return self._settle(eviction.scan for eviction in inserted.evictions)

    def finish(self) -> None:
        """Fuse the scans that still wait, at the poses that they have in the window."""
        try:
            self._settle(self.around.window)
        finally:
            self._waiting.clear()

    def insert(self, scan: Scan, T_map_sensor: npt.NDArray[np.float64]) -> Integrated:
        """
        Fuse a scan, and drop the blocks that are out of the limits of the layer.

        Raises
        ------
        CloudFormatError, MapLimitError, PoseError
            See follow.

        """
        scan, T_map_sensor = self.around.sensors.centered(scan, T_map_sensor)
        self._limit()
        sensor = self.around.sensors.camera_of(scan)
        config = self.config.tsdf
        wanted = {'has_color': config.color, 'has_label': config.semantics != 'none'}
        image = None if sensor is None else range_image(scan, sensor, **wanted)
        if image is None:
            points, channels = measured_channels(scan, config.max_range_m, **wanted)
            done = self.field.point_integrator.integrate(
                points, T_map_sensor, scan.stamp_ns, **channels
            )
        else:
            done = self.field.image_integrator.integrate(image, T_map_sensor, scan.stamp_ns)
        self._position = T_map_sensor[:3, 3].copy()
        self.blocks.evict(self._position)
        self._num_scans += 1
        return done

    def _limit(self) -> None:
        """Limit the field to the part of ``map.max_bytes`` that nothing else uses."""
        limit = limit_bytes(self.config)
        if not limit:
            self.blocks.max_bytes = 0
            return
        meshes = self.field.mesher.nbytes + self._live_mesh.nbytes + self._whole_mesh.nbytes
        used = self.around.surfel_map.nbytes + self.around.window.nbytes
        free = limit - used - meshes - self._esdf.nbytes
        self.blocks.max_bytes = max(free, LEAST_BYTES)

    @property
    def esdf(self) -> EuclideanField:
        """Euclidean distances to obstacles about the last scan, up to date; see ``esdf.*``."""
        self._esdf.update(self._position)
        return self._esdf

    def mesh(self) -> Mesh:
        """Return the surface; blocks that have not changed since the last call cost little."""
        return self.field.mesh()

    def _clear_voxels(self, voxel_index: npt.NDArray[np.int32]) -> None:
        """
        Set what lies in voxels (E, 3) of the map to unknown, as their surfels are gone.

        Also what lies within a voxel of the field around them: surfaces in their faces.
        """
        size_m, config = self.around.surfel_map.voxel_size_m, self.config.tsdf
        margin_m, block_m = config.voxel_size_m, config.voxels_per_side * config.voxel_size_m
        first = np.floor((voxel_index * size_m - margin_m) / block_m).astype(np.int64)
        last = np.floor(((voxel_index + 1) * size_m + margin_m) / block_m).astype(np.int64)
        steps = np.indices((int((last - first).max()) + 1,) * 3).reshape(3, -1).T
        rows = self.blocks.find(np.unique((first[:, None] + steps).reshape(-1, 3), axis=0))
        keys = pack_keys(voxel_index)

        def contains(points: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
            inside = np.zeros(len(points), np.bool_)
            for margins_m in itertools.product((-margin_m, margin_m), repeat=3):
                index = np.floor((points + margins_m) / size_m).astype(np.int32)
                inside |= np.isin(pack_keys(index), keys)
            return inside

        self.blocks.clear_region(contains, rows[rows >= 0])

    def clear_region(self, contains: Contains) -> None:
        """Set the voxels in a region to unknown."""
        self.blocks.clear_region(contains)

    def warm_up(self) -> None:
        """Compile the kernels, for points of either type and images."""
        tsdf = replace(self.config.tsdf, sensor_frame='')
        around = replace(self.around, sensors=SensorModels(tsdf))
        layer = TsdfLayer(replace(self.config, tsdf=tsdf), around)
        for dtype in (np.float32, np.float64):
            layer.insert(Scan(points=two_beams(dtype), stamp_ns=0, frame_id=''), np.eye(4))
        camera = camera_model((64.0, 48.0, 60.0, 60.0, 32.0, 24.0), 0.5, 5.0)
        layer.field.add_depth(np.full((48, 64), 2.0, np.float32), camera, np.eye(4))
        layer.mesh()
        list(layer._whole_mesh.messages(Moment()))
        if self.config.esdf.rate_hz:
            layer.esdf.known()

    def summary(self) -> dict[str, Any]:
        """Return the figures of the field."""
        return {
            'scans': self._num_scans,
            'waiting': len(self._waiting),
            'blocks': self.blocks.num_blocks,
            'bytes': self.blocks.nbytes,
            'blocks_evicted': self.blocks.num_evicted,
            'voxel_size_m': self.config.tsdf.voxel_size_m,
        }

    def publications(self) -> Sequence[Publication]:
        """Return the mesh, and the slice at ``layers.tsdf.slice_height_m``."""
        return (
            Publication(
                topic='~/mesh',
                type_name='visualization_msgs/msg/Marker',
                prepare=lambda: self._whole_mesh.prepare(),
                messages=lambda moment: self._whole_mesh.messages(moment),
                in_background=True,
                version=lambda _: (id(self.blocks), self.blocks.version),
                rate_hz=lambda config: config.tsdf.mesh_rate_hz,
            ),
            Publication(
                topic='~/mesh_tiles',
                type_name='visualization_msgs/msg/MarkerArray',
                prepare=lambda: not self.config.tsdf.mesh_rate_hz or self._live_mesh.prepare(),
                messages=lambda moment: self._live_mesh.changed(moment),
                all_messages=self._all_tiles,
                in_background=True,
                version=lambda _: (id(self.blocks), self.blocks.version),
                depth=MESHES_KEPT,
                rate_hz=lambda config: config.tsdf.mesh_rate_hz,
            ),
            Publication(
                topic='~/tsdf_slice',
                type_name='nav_msgs/msg/OccupancyGrid',
                messages=self._slice_messages,
                rate_hz=lambda config: config.tsdf.slice_rate_hz,
                is_eager=True,
            ),
            Publication(
                topic='~/esdf',
                type_name='sensor_msgs/msg/PointCloud2',
                messages=self._esdf_messages,
                in_background=True,
                version=lambda _: (id(self.blocks), self.blocks.version),
                rate_hz=lambda config: config.esdf.rate_hz,
            ),
            Publication(
                topic='~/esdf_slice',
                type_name='nav_msgs/msg/OccupancyGrid',
                messages=self._clearance_messages,
                rate_hz=lambda config: config.esdf.slice_rate_hz,
                is_eager=True,
            ),
        )

    def save(self, path: Path) -> Callable[[], object] | None:
        """Copy the field, to be written."""
        return partial(save_state, path, *tsdf_content(self.blocks))

    def load(self, path: Path) -> Callable[[], None]:
        """Read a field that ``save`` wrote; return the function that puts it in place."""
        return partial(self._begin, load_tsdf(path, self.config.tsdf))

    def write(self, directory: Path, formats: Sequence[str]) -> list[Path]:
        """Write mesh.ply."""
        path = directory / 'mesh.ply'
        write_mesh(path, self.mesh(), self.around.surfel_map.origin_m)
        return [path]

    def drawings(self) -> Sequence[Drawing]:
        """Return the mesh."""
        return [MeshDrawing(name='mesh', mesh=self.mesh())]

    def _all_tiles(self, moment: Moment) -> Iterable[bytes]:
        return self._live_mesh.complete(moment) if self.config.tsdf.mesh_rate_hz else ()

    def _slice_messages(self, moment: Moment) -> list[bytes]:
        grid = slice_at(self.blocks, self.config.tsdf.slice_height_m)
        return [occupancy_grid(grid.resolution_m, grid.origin, grid.cost, **moment.header)]

    def _esdf_messages(self, moment: Moment) -> Iterable[bytes]:
        """Return the cloud of the distances below esdf.max_m; serialised while iterated."""
        distances = self.esdf.known()
        near = distances.distance < self.config.esdf.max_m
        points = distances.points[near].astype(np.float32)
        columns = dict(zip('xyz', points.T, strict=True)) | {'distance': distances.distance[near]}
        return (cloud_bytes(from_columns(table), **moment.header) for table in [columns])

    def _clearance_messages(self, moment: Moment) -> list[bytes]:
        config = self.config.esdf
        heights_m, area = (config.slice_min_m, config.slice_max_m), self._position[:2]
        grid = clearance_slice(self.blocks, heights_m, config.max_m, area, config.radius_m)
        return [occupancy_grid(grid.resolution_m, grid.origin, grid.cost, **moment.header)]

    def _settle(self, scans: Iterable[WindowedScan]) -> list[Integrated]:
        """
        Fuse the scans of the window that wait, at their final poses.

        If one cannot be fused, the others are; the first error is raised after them.
        """
        results, errors = [], []
        for windowed in scans:
            scan = self._waiting.pop((windowed.frame_id, windowed.stamp_ns), None)
            if scan is None:
                continue
            try:
                results.append(self.insert(scan, windowed.T_map_sensor))
            except Exception as error:  # MemoryError too
                errors.append(error)
        if errors:
            raise errors[0]
        return results
