# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Mesher: the surface of a block map as triangles, updated for changed blocks.

The cubes of marching cubes have voxel centres as corners, so cubes at the upper faces of a block
reach into the blocks above it, and a change of a block affects the seven blocks below as well. A
vertex is identified by its edge: the voxel at the edge's start, and the axis. Vertices on the same
edge are welded, within a block and between blocks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surfel_mapper.kernels.layout import KEY
from surfel_mapper.tsdf.blocks import BlockMap, UPPER
from surfel_mapper.tsdf.kernels.marching_cubes import count_triangles, march

Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]
Float64 = npt.NDArray[np.float64]
UInt8 = npt.NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """
    Triangles in the map frame.

    Attributes
    ----------
    vertices : (V, 3) float64
        m.
    triangles : (F, 3) int32
        Vertex numbers of each, counter-clockwise as seen from free space.
    colors : (V, 3) uint8
        Red, green, blue; no rows if the map keeps no colour.

    """

    vertices: Float64
    triangles: Int32
    colors: UInt8

    def __len__(self) -> int:
        """Return the number of triangles."""
        return len(self.triangles)


EMPTY = Mesh(
    vertices=np.empty((0, 3)),
    triangles=np.empty((0, 3), np.int32),
    colors=np.empty((0, 3), np.uint8),
)


@dataclass(frozen=True, kw_only=True)
class BlockMesh(Mesh):
    """
    The triangles of the cubes whose first corner lies in one block.

    Attributes
    ----------
    edges : (V, 4) int32
        Voxel at the start of the edge of each vertex, and the axis of the edge.

    """

    edges: Int32


class Mesher:
    """
    Keeps the mesh of a block map up to date.

    Parameters
    ----------
    blocks : BlockMap
        The map.

    """

    def __init__(self, blocks: BlockMap) -> None:
        """Start without triangles; the first update meshes all blocks."""
        self._blocks = blocks
        self._version = -1
        self._meshes: dict[int, BlockMesh] = {}

    def update(self) -> int:
        """
        Mesh the changed blocks again and drop the triangles of removed blocks.

        Returns
        -------
        int
            Number of blocks meshed.

        """
        blocks = self._blocks
        there = set(blocks.head[blocks.rows(), KEY].tolist())
        for key in self._meshes.keys() - there:
            del self._meshes[key]
        changed = blocks.changed_since(self._version)
        self._version = blocks.version
        below = np.unique(blocks.neighbours(changed, -UPPER))
        rows = below[below >= 0]
        for key, mesh in zip(blocks.head[rows, KEY].tolist(), self._marched(rows), strict=True):
            if len(mesh):
                self._meshes[key] = mesh
            else:
                self._meshes.pop(key, None)
        return len(rows)

    def mesh(self) -> Mesh:
        """Return the triangles of all blocks with welded vertices."""
        meshes = list(self._meshes.values())
        if not meshes:
            return EMPTY
        firsts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
        edges = np.concatenate([mesh.edges for mesh in meshes]).astype(np.int64)
        triangles = np.concatenate(
            [mesh.triangles + first for mesh, first in zip(meshes, firsts, strict=False)]
        )
        high = edges[:, 0] << 32 | (edges[:, 1] + (1 << 31))
        low = edges[:, 2] << 2 | edges[:, 3]
        order = np.lexsort((low, high))
        is_new = np.ones(len(order), bool)
        is_new[1:] = (np.diff(high[order]) != 0) | (np.diff(low[order]) != 0)
        number = np.empty(len(order), np.int64)
        number[order] = np.cumsum(is_new) - 1
        kept = order[is_new]
        return Mesh(
            vertices=np.concatenate([mesh.vertices for mesh in meshes])[kept],
            triangles=number[triangles].astype(np.int32),
            colors=np.concatenate([mesh.colors for mesh in meshes])[
                kept if self._blocks.config.color else slice(0)
            ],
        )

    def block_mesh(self, index: npt.ArrayLike) -> Mesh:
        """Return the triangles of one block, by (3,) index."""
        (row,) = self._blocks.find(np.asarray(index)[None])
        found = self._meshes.get(int(self._blocks.head[row, KEY])) if row >= 0 else None
        return EMPTY if found is None else found

    def _marched(self, rows: Int64) -> list[BlockMesh]:
        """Run marching cubes over blocks and return their meshes."""
        blocks, config = self._blocks, self._blocks.config
        side = config.voxels_per_side
        limits = config.mesh_min_weight, config.mesh_max_step_m
        index, neighbours = blocks.index(rows), blocks.neighbours(rows)
        counts = np.empty(len(rows), np.int64)
        count_triangles(neighbours, side, blocks.field, limits, counts)
        ends = np.cumsum(counts)
        num = int(ends[-1]) if len(ends) else 0
        edges, places = np.empty((num, 3, 4), np.int64), np.empty((num, 3))
        march(neighbours, index, side, blocks.field, limits, ends - counts, edges, places)

        block = np.repeat(np.arange(len(rows)), 3 * counts)
        flat: npt.NDArray[np.int64] = edges.reshape(-1, 4)
        inner = flat[:, :3] - index[block] * side
        number = np.ravel_multi_index(
            (block, *inner.T, flat[:, 3]), (len(rows), side + 1, side + 1, side + 1, 3)
        )
        _, first, corner = np.unique(number, return_index=True, return_inverse=True)
        flat, place = flat[first], places.ravel()[first]
        vertices = np.asarray(flat[:, :3] + 0.5, np.float64)
        vertices[np.arange(len(flat)), flat[:, 3]] += place
        vertices *= config.voxel_size_m
        colors = self._colors(flat, place)
        bounds = np.searchsorted(block[first], np.arange(len(rows) + 1))
        triangles = corner.reshape(-1, 3)
        return [
            BlockMesh(
                vertices=vertices[bounds[i] : bounds[i + 1]],
                triangles=(triangles[end - count : end] - bounds[i]).astype(np.int32),
                colors=colors[bounds[i] : bounds[i + 1]],
                edges=flat[bounds[i] : bounds[i + 1]].astype(np.int32),
            )
            for i, (end, count) in enumerate(zip(ends, counts, strict=True))
        ]

    def _colors(self, edges: Int64, place: Float64) -> UInt8:
        """Return colours interpolated between the voxels at the ends of edges."""
        if not self._blocks.config.color:
            return np.empty((0, 3), np.uint8)
        ends = np.repeat(edges[:, None, :3], 2, axis=1)
        ends[np.arange(len(edges)), 1, edges[:, 3]] += 1
        side = self._blocks.config.voxels_per_side
        rows = self._blocks.find(ends // side)
        x, y, z = (ends % side).transpose(2, 0, 1)
        color = self._blocks.color[rows, :, x + side * (y + side * z)].astype(np.float64)
        share = np.stack([1.0 - place, place], axis=1) * (color[..., 3] > 0.0)
        total = share.sum(axis=1, keepdims=True)
        share = np.divide(share, total, out=np.zeros_like(share), where=total > 0.0)
        mixed = (share[..., None] * color[..., :3]).sum(axis=1)
        return np.asarray(np.rint(mixed), np.uint8)
