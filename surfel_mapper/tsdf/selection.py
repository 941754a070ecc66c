# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Selection of the blocks that a range image updates: those that its rays touch.

Blocks through which rays only pass, which need no fusion if they are free already, are found here
too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import MapLimitError
from surfel_mapper.tsdf.kernels.block_marks import (
    count_marks,
    list_marks,
    look_up_marks,
    mark_rays,
)
from surfel_mapper.tsdf.range_image import RangeImage

Int64 = npt.NDArray[np.int64]
Float64 = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

MAX_SIDE = 2048
"""Largest side of the cube about the sensor, blocks: 1 GiB of bits in each row of marks."""

TOUCHED, NEAR = range(2)
"""Rows of marks: blocks that rays touch, and those in the band."""

NO_BLOCKS: Int64 = np.empty((0, 3), np.int64)

SPACING_VOXELS = 0.7
"""Largest spacing of the rays walked through the band, voxels; the smallest is half of it."""


@dataclass(frozen=True, kw_only=True)
class Selected:
    """
    Blocks that a range image updates.

    Attributes
    ----------
    index : (K, 3) int64
        The blocks, ascending.
    near : (K,) bool
        False for blocks that rays only pass through; True for all if nothing is carved.

    """

    index: Int64
    near: Flags


class BlockSelection:
    """
    Selects blocks; keeps its working memory between calls.

    Parameters
    ----------
    config : TsdfConfig
        Size of voxels and blocks, truncation, carving.

    """

    def __init__(self, config: TsdfConfig) -> None:
        self._config = config
        self._marks = np.zeros((2, 0), np.int64)

    def blocks(self, image: RangeImage, T_map_sensor: Float64) -> Selected:
        """
        Return the blocks that a range image updates.

        Parameters
        ----------
        image : RangeImage
            The measurement.
        T_map_sensor : (4, 4) float64
            Pose of the sensor in the map frame.

        Raises
        ------
        MapLimitError
            If the range is more than MAX_SIDE / 2 blocks.

        """
        config = self._config
        half = half_side(config, image)
        if half == 0:
            return Selected(index=NO_BLOCKS, near=np.empty(0, bool))
        side = 2 * half + 1
        if side > MAX_SIDE:
            raise MapLimitError(
                f'a range of {image.largest_m:g} m is {half} blocks of '
                f'{config.block_size_m:g} m, expected at most {MAX_SIDE // 2}; use larger '
                'voxels or a smaller max_range_m'
            )
        pose = T_map_sensor[:3] / config.block_size_m
        low = np.floor(pose[:, 3]).astype(np.int64) - half
        marks = self._marked(image, pose, low, side)
        index = listed(marks[TOUCHED], low, side)
        near = np.ones(len(index), bool)
        if config.carve_m > 0.0:
            look_up_marks(marks[NEAR], side, low, index, near)
        return Selected(index=index, near=near)

    def _marked(self, image: RangeImage, pose: Float64, low: Int64, side: int) -> Int64:
        """Return the marks of blocks that rays touch, and of those in the band, (2, words)."""
        config, num_words = self._config, side**3 // 64 + 1
        if self._marks.shape[1] < num_words:
            self._marks = np.zeros((2, num_words), np.int64)
        marks = self._marks[:, :num_words]
        marks[NEAR] = 0
        local = np.column_stack([pose[:, :3], pose[:, 3] - low])
        near = marks[NEAR] if config.carve_m > 0.0 else marks[NEAR, :0]
        directions, limits = image.sensor.directions, reach(config, image)
        mark_rays(image.range_m, directions, local, limits, side, marks[TOUCHED], near)
        return marks


def listed(marks: Int64, low: Int64, side: int) -> Int64:
    """Return the marked blocks, (K, 3) int64, ascending, and clear the marks."""
    index = np.empty((count_marks(marks), 3), np.int64)
    list_marks(marks, side, low, index)
    return index


def half_side(config: TsdfConfig, image: RangeImage) -> int:
    """Return the reach of an image in blocks; 0 for an image without ranges."""
    if image.largest_m == 0.0:
        return 0
    return int((image.largest_m + config.tau_m) / config.block_size_m) + 2


def reach(config: TsdfConfig, image: RangeImage) -> Float64:
    """Return the reach of rays, (NUM_REACH,), in the order of tsdf/kernels/block_marks.py."""
    sensor = image.sensor
    free = [config.block_size_m / 8.0 / pitch for pitch in sensor.pitch_rad]
    band = [SPACING_VOXELS * config.voxel_size_m / pitch for pitch in sensor.pitch_rad]
    ends = [config.tau_m, sensor.min_range_m, sensor.max_range_m]
    return np.array([*ends, float(config.carve_m > 0.0), *free, *band])
