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
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import TsdfConfig
from surfel_mapper.threads import share, usable_cores
from surfel_mapper.tsdf.blocks import BlockMap, Int64
from surfel_mapper.tsdf.kernels import lookup as kernels
from surfel_mapper.tsdf.kernels.integration import integrate_blocks, NUM_FOUND
from surfel_mapper.tsdf.measurements import (
    checked_pose,
    fuse_into,
    Integrated,
    settings,
    warn_of_short_truncation,
)
from surfel_mapper.tsdf.range_image import RangeImage
from surfel_mapper.tsdf.selection import BlockSelection, half_side

logger = logging.getLogger(__name__)

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

MAX_DIFFERENCE_M = 0.2
"""Pixels that differ by more are not interpolated, m."""

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
        warn_of_short_truncation(config)
        self._selection = BlockSelection(config)
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
        *,
        allocate_blocks: bool = True,
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
        allocate_blocks : bool
            False: only blocks of the map are updated.

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
        image = self._labelled(image)
        blocks, side = self.blocks, 2 * half_side(self.blocks.config, image) + 1
        blocks.charge(side**3 // 4, f'an image of ranges up to {image.largest_m:g} m')
        selected = self._selection.blocks(image, T)
        if allocate_blocks:
            fit = blocks.admit(selected.index, T[:3, 3])
        else:
            fit = blocks.find(selected.index) >= 0
        index = selected.index[fit]

        def fuse(chosen: Int64, rows: Int64) -> Int64:
            return self._fuse(image, T, stamp_ns, index[chosen], rows)

        return fuse_into(blocks, index, selected.near[fit], stamp_ns, fuse)

    def _fuse(
        self,
        image: RangeImage,
        T_map_sensor: Float64,
        stamp_ns: int,
        index: Int64,
        rows: Int64,
    ) -> Int64:
        """Fuse an image into blocks; return figures of each."""
        config, sensor = self.blocks.config, image.sensor
        R_sensor_map = T_map_sensor[:3, :3].T
        corner = index * config.block_size_m + 0.5 * config.voxel_size_m
        corners = ((corner - T_map_sensor[:3, 3]) @ R_sensor_map.T).astype(np.float32)
        offsets = (R_sensor_map @ self._voxels).astype(np.float32)
        figures = np.empty((len(rows), NUM_FOUND), np.int64)
        per_block = rows, corners, self.blocks.forgetting_rates(rows, stamp_ns)
        common = (
            offsets,
            self.blocks.field,
            sensor.projection,
            self._images(image),
            image_settings(config, image),
            (self.blocks.color, self.blocks.votes),
        )

        def fuse(chunk: slice) -> None:
            where = tuple(values[chunk] for values in per_block)
            integrate_blocks(where, *common, figures[chunk])

        share(fuse, len(rows), self._threads)
        return figures

    def _labelled(self, image: RangeImage) -> RangeImage:
        """Return an image in which labels of moving objects are masked."""
        if image.label is None or not len(self._dynamic_labels):
            return image
        mask = np.isin(image.label, self._dynamic_labels).astype(np.uint8)
        return replace(image, mask=mask if image.mask is None else mask | image.mask)

    def _images(self, image: RangeImage) -> tuple[npt.NDArray[Any], ...]:
        """Return ranges in pairs, colours, labels, mask; missing ones have no rows."""
        mask, label = image.mask, image.label
        rows, (first, last) = kernels.BORDER
        edges = [rows, (first, last)]
        return (
            paired(np.pad(image.range_m, edges)),
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
    sensor, values = image.sensor, settings(config)
    values[kernels.MIN_RANGE] = sensor.min_range_m
    values[kernels.MAX_RANGE] = sensor.max_range_m
    values[kernels.LIMIT] = image.largest_m + config.tau_m
    values[kernels.MAX_DIFFERENCE] = MAX_DIFFERENCE_M
    return values
