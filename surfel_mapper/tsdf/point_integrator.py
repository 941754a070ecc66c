# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
PointIntegrator: fuses clouds into a block map, without a model of the sensor.

For clouds of any lidar: motion-compensated, merged from several sensors, with irregular patterns.
The points of a voxel are merged into a cell, which has the plane of its surroundings. Cells give
distances to the voxels about them, their rays free the voxels towards the sensor. See
kernels/point_cells.py and kernels/point_fusion.py.

The blocks of a scan are listed before the map is changed. Each is fused by itself, so blocks are
divided among threads, and the result has the same bits for any number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import logging
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config.layers import LEAST_WEIGHT, MAX_WEIGHT
from surfel_mapper.errors import CloudFormatError, MapLimitError
from surfel_mapper.kernels.layout import INDEX_OFFSET
from surfel_mapper.threads import share, usable_cores
from surfel_mapper.tsdf.blocks import block_index, BlockMap, Int64
from surfel_mapper.tsdf.kernels import point_cells
from surfel_mapper.tsdf.kernels import point_fusion as kernels
from surfel_mapper.tsdf.kernels.blocks import INSIDE as BEHIND
from surfel_mapper.tsdf.kernels.integration import INSIDE, NEAR, NUM_FOUND, OPPOSED
from surfel_mapper.tsdf.kernels.point_cells import CELL, EMPTY, MOMENTS
from surfel_mapper.tsdf.measurements import (
    checked_labels,
    checked_pose,
    fuse_into,
    Integrated,
    settings,
    warn_of_short_truncation,
)

logger = logging.getLogger(__name__)

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

NO_COLORS = np.empty((0, 3), np.uint8)
NO_LABELS = np.empty(0, np.int32)

OPPOSED_SHARE, LEAST_OPPOSED = 0.1, 100
"""
Share and number of opposed voxels of a scan from which it warns.

A hall with pose errors of 20 mm has 1 to 6 %, a wall of half a voxel 13 %.
"""

PLANE_M, PLANE_VOXELS = 0.5, (3, 5)
"""
Edge of the cells whose points give normals, m, and its least and largest number of voxels.

Normals of the surfels of the map are not better: the median error in a hall is 12.8 to 13.0 mm at
0.2 m instead of 12.8, and 15.1 to 15.5 mm at 0.1 m instead of 15.1. Those of the 12 nearest points
of a scan give 13.1 and 15.3 mm.
With 5 voxels instead of 3 at 0.1 m the angles between faces in a hall are 12.4 deg instead of
13.5; at 0.2 m the median error would rise by 0.3 mm.
"""

FIRST_BLOCKS = 4096, 16384
"""Blocks for which there is room at first, without and with carving."""

BLOCK_BYTES = 40
"""Bytes of a block of a scan in table and keys: 16 for each of two entries, and 8."""

FIRST_PAIRS = 4
"""Pairs of blocks and cells for which there is room at first, a cell; most cells have two."""


@dataclass(frozen=True, kw_only=True)
class ScanCells:
    """
    The points of a scan by voxel.

    Attributes
    ----------
    surfaces : (K, CELL) float64
        ScanCells of points on surfaces, see kernels/point_cells.py.
    free : (L, CELL) float64
        ScanCells that end rays without a surface.

    """

    surfaces: Float64
    free: Float64


@dataclass(frozen=True, kw_only=True)
class ScanBlocks:
    """
    Blocks that a scan updates.

    Attributes
    ----------
    index : (B, 3) int64
        Block indices.
    ends : (B, 2) int64
        First and last place of each block in grouped.
    grouped : (P,) int32
        Surface cells of each block.
    freed : (B, words) int64
        One bit a voxel: crossed by a ray.

    """

    index: Int64
    ends: Int64
    grouped: npt.NDArray[np.int32]
    freed: Int64

    def only(self, kept: npt.NDArray[np.bool_]) -> ScanBlocks:
        """Return some of the blocks."""
        if kept.all():
            return self
        index, ends, freed = self.index[kept], self.ends[kept], self.freed[kept]
        return replace(self, index=index, ends=ends, freed=freed)


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
        self._threads = config.threads or usable_cores()
        self._dynamic_labels = np.array(config.dynamic_labels, np.int32)
        self._has_warned = False
        warn_of_short_truncation(config)

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
        side, size_m = self.blocks.config.voxels_per_side, self.blocks.config.voxel_size_m
        corner = self._corner(T)
        pose = T[:3] / size_m  # from m in the frame of the sensor to voxels from the corner
        pose[:, 3] -= corner * side
        origin, points = pose[:, 3], np.ascontiguousarray(points, np.float64)
        solid: npt.NDArray[np.bool_] = np.ones(len(points), bool)
        if labels is not None:
            labels = checked_labels('labels', np.asarray(labels))
            solid = ~np.isin(labels, self._dynamic_labels)
        cells = self._cells(points, solid, pose)
        scan = self._blocks_of(cells, origin, corner)
        images = (
            NO_COLORS if colors is None else np.ascontiguousarray(colors[solid]),
            NO_LABELS if labels is None else labels[solid],
        )
        positions: Float64 = np.empty((0, 3))
        if len(images[0]) + len(images[1]):
            with np.errstate(invalid='ignore'):  # points may be infinite
                positions = points[solid] @ pose[:, :3].T + (origin + corner * side)
        return self._fuse(scan, cells, (origin, corner), stamp_ns, (positions, *images))

    @property
    def _plane_voxels(self) -> int:
        """Edge of the cells whose points give normals, voxels."""
        wanted = round(PLANE_M / self.blocks.config.voxel_size_m)
        return min(max(wanted, PLANE_VOXELS[0]), PLANE_VOXELS[1])

    @property
    def _carve_m(self) -> float:
        """Range up to which rays free space, m."""
        return min(self.blocks.config.carve_m, self.blocks.config.max_range_m)

    def _corner(self, T_map_sensor: Float64) -> Int64:
        """Return the block of the sensor; raise MapLimitError if it is beyond the map."""
        config = self.blocks.config
        corner = np.floor(T_map_sensor[:3, 3] / config.block_size_m)
        if not (np.abs(corner) < INDEX_OFFSET).all():
            raise MapLimitError(
                f'sensor at {T_map_sensor[:3, 3].tolist()} m: blocks of {config.block_size_m} m '
                f'reach {INDEX_OFFSET * config.block_size_m} m from the origin; use a local frame'
            )
        if config.max_range_m / config.voxel_size_m > INDEX_OFFSET / 2:
            raise MapLimitError(
                f'max_range_m: {config.max_range_m} m, expected at most {INDEX_OFFSET / 2} voxels '
                f'of {config.voxel_size_m} m'
            )
        return np.asarray(corner, np.int64)

    def _cells(self, points: Float64, solid: npt.NDArray[np.bool_], pose: Float64) -> ScanCells:
        """Return the points by voxel; free rays end at the range up to which they free."""
        near, far = self.blocks.config.min_range_m, self.blocks.config.max_range_m
        surfaces = self._described(points if solid.all() else points[solid], pose, (near, far))
        if not self._carve_m:
            return ScanCells(surfaces=surfaces, free=np.empty((0, CELL)))
        with np.errstate(invalid='ignore', over='ignore'):
            ranges = np.sqrt(np.einsum('ij,ij->i', points, points))
            ends = (~solid | (ranges > far)) & (ranges < np.inf) & (ranges > near)
        lengths = np.minimum(ranges[ends], self._carve_m)
        short = points[ends] * (lengths / ranges[ends])[:, None]
        return ScanCells(surfaces=surfaces, free=self._described(short, pose, (near, 1.001 * far)))

    def _described(self, points: Float64, pose: Float64, limits: tuple[float, float]) -> Float64:
        """Return the cells of points."""
        table, rows = new_table(len(points)), (len(points), MOMENTS)
        all_keys, all_sums = np.empty(len(points), np.int64), np.empty(rows)
        number = point_cells.merge_points(points, pose, limits, table, all_keys, all_sums)
        keys, sums = all_keys[:number], all_sums[:number]
        planes, plane_keys, plane_sums = (np.empty_like(a) for a in (keys, keys, sums))
        table = new_table(number)
        edge, content = self._plane_voxels, (table, planes, plane_keys, plane_sums)
        number = point_cells.merge_cells(keys, sums, edge, *content)
        order = np.argsort(plane_keys[:number])
        fitted, normals = np.empty((number, 3)), np.empty((number, 3))
        point_cells.fit_planes(plane_keys[order], plane_sums[order], edge, fitted)
        normals[order] = fitted
        cells = np.empty((len(keys), CELL))
        size_m = self.blocks.config.voxel_size_m
        point_cells.describe_cells(pose[:, 3].copy(), size_m, keys, sums, planes, normals, cells)
        return cells

    def _blocks_of(self, cells: ScanCells, origin: Float64, corner: Int64) -> ScanBlocks:
        """Return the blocks that cells and their rays touch."""
        config, surfaces = self.blocks.config, cells.surfaces
        tau = config.tau_m / config.voxel_size_m
        room, words = FIRST_BLOCKS[self._carve_m > 0.0], self.blocks.voxels_per_block // 64
        table, keys, freed = new_blocks(room, max(words, 1))
        pairs: npt.NDArray[np.int32] = np.empty((FIRST_PAIRS * len(surfaces) + 64, 2), np.int32)
        start = number = num_pairs = 0
        while start < len(surfaces):
            number, num_pairs, start = kernels.list_pairs(
                surfaces, start, tau, self._bits, table, keys, number, pairs, num_pairs
            )
            has_blocks, has_pairs = 2 * number <= len(keys), 2 * num_pairs <= len(pairs)
            if start < len(surfaces) and has_pairs >= has_blocks:
                table, keys, freed = self._enlarged(keys[:number], freed)
            if start < len(surfaces) and has_blocks >= has_pairs:
                self.blocks.charge(2 * pairs.nbytes, f'{num_pairs} pairs of blocks and cells')
                pairs = np.concatenate([pairs, np.empty_like(pairs)])
        limits = config.min_range_m / config.voxel_size_m, self._carve_m / config.voxel_size_m
        for rays in (surfaces, cells.free) if config.carve_m else ():
            start = 0
            while start < len(rays):
                number, start = kernels.free_rays(
                    rays, start, origin, (*limits, tau), self._bits, table, keys, number, freed
                )
                if start < len(rays):
                    table, keys, freed = self._enlarged(keys[:number], freed)
        first, grouped = np.zeros(number + 1, np.int64), np.empty(num_pairs, np.int32)
        kernels.group_pairs(pairs[:num_pairs], first, grouped)
        index = block_index(keys[:number]) + corner
        ends = np.column_stack([first[:-1], first[1:]])
        return ScanBlocks(index=index, ends=ends, grouped=grouped, freed=freed[:number])

    def _enlarged(self, keys: Int64, freed: Int64) -> tuple[Int64, Int64, Int64]:
        """Return table, keys and bits with twice the room, and the content so far."""
        num_bytes = 2 * len(freed) * (BLOCK_BYTES + freed.strides[0])
        self.blocks.charge(num_bytes, f'a scan that touches {len(keys)} blocks')
        table, more, bits = new_blocks(2 * len(freed), freed.shape[1])
        more[: len(keys)], bits[: len(freed)] = keys, freed
        kernels.enter_keys(keys, table)
        return table, more, bits

    def _fuse(
        self,
        scan: ScanBlocks,
        cells: ScanCells,
        frame: tuple[Float64, Int64],
        stamp_ns: int,
        channels: tuple[npt.NDArray[Any], ...],
    ) -> Integrated:
        """Fuse a scan into its blocks."""
        blocks, config, (origin, corner) = self.blocks, self.blocks.config, frame
        position = (origin + corner * config.voxels_per_side) * config.voxel_size_m
        scan = scan.only(blocks.admit(scan.index, position))

        def fuse(chosen: Int64, rows: Int64) -> Int64:
            rates = blocks.forgetting_rates(rows, stamp_ns)
            figures = self._figures(scan, cells, frame, (chosen, rows, rates))
            self._warn_of_opposed(figures)
            self._fuse_channels(channels, frame, rows, rates)
            return figures

        return fuse_into(blocks, scan.index, scan.ends[:, 0] < scan.ends[:, 1], stamp_ns, fuse)

    def _figures(
        self,
        scan: ScanBlocks,
        cells: ScanCells,
        frame: tuple[Float64, Int64],
        which: tuple[Int64, Int64, Float32],
    ) -> Int64:
        """Fuse some blocks of a scan; return figures of each."""
        config, (origin, corner), (chosen, rows, rates) = self.blocks.config, frame, which
        corners = (scan.index[chosen] - corner) * config.voxels_per_side
        figures = np.zeros((len(rows), NUM_FOUND), np.int64)
        figures[:, INSIDE] = self.blocks.head[rows, BEHIND]
        per_block = rows, corners, rates, scan.ends[chosen], scan.freed[chosen]
        common = settings(config), config.voxel_size_m, self._bits, self.blocks.field

        def fuse(chunk: slice) -> None:
            content = tuple(values[chunk] for values in per_block)
            cells_of = (scan.grouped, cells.surfaces)
            kernels.fuse_blocks(content, cells_of, origin, *common, figures[chunk])

        share(fuse, len(rows), self._threads)
        return figures

    def _warn_of_opposed(self, figures: Int64) -> None:
        """Warn once if many measurements contradict those of a surface on the other side."""
        config = self.blocks.config
        opposed, num_near = int(figures[:, OPPOSED].sum()), int(figures[:, NEAR].sum())
        if opposed > max(OPPOSED_SHARE * num_near, LEAST_OPPOSED) and not self._has_warned:
            self._has_warned = True
            logger.warning(
                'layers.tsdf.voxel_size_m: %g m: %.0f %% of the voxels near surfaces lie between '
                'two surfaces that face away from each other, closer than two voxels; their mesh '
                'is off by up to a quarter of a voxel. Use smaller voxels for thinner walls',
                config.voxel_size_m,
                100.0 * opposed / num_near,
            )

    def _fuse_channels(
        self,
        channels: tuple[npt.NDArray[Any], ...],
        frame: tuple[Float64, Int64],
        rows: Int64,
        rates: Float32,
    ) -> None:
        """Fuse colours and labels of points in the map frame, voxels, into the blocks of rows."""
        config, blocks, (points, *images) = self.blocks.config, self.blocks, channels
        if not len(points):
            return
        origin = frame[0] + frame[1] * config.voxels_per_side
        slots = np.full(len(blocks.head), -1, np.int64)
        slots[rows] = np.arange(len(rows))
        depth = np.linalg.norm(points - origin, axis=1) * config.voxel_size_m
        valid = (depth >= config.min_range_m) & (depth <= config.max_range_m)
        with np.errstate(divide='ignore', invalid='ignore'):
            weights = np.where(valid, np.maximum(depth**-2.0, LEAST_WEIGHT), 0.0)
        where = self._bits, blocks.lookup, slots
        most, kept = np.float32(MAX_WEIGHT), (blocks.color, blocks.votes)
        weights = weights.astype(np.float32)
        kernels.fuse_point_channels(points, weights, rates, most, *where, tuple(images), kept)


def new_table(least: int) -> Int64:
    """Return an empty table of more than a number of entries, at most twice as many."""
    size = 1 << max(least, 1).bit_length()
    return np.full((size, 2), EMPTY, np.int64)


def new_blocks(number: int, words: int) -> tuple[Int64, Int64, Int64]:
    """Return table, keys and bits with room for a number of blocks."""
    table = new_table(2 * number - 1)
    size = len(table) // 2
    return table, np.empty(size, np.int64), np.zeros((size, words), np.int64)
