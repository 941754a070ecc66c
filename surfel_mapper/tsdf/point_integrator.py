# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
PointIntegrator: fuses clouds into a block map ray by ray, without a projection model.

For clouds that are no range image: merged from several sensors, from solid-state lidars with
irregular patterns, or in a frame that is not at the optical centre. Slower than Integrator, which
looks each voxel up in a range image, and independent of the order and the density of points. The
distances are along rays; ``distance`` and the settings of range images do not apply.

Source: voxel by voxel along each ray as voxblox (Oleynikova et al. 2017), with eight voxels about
samples near the surface; see kernels/point_fusion.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import CloudFormatError, MapLimitError
from surfel_mapper.tsdf.blocks import BlockMap, Int64
from surfel_mapper.tsdf.kernels import point_fusion as kernels
from surfel_mapper.tsdf.kernels.block_marks import mark_rays
from surfel_mapper.tsdf.kernels.integration import INSIDE, MOVED, NUM_FOUND, OBSERVED, SOLID
from surfel_mapper.tsdf.measurements import (
    checked_pose,
    Integrated,
    POWERS,
    settings,
)
from surfel_mapper.tsdf.selection import listed, MAX_SIDE, NO_COSINE

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

NO_COLORS = np.empty((0, 3), np.uint8)
NO_LABELS = np.empty(0, np.int32)


class PointIntegrator:
    """
    Fuses points into a block map.

    Parameters
    ----------
    blocks : BlockMap
        The map.

    """

    def __init__(self, blocks: BlockMap) -> None:
        self.blocks = blocks
        config = blocks.config
        self._bits = config.voxels_per_side.bit_length() - 1
        self._dynamic_labels = np.array(config.dynamic_labels, np.int32)

    def integrate(
        self,
        points: npt.NDArray[Any],
        T_map_sensor: Float64,
        stamp_ns: int = 0,
        *,
        colors: npt.NDArray[np.uint8] | None = None,
        labels: npt.NDArray[Any] | None = None,
    ) -> Integrated:
        """
        Fuse points into the map.

        Parameters
        ----------
        points : (N, 3) float32 or float64
            In the frame of the sensor, m; non-finite points are skipped.
        T_map_sensor : (4, 4) float64
            Pose of the sensor in the map frame.
        stamp_ns : int
            Stamp of the measurement, ns.
        colors : (N, 3 or 4) uint8, optional
            Red, green, blue of each point; a fourth channel of 0 means unknown.
        labels : (N,) int, optional
            Label of each point, -1 for unknown. Points of dynamic labels only free the space in
            front of them.

        Returns
        -------
        Integrated
            Counts of blocks and voxels.

        Raises
        ------
        CloudFormatError
            If a shape is not as above.
        PoseError
            If the pose is not a finite rigid transform.
        MapLimitError
            If the range or the position exceeds the index range of the map, or memory is short;
            the map is unchanged.

        """
        T = checked_pose(T_map_sensor)
        for name, values in (('colors', colors), ('labels', labels)):
            if values is not None and len(values) != len(points):
                raise CloudFormatError(f'{name}: {len(values)}, expected {len(points)} as points')
        voxel_m, blocks = self.blocks.config.voxel_size_m, self.blocks
        used = np.isfinite(points).all(axis=1)
        local = points[used].astype(np.float64)
        ranges = np.linalg.norm(local, axis=1)
        scaled = (local @ T[:3, :3].T + T[:3, 3]) / voxel_m
        solid: npt.NDArray[Any] = np.ones(len(local), bool)
        if labels is not None:
            labels = np.asarray(labels[used], np.int32)
            solid = ~np.isin(labels, self._dynamic_labels)
            labels = labels[solid]
        if colors is not None:
            colors = np.ascontiguousarray(colors[used][solid])
        surfaces = np.ascontiguousarray(scaled[solid])
        index = self._touched(local, ranges, surfaces, T)
        num_before = blocks.num_blocks
        rows = blocks.place(index)
        try:
            slots = np.full(len(blocks.head), -1, np.int64)
            slots[rows] = np.arange(len(rows))
            rates = blocks.forgetting_rates(rows, stamp_ns)
            figures = self._fuse(scaled, surfaces, T[:3, 3] / voxel_m, rows, slots, rates)
            images = (
                NO_COLORS if colors is None else colors,
                NO_LABELS if labels is None else labels,
            )
            self._fuse_channels(surfaces, ranges[solid], rates, slots, images)
            changed = figures[:, OBSERVED] > 0
            if changed.any():
                columns = (figures[changed, column] for column in (MOVED, SOLID, INSIDE))
                blocks.touch_fused(rows[changed], stamp_ns, *columns)
        finally:
            blocks.drop_new(rows)
        return Integrated(
            num_blocks=len(index),
            num_updated=int(changed.sum()),
            num_skipped=0,
            num_added=blocks.num_blocks - num_before,
            num_voxels=int(figures[:, OBSERVED].sum()),
        )

    def _fuse(
        self,
        scaled: Float64,
        surfaces: Float64,
        origin: Float64,
        rows: Int64,
        slots: Int64,
        rates: Float32,
    ) -> Int64:
        """Fuse distances, points and origin in voxels; return figures of each block."""
        config, blocks = self.blocks.config, self.blocks
        sums = np.zeros((len(rows), blocks.voxels_per_block, 3), np.float32)
        content = (
            config.voxel_size_m,
            self._bits,
            settings(self.blocks.config),
            POWERS[config.weight_mode],
        )
        kernels.sum_surfaces(surfaces, origin, False, *content, blocks.lookup, slots, sums)
        if config.carve:
            kernels.sum_free(scaled, origin, *content, blocks.lookup, slots, sums)
        figures = np.empty((len(rows), NUM_FOUND), np.int64)
        kernels.fuse_sums(rows, sums, rates, settings(config), blocks.field, figures)
        return figures

    def _touched(
        self, local: Float64, ranges: Float64, surfaces: Float64, T_map_sensor: Float64
    ) -> Int64:
        """Return the blocks that the rays touch, (K, 3) int64, ascending."""
        config = self.blocks.config
        valid = ranges >= config.min_range_m
        if not valid.any():
            return np.empty((0, 3), np.int64)
        reach_m = min(float(ranges[valid].max()), config.max_range_m) + config.truncation_m
        half = int(reach_m / config.block_size_m) + 2
        side = 2 * half + 1
        if side > MAX_SIDE:
            raise MapLimitError(
                f'a range of {reach_m:g} m is {half} blocks of {config.block_size_m:g} m, '
                f'expected at most {MAX_SIDE // 2}; use larger voxels or a smaller max_range_m'
            )
        marks = np.zeros(side**3 // 64 + 1, np.int64)
        pose = T_map_sensor[:3] / config.block_size_m
        low = np.floor(pose[:, 3]).astype(np.int64) - half
        pose[:, 3] -= low
        directions = (local / np.maximum(ranges, 1e-9)[:, None]).astype(np.float32)
        image = np.where(valid, ranges, 0.0).astype(np.float32)[None]
        # 0: every ray is walked, because neighbours in the array need not be neighbours in space
        reach = np.zeros(9)
        reach[:4] = (
            config.truncation_m,
            config.truncation_m,
            config.min_range_m,
            config.max_range_m,
        )
        reach[4] = float(config.carve)
        mark_rays(image, NO_COSINE, directions[None], pose, reach, side, marks, marks[:0])
        limits = config.min_range_m / config.voxel_size_m, config.max_range_m / config.voxel_size_m
        origin = T_map_sensor[:3, 3] / config.voxel_size_m
        kernels.mark_corners(surfaces, origin, low, side, self._bits, limits, marks)
        return listed(marks, low, side)

    def _fuse_channels(
        self,
        points: Float64,
        ranges: Float64,
        rates: Float32,
        slots: Int64,
        images: tuple[npt.NDArray[np.uint8], npt.NDArray[np.int32]],
    ) -> None:
        """Fuse colours and labels of points."""
        config, blocks = self.blocks.config, self.blocks
        valid = (ranges >= config.min_range_m) & (ranges <= config.max_range_m)
        depth = np.maximum(ranges, config.min_range_m)
        weights = np.maximum(
            depth ** (-2.0 * POWERS[config.weight_mode]), config.min_measurement_weight
        )
        weights = np.where(valid, weights, 0.0).astype(np.float32)
        most = np.float32(config.max_weight)
        channels = blocks.color, blocks.votes
        where = self._bits, blocks.lookup, slots
        kernels.fuse_point_channels(points, weights, rates, most, *where, images, channels)
