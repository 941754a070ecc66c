# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Selection of the blocks that a range image updates: touched by its rays, or in its field of view.

The cost of the first grows with the number of rays, of the second with the volume in view. Blocks
are fused independently, so a block that both select gets the same values. Blocks through which
rays only pass, which need no fusion if they are free already, are found here too.
"""

from __future__ import annotations

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
from surfel_mapper.tsdf.range_image import LEAST_COSINE, RangeImage

Int64 = npt.NDArray[np.int64]
Float64 = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

NO_COSINE = np.empty((0, 0), np.float32)

MAX_SIDE = 2048
"""Largest side of the cube about the sensor, blocks: 1 GiB of bits, twice that if carving."""

SPACING_VOXELS = 0.7
"""Largest spacing of the rays walked through the band, voxels; the smallest is half of it."""


class BlockSelection:
    """
    Selects blocks; keeps its working memory between calls.

    Parameters
    ----------
    config : TsdfConfig
        Size of voxels and blocks, truncation, allocation, carving.

    """

    def __init__(self, config: TsdfConfig) -> None:
        self._config = config
        self._marks = np.zeros((2, 0), np.int64)

    def blocks(self, image: RangeImage, T_map_sensor: Float64) -> tuple[Int64, Flags]:
        """
        Return the blocks that a range image updates, and those near its surface.

        Returns
        -------
        index : (K, 3) int64
            The blocks, ascending.
        near : (K,) bool
            False for blocks that rays only pass through; True for all if nothing is carved.

        Raises
        ------
        MapLimitError
            If the range is more than MAX_SIDE / 2 blocks.

        """
        config = self._config
        half = half_side(config, image)
        if half == 0:
            return np.empty((0, 3), np.int64), np.empty(0, bool)
        side = 2 * half + 1
        if side > MAX_SIDE:
            raise MapLimitError(
                f'a range of {image.largest_m:g} m is {half} blocks of '
                f'{config.block_size_m:g} m, expected at most {MAX_SIDE // 2}; use larger '
                'voxels or a smaller max_range_m'
            )
        if config.allocation == 'frustum' and not config.carve:
            index = in_view(config, image, T_map_sensor, half)
            return index, np.ones(len(index), bool)
        marks, near, low = self._marked(image, T_map_sensor, half)
        index = np.empty((count_marks(marks), 3), np.int64)
        list_marks(marks, side, low, index)
        if config.allocation == 'frustum':
            index = in_view(config, image, T_map_sensor, half)
        is_near = np.ones(len(index), bool)
        if config.carve:
            look_up_marks(near, side, low, index, is_near)
        return index, is_near

    def _marked(
        self, image: RangeImage, T_map_sensor: Float64, half: int
    ) -> tuple[Int64, Int64, Int64]:
        """Return the marks of blocks that rays touch, of those in the band, and the corner."""
        config, side = self._config, 2 * half + 1
        num_words = side**3 // 64 + 1
        if self._marks.shape[1] < num_words:
            self._marks = np.zeros((1 + config.carve, num_words), np.int64)
        marks, near = self._marks[0, :num_words], self._marks[1:].ravel()[:num_words]
        near[:] = 0
        pose = T_map_sensor[:3] / config.block_size_m
        low = np.floor(pose[:, 3]).astype(np.int64) - half
        pose[:, 3] -= low
        cosine = NO_COSINE if image.cosine is None else image.cosine
        directions = image.sensor.directions
        limits = reach(config, image)
        mark_rays(image.range_m, cosine, directions, pose, limits, side, marks, near)
        return marks, near, low


def reach_behind_m(config: TsdfConfig, image: RangeImage) -> float:
    """Return the distance behind a surface up to which voxels change, along the ray, m."""
    longer = 1.0 if image.cosine is None else 1.0 / LEAST_COSINE
    return config.reach_behind_m * longer


def half_side(config: TsdfConfig, image: RangeImage) -> int:
    """Return the reach of an image in blocks; 0 for an image without ranges."""
    if image.largest_m == 0.0:
        return 0
    return int((image.largest_m + reach_behind_m(config, image)) / config.block_size_m) + 2


def reach(config: TsdfConfig, image: RangeImage) -> Float64:
    """Return the reach of rays, (NUM_REACH,), in the order of tsdf/kernels/block_marks.py."""
    sensor = image.sensor
    free = [config.block_size_m / 8.0 / pitch for pitch in sensor.pitch_rad]
    band = [SPACING_VOXELS * config.voxel_size_m / pitch for pitch in sensor.pitch_rad]
    ends = [config.truncation_m, config.reach_behind_m, sensor.min_range_m, sensor.max_range_m]
    return np.array([*ends, float(config.carve), *free, *band])


def in_view(config: TsdfConfig, image: RangeImage, T_map_sensor: Float64, half: int) -> Int64:
    """Return the blocks that intersect the field of view up to the largest range, (K, 3)."""
    size_m, sensor = config.block_size_m, image.sensor
    radius_m = np.sqrt(0.75) * size_m
    middle = np.floor(T_map_sensor[:3, 3] / size_m).astype(np.int64)
    along = np.arange(-half, half + 1)
    found = []
    for layer in along:  # by layers, because the whole cube may be large
        grid = np.meshgrid([layer], along, along, indexing='ij')
        index = middle + np.stack(grid, axis=-1).reshape(-1, 3)
        centres = ((index + 0.5) * size_m - T_map_sensor[:3, 3]) @ T_map_sensor[:3, :3]
        distance = np.linalg.norm(centres, axis=1)
        near = distance >= sensor.min_range_m - radius_m
        far = distance <= image.largest_m + reach_behind_m(config, image) + radius_m
        found.append(index[near & far & sensor.sees(centres, radius_m)])
    return np.concatenate(found)
