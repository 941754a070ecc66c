# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Integrator: fuses range images into a block map.

One step selects the blocks, adds those that are missing, fuses each block independently, and
removes added blocks that no measurement touched. Blocks are divided among threads; the result has
the same bits for any number of threads. See tsdf/kernels/integration.py for the work in a block.
"""

from __future__ import annotations

from dataclasses import replace
import logging
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import TsdfConfig
from surfel_mapper.threads import share, usable_cores
from surfel_mapper.tsdf.blocks import BlockMap, Int64
from surfel_mapper.tsdf.kernels import lookup as kernels
from surfel_mapper.tsdf.kernels.blocks import FREE_VISITS, STAMP
from surfel_mapper.tsdf.kernels.integration import (
    INSIDE,
    integrate_blocks,
    MOVED,
    NUM_FOUND,
    OBSERVED,
    SOLID,
)
from surfel_mapper.tsdf.kernels.point_fusion import sum_surfaces
from surfel_mapper.tsdf.measurements import (
    checked_pose,
    Integrated,
    POWERS,
    settings,
)
from surfel_mapper.tsdf.range_image import RangeImage
from surfel_mapper.tsdf.selection import BlockSelection, NO_COSINE, reach_behind_m
from surfel_mapper.tsdf.sensors import LidarModel, Sensor

logger = logging.getLogger(__name__)

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

SETTLED, RECHECK = 4, 8
"""
A block that was free in SETTLED measurements in a row is fused in one of RECHECK only.

With a lidar of 10 Hz a block between the beams is complete after a second or two; of the blocks of
a street that a scan carves, 40 % are skipped, of a hall with voxels of 0.1 m 65 %.
"""

THIN_VOXELS = 1.25
"""
Objects narrower than this, seen by a lidar, are fused by their points too.

Of poles of 1, 0.5 and 0.25 voxels the mesh without it goes through 94, 45 and 20 % of the points.
"""

NO_COLOR = np.empty((0, 0, 3), np.uint8)
NO_LABEL = np.empty((0, 0), np.int32)
NO_MASK = np.empty((0, 0), np.uint8)


class Integrator:
    """
    Fuses range images into a block map.

    Parameters
    ----------
    blocks : BlockMap
        The map.

    """

    def __init__(self, blocks: BlockMap) -> None:
        """Prepare for the settings of the map; warn if they leave holes."""
        self.blocks = blocks
        config = blocks.config
        if config.truncation_m < 2.0 * config.voxel_size_m:
            logger.warning(
                'layers.tsdf.truncation_m: %g m is less than two voxels of %g m; surfaces may '
                'have holes',
                config.truncation_m,
                config.voxel_size_m,
            )
        self._selection = BlockSelection(config)
        self._has_warned = False
        self._num_images = 0
        self._threads = config.threads or usable_cores()
        side = np.arange(config.voxels_per_side) * config.voxel_size_m
        z, y, x = np.meshgrid(side, side, side, indexing='ij')
        self._voxels = np.stack([x.ravel(), y.ravel(), z.ravel()])
        self._dynamic_labels = np.array(config.dynamic_labels, np.int32)

    def integrate(
        self,
        image: RangeImage,
        T_map_sensor: Float64,
        stamp_ns: int = 0,
    ) -> Integrated:
        """
        Fuse a range image into the map.

        Parameters
        ----------
        image : RangeImage
            The measurement.
        T_map_sensor : (4, 4) float64
            Pose of the sensor in the map frame.
        stamp_ns : int
            Stamp of the measurement, ns.

        Returns
        -------
        Integrated
            Counts of blocks and voxels.

        Raises
        ------
        PoseError
            If the pose is not a finite rigid transform.
        MapLimitError
            If the range or the position exceeds the index range of the map, or memory is short;
            the map is unchanged.

        """
        T = checked_pose(T_map_sensor)
        self._warn_of_radius(image.sensor)
        if self.blocks.config.distance == 'to_plane' and image.cosine is None:
            image = image.with_cosines(self.blocks.config.voxel_size_m)
        image = self._labelled(image)
        thin = self._thin_points(image, T)
        selected = self._selection.blocks(image, T, thin)
        index, blocks = selected.index, self.blocks
        num_before = blocks.num_blocks
        rows = blocks.place(index)
        try:
            skipped = ~selected.near & self._free_for_long(rows)
            blocks.head[rows[skipped], STAMP] = stamp_ns
            fused = ~skipped
            sums = self._thin_sums(thin, selected.thin, image, T)
            figures = self._fuse(image, T, stamp_ns, index[fused], rows[fused], sums)
            observed = figures[:, OBSERVED]
            changed = observed > 0
            updated = rows[fused][changed]
            if len(updated):
                columns = (figures[changed, column] for column in (MOVED, SOLID, INSIDE))
                blocks.touch_fused(updated, stamp_ns, *columns)
        finally:
            blocks.drop_new(rows)
        return Integrated(
            num_blocks=len(index),
            num_updated=len(updated),
            num_skipped=int(skipped.sum()),
            num_added=blocks.num_blocks - num_before,
            num_voxels=int(observed.sum()),
        )

    def _thin_points(self, image: RangeImage, T_map_sensor: Float64) -> Float64:
        """Return the points of objects thinner than THIN_VOXELS, map frame, in voxels, (P, 3)."""
        size_m, sensor = self.blocks.config.voxel_size_m, image.sensor
        thin = image.thin(size_m, THIN_VOXELS * size_m)
        range_m = image.range_m[:, : sensor.columns][thin].astype(np.float64)
        local = sensor.directions[thin] * range_m[:, None]
        points: Float64 = (local @ T_map_sensor[:3, :3].T + T_map_sensor[:3, 3]) / size_m
        return points

    def _thin_sums(
        self, points: Float64, index: Int64, image: RangeImage, T_map_sensor: Float64
    ) -> tuple[Int64, Float32]:
        """
        Return the sums of thin objects, and the place in them of each row, -1 for none.

        The sums are of the voxels about the points only: those farther from the surface, and what
        is beside it, the image shows.
        """
        config, blocks = self.blocks.config, self.blocks
        rows = blocks.find(index)
        slots = np.full(len(blocks.head), -1, np.int64)
        slots[rows[rows >= 0]] = np.flatnonzero(rows >= 0)
        sums = np.zeros((len(index), blocks.voxels_per_block, 3), np.float32)
        if len(points):
            content = config.voxel_size_m, config.voxels_per_side.bit_length() - 1
            weights = image_settings(config, image), POWERS[config.weight_mode]
            origin = T_map_sensor[:3, 3] / config.voxel_size_m
            sum_surfaces(points, origin, True, *content, *weights, blocks.lookup, slots, sums)
        return slots, sums

    def _fuse(
        self,
        image: RangeImage,
        T_map_sensor: Float64,
        stamp_ns: int,
        index: Int64,
        rows: Int64,
        thin: tuple[Int64, Float32],
    ) -> Int64:
        """Fuse an image into blocks; return figures of each."""
        config, sensor = self.blocks.config, image.sensor
        R_sensor_map = T_map_sensor[:3, :3].T
        corner = index * config.block_size_m + 0.5 * config.voxel_size_m
        corners = ((corner - T_map_sensor[:3, 3]) @ R_sensor_map.T).astype(np.float32)
        offsets = (R_sensor_map @ self._voxels).astype(np.float32)
        figures = np.empty((len(rows), NUM_FOUND), np.int64)
        slots, sums = thin
        per_block = rows, corners, self.blocks.forgetting_rates(rows, stamp_ns), slots[rows]
        common = (
            offsets,
            self.blocks.field,
            (*sensor.projection, sensor.row_gaps_rad),
            self._images(image),
            sums,
            image_settings(config, image),
            POWERS[config.weight_mode],
            (self.blocks.color, self.blocks.votes),
        )

        def fuse(chunk: slice) -> None:
            where = tuple(values[chunk] for values in per_block)
            integrate_blocks(where, *common, figures[chunk])

        share(fuse, len(rows), self._threads)
        return figures

    def _free_for_long(self, rows: Int64) -> npt.NDArray[np.bool_]:
        """
        Return which blocks were free in the last measurements, and need no fusion now, (K,).

        One in RECHECK of them is fused all the same, in turn, so that voxels between the beams
        are found free too, and surfaces that no ray meets in the block itself.
        """
        config = self.blocks.config
        self._num_images += 1
        if not config.carve:
            return np.zeros(len(rows), bool)
        visits = self.blocks.head[rows, FREE_VISITS]
        settled: npt.NDArray[np.bool_] = visits >= SETTLED
        settled &= (rows + self._num_images) % RECHECK != 0
        return settled

    def _warn_of_radius(self, sensor: Sensor) -> None:
        """Warn once if the window is smaller than the reach of the sensor."""
        config = self.blocks.config
        needed_m = sensor.max_range_m + math.sqrt(0.75) * config.block_size_m
        if 0.0 < config.max_radius_m < needed_m and not self._has_warned:
            self._has_warned = True
            logger.warning(
                'layers.tsdf.max_radius_m: %g m is less than the range of the sensor plus half '
                'the diagonal of a block, %.4g m; blocks beyond it come and go with every scan',
                config.max_radius_m,
                needed_m,
            )

    def _labelled(self, image: RangeImage) -> RangeImage:
        """Return an image in which labels of moving objects are masked."""
        if image.label is None or not len(self._dynamic_labels):
            return image
        mask = np.isin(image.label, self._dynamic_labels).astype(np.uint8)
        return replace(image, mask=mask if image.mask is None else mask | image.mask)

    def _images(self, image: RangeImage) -> tuple[npt.NDArray[Any], ...]:
        """Return ranges in pairs, cosines, colours, labels, mask; missing ones have no rows."""
        mask, label = image.mask, image.label
        rows, (first, last) = kernels.BORDER
        edges = [rows, (first, last - image.sensor.wraps)]
        return (
            paired(np.pad(image.range_m, edges)),
            NO_COSINE if image.cosine is None else np.pad(image.cosine, edges),
            NO_COLOR if image.color is None else image.color,
            NO_LABEL if label is None else label,
            NO_MASK if mask is None else mask,
        )


def paired(range_m: Float32) -> Int64:
    """Return each pixel and its right neighbour in one number, so that both are read at once."""
    pairs = np.zeros((*range_m.shape, 2), np.float32)
    pairs[..., 0] = range_m
    pairs.reshape(-1, 2)[:-1, 1] = range_m.ravel()[1:]
    return pairs.view(np.int64)[..., 0]


def image_settings(config: TsdfConfig, image: RangeImage) -> Float32:
    """Return the settings of the integration of an image, in the order of kernels/lookup.py."""
    sensor, is_lidar = image.sensor, isinstance(image.sensor, LidarModel)
    values = settings(config)
    values[kernels.MIN_RANGE] = sensor.min_range_m
    values[kernels.MAX_RANGE] = sensor.max_range_m
    values[kernels.LIMIT] = image.largest_m + reach_behind_m(config, image)
    values[kernels.MAX_DIFFERENCE] = config.max_difference_m
    values[kernels.MAX_OFFSET] = config.ray_offset_voxels * config.voxel_size_m * is_lidar
    values[kernels.COLUMN_RAD] = sensor.pitch_rad[1]
    return values
