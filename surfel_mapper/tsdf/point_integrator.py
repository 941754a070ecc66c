# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
PointIntegrator: fuses clouds into a block map ray by ray, without a projection model.

For clouds that are no range image: merged from several sensors, from solid-state lidars with
irregular patterns, or in a frame that is not at the optical centre. Slower than Integrator, which
looks each voxel up in a range image, and independent of the order and the density of points. The
distances are along rays; ``allocation``, ``distance``, ``interpolation`` and the settings of range
images do not apply.

Source: voxel by voxel along each ray as voxblox (Oleynikova et al. 2017), with eight voxels about
samples near the surface; see kernels/point_fusion.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import SEMANTICS
from surfel_mapper.errors import CloudFormatError, MapLimitError
from surfel_mapper.tsdf.blocks import BlockMap, Int64
from surfel_mapper.tsdf.integrator import checked_pose, Integrated, POWERS
from surfel_mapper.tsdf.kernels import lookup as settings_of
from surfel_mapper.tsdf.kernels import point_fusion as kernels
from surfel_mapper.tsdf.kernels.block_marks import count_marks, list_marks, mark_rays
from surfel_mapper.tsdf.selection import MAX_SIDE, NO_COSINE

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]


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
        self._masked = np.array(sorted({*config.dynamic_labels, *config.invalid_labels}), np.int32)

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
            Label of each point, -1 for unknown. Points of dynamic and invalid labels only free
            the space in front of them.

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
        config, blocks = self.blocks.config, self.blocks
        used = np.isfinite(points).all(axis=1)
        local = points[used].astype(np.float64)
        ranges = np.linalg.norm(local, axis=1)
        origin = T[:3, 3] / config.voxel_size_m
        places = (local @ T[:3, :3].T + T[:3, 3]) / config.voxel_size_m
        solid: npt.NDArray[Any] = np.ones(len(local), bool)
        if labels is not None:
            labels = np.ascontiguousarray(labels[used], np.int32)
            solid = ~np.isin(labels, self._masked)
        surfaces = np.ascontiguousarray(places[solid])

        index = self._touched(local, ranges, surfaces, T)
        before = blocks.num_blocks
        rows = blocks.place(index)
        there = rows[rows >= 0]
        try:
            slots = np.full(len(blocks.head), -1, np.int64)
            slots[there] = np.arange(len(there))
            sums = self._sums(surfaces, places, origin, slots, len(there))
            observed = np.empty(len(there), np.int64)
            kernels.fuse_sums(
                there, sums, stamp_ns, config.max_weight, blocks.field, blocks.stamps, observed
            )
            colors = None if colors is None else colors[used][solid]
            labels = None if labels is None else labels[solid]
            lost = self._fuse_channels(surfaces, ranges[solid], slots, colors, labels)
            updated = there[observed > 0]
            if len(updated):
                blocks.touch(updated, stamp_ns)
        finally:
            blocks.drop_new(rows)
        return Integrated(
            num_blocks=len(index),
            num_updated=len(updated),
            num_added=blocks.num_blocks - before,
            num_refused=len(rows) - len(there),
            num_voxels=int(observed.sum()),
            num_labels_lost=lost,
        )

    def _sums(
        self, surfaces: Float64, places: Float64, origin: Float64, slots: Int64, num_blocks: int
    ) -> Float32:
        """Return the weighted sums of the rays in each voxel, (num_blocks, N, 3)."""
        config, blocks = self.blocks.config, self.blocks
        sums = np.zeros((num_blocks, blocks.voxels_per_block, 3), np.float32)
        common = (
            config.voxel_size_m,
            self._bits,
            self._settings(),
            POWERS[config.weight_mode],
            blocks.lookup,
            slots,
            sums,
        )
        kernels.sum_surfaces(surfaces, origin, *common)
        if config.carve:
            kernels.sum_free(places, origin, *common)
        return sums

    def _touched(
        self, local: Float64, ranges: Float64, surfaces: Float64, T_map_sensor: Float64
    ) -> Int64:
        """Return the blocks that the rays touch, (K, 3) int64, ascending."""
        config = self.blocks.config
        valid = ranges >= config.min_range_m
        if not valid.any():
            return np.empty((0, 3), np.int64)
        reach_m = min(float(ranges[valid].max()), config.max_range_m) + config.reach_behind_m
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
            config.reach_behind_m,
            config.min_range_m,
            config.max_range_m,
        )
        reach[4] = float(config.carve)
        mark_rays(image, NO_COSINE, directions[None], pose, reach, side, marks)
        limits = config.min_range_m / config.voxel_size_m, config.max_range_m / config.voxel_size_m
        origin = T_map_sensor[:3, 3] / config.voxel_size_m
        kernels.mark_corners(surfaces, origin, low, side, self._bits, limits, marks)
        index = np.empty((count_marks(marks), 3), np.int64)
        list_marks(marks, side, low, index)
        return index

    def _fuse_channels(
        self,
        points: Float64,
        ranges: Float64,
        slots: Int64,
        colors: npt.NDArray[np.uint8] | None,
        labels: npt.NDArray[np.int32] | None,
    ) -> int:
        """Fuse colours and labels of points; return the number of lost labels."""
        config, blocks = self.blocks.config, self.blocks
        valid = (ranges >= config.min_range_m) & (ranges <= config.max_range_m)
        depth = np.maximum(ranges, config.min_range_m)
        weights = np.maximum(
            depth ** (-2.0 * POWERS[config.weight_mode]), config.min_measurement_weight
        )
        weights = np.where(valid, weights, 0.0).astype(np.float32)
        if config.color and colors is not None:
            kernels.fuse_point_colors(
                points,
                np.ascontiguousarray(colors),
                self._bits,
                weights,
                np.float32(config.max_weight),
                blocks.lookup,
                slots,
                blocks.color,
            )
        if config.semantics == 'none' or labels is None:
            return 0
        semantics = SEMANTICS.index(config.semantics)
        return int(
            kernels.fuse_point_labels(
                points, labels, semantics, self._bits, weights, blocks.lookup, slots, blocks.votes
            )
        )

    def _settings(self) -> Float32:
        """Return the settings of an integration, in the order of kernels/lookup.py."""
        config = self.blocks.config
        found = np.zeros(settings_of.NUM_SETTINGS, np.float32)
        found[settings_of.TAU] = config.truncation_m
        found[settings_of.EXTRA] = config.extra_distance_m
        found[settings_of.MIN_RANGE] = config.min_range_m
        found[settings_of.MAX_RANGE] = config.max_range_m
        found[settings_of.WEIGHT] = 1.0
        found[settings_of.DROPOFF] = config.dropoff_start_m if config.weight_dropoff else np.inf
        found[settings_of.MIN_WEIGHT] = config.min_measurement_weight
        found[settings_of.MAX_WEIGHT] = config.max_weight
        return found
