# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Mesher: the surface of a block map as triangles, updated for changed blocks.

The cubes of marching cubes have voxel centres as corners, so cubes at the upper faces of a block
reach into the blocks above it, and a change of a block affects the seven blocks below as well. A
vertex is identified by its edge: the voxel at the edge's start, and the axis. Vertices on the same
edge are welded, within a block and between blocks.

An update has two halves: ``portions`` copies the changed blocks that can have a surface, some at a
time, in the thread that owns the map, and ``apply`` makes their triangles, in any thread.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, KeysView, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import Record
from surfel_mapper.config.layers import LEAST_WEIGHT
from surfel_mapper.kernels.layout import KEY
from surfel_mapper.tsdf.blocks import block_index, BlockMap, copied_rows, UPPER
from surfel_mapper.tsdf.kernels.blocks import INSIDE
from surfel_mapper.tsdf.kernels.marching_cubes import describe, find_cases, march
from surfel_mapper.tsdf.queries import labels_of

Float32 = npt.NDArray[np.float32]
Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]
Float64 = npt.NDArray[np.float64]
UInt8 = npt.NDArray[np.uint8]

BATCH = 1024
"""Blocks marched at a time: their working memory fits the cache of a core."""

PORTION = 512
"""Blocks copied at a time: with those above them some 4 MB, 3 ms between two scans."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Mesh(Record):
    """
    Triangles in the map frame.

    Attributes
    ----------
    vertices : (V, 3) float64
        m.
    triangles : (F, 3) int32
        Vertex numbers of each, counter-clockwise as seen from free space.
    colors : (V, 3) uint8
        Red, green, blue of the voxels, else of their labels; no rows if neither is kept.
    labels : (V,) int32
        Label of the nearer voxel that has one, -1 for none; no rows if the map keeps no labels.

    """

    vertices: Float64
    triangles: Int32
    colors: UInt8
    labels: Int32 = field(default_factory=lambda: np.empty(0, np.int32))

    def __len__(self) -> int:
        """Return the number of triangles."""
        return len(self.triangles)


EMPTY = Mesh(
    vertices=np.empty((0, 3)),
    triangles=np.empty((0, 3), np.int32),
    colors=np.empty((0, 3), np.uint8),
)


@dataclass(frozen=True, kw_only=True, repr=False)
class BlockMesh(Mesh):
    """
    The triangles of the cubes whose first corners lie in some blocks.

    Attributes
    ----------
    edges : (V, 4) int32
        Voxel at the start of the edge of each vertex, and the axis of the edge.

    """

    edges: Int32


def size_of(mesh: BlockMesh | None) -> int:
    """Return the bytes of a mesh; 0 without one."""
    return sum(array.nbytes for array in vars(mesh).values()) if mesh is not None else 0


@dataclass(frozen=True, kw_only=True)
class Changes:
    """
    Copy of all that a mesh needs of the blocks that have changed.

    Attributes
    ----------
    num_blocks : int
        Blocks that may have other triangles than before.
    emptied : list of int
        Keys of those without a surface, or not in the map any more.
    keys : (K,) int64
        Keys of the others.
    index : (K, 3) int64
        Their block indices.
    neighbours : (K, 8) int64
        Rows, in the arrays below, of each block and of those above it; -1 if missing.
    field : (R, 2, N) float32
    color : (R, 4, N) float32, or no rows
    votes : (R, 2, N) float32, or no rows

    """

    num_blocks: int
    emptied: list[int]
    keys: Int64
    index: Int64
    neighbours: Int64
    field: Float32
    color: Float32
    votes: Float32


class Mesher:
    """
    Keeps the mesh of a block map up to date.

    Parameters
    ----------
    blocks : BlockMap
        The map.
    visible_only : bool
        Update only blocks that have changed visibly, see BlockMap.moved_since: the vertices of
        others are up to VISIBLE_VOXELS off.

    """

    def __init__(self, blocks: BlockMap, *, visible_only: bool = False) -> None:
        """Start without triangles; the first update meshes all blocks."""
        self._blocks = blocks
        self._changed_since = blocks.moved_since if visible_only else blocks.changed_since
        self._version = -1
        self._keys: set[int] = set()
        self._meshes: dict[int, BlockMesh] = {}
        self._nbytes = 0

    def update(self) -> int:
        """
        Mesh the changed blocks again and drop the triangles of removed blocks.

        Returns
        -------
        int
            Number of blocks that could have changed triangles.

        """
        (changes,) = self.portions()
        self.apply(changes)
        return changes.num_blocks

    def portions(self, size: int | None = None) -> Iterator[Changes]:
        """
        Copy what has changed since the last call; each part must be applied, in order.

        The map may change between two parts. A block that does is in the next call again.

        Parameters
        ----------
        size : int, optional
            Copy at most this many blocks at a time; by default all that have changed.

        """
        blocks = self._blocks
        gone = self._keys - set(blocks.head[blocks.rows(), KEY].tolist())
        self._keys -= gone
        changed = self._changed_since(self._version)
        self._version = blocks.version
        below = np.unique(blocks.neighbours(changed, -UPPER))
        keys = blocks.head[below[below >= 0], KEY]
        step = size or max(len(keys), 1)
        for first in range(0, max(len(keys), 1), step):
            yield self._copied(keys[first : first + step], gone if first == 0 else set())

    def _copied(self, keys: Int64, gone: set[int]) -> Changes:
        """Return what the meshes of blocks need, by their keys; of those in the map by now."""
        blocks = self._blocks
        rows = blocks.find(block_index(keys))
        keys, rows = keys[rows >= 0], rows[rows >= 0]
        around = blocks.neighbours(rows)
        has_inside = ((blocks.head[around, INSIDE] > 0) & (around >= 0)).any(axis=1)
        emptied = self._keys.intersection(keys[~has_inside].tolist())
        self._keys -= emptied
        self._keys.update(keys[has_inside].tolist())
        needed, inverse = np.unique(around[has_inside], return_inverse=True)
        missing = int(len(needed) > 0 and needed[0] < 0)
        needed = needed[missing:]
        return Changes(
            num_blocks=len(keys),
            emptied=list(gone | emptied),
            keys=keys[has_inside],
            index=blocks.index(rows[has_inside]),
            neighbours=inverse.reshape(-1, 8) - missing,
            field=blocks.field[needed],
            color=copied_rows(blocks.color, needed),
            votes=copied_rows(blocks.votes, needed),
        )

    def apply(self, changes: Changes) -> set[int]:
        """Make the triangles of changed blocks; return the keys of blocks with new triangles."""
        touched = set()
        meshes = zip(changes.keys.tolist(), self._marched(changes), strict=True)
        for key, mesh in (*((key, None) for key in changes.emptied), *meshes):
            last = self._meshes.pop(key, None)
            if mesh is not None:
                self._meshes[key] = mesh
            if mesh is not None or last is not None:
                touched.add(key)
            self._nbytes += size_of(mesh) - size_of(last)
        return touched

    @property
    def nbytes(self) -> int:
        """Bytes used by the triangles."""
        return self._nbytes

    def mesh(self) -> BlockMesh:
        """Return the triangles of all blocks with welded vertices."""
        meshes = list(self._meshes.values())
        if not meshes:
            return BlockMesh(**vars(EMPTY), edges=np.empty((0, 4), np.int32))
        joined = concatenated(meshes)
        edges = np.concatenate([mesh.edges for mesh in meshes]).astype(np.int64)
        high = edges[:, 0] << 32 | (edges[:, 1] + (1 << 31))
        low = edges[:, 2] << 2 | edges[:, 3]
        order = np.lexsort((low, high))
        is_new = np.ones(len(order), bool)
        is_new[1:] = (np.diff(high[order]) != 0) | (np.diff(low[order]) != 0)
        number = np.empty(len(order), np.int64)
        number[order] = np.cumsum(is_new) - 1
        kept = order[is_new]
        colors, labels = joined.colors, joined.labels
        return BlockMesh(
            edges=edges[kept].astype(np.int32),
            vertices=joined.vertices[kept],
            triangles=number[joined.triangles].astype(np.int32),
            colors=colors[kept] if len(colors) else colors,
            labels=labels[kept] if len(labels) else labels,
        )

    def parts(self, keys: Iterable[int] | None = None) -> Mesh:
        """
        Return the triangles of some blocks, by their keys, or of all, each with its own vertices.

        Where blocks meet vertices occur several times; viewers of triangles do not need them
        welded, which takes longer than marching cubes.
        """
        meshes = self._meshes
        return concatenated([meshes[key] for key in (meshes if keys is None else keys)])

    def keys(self) -> KeysView[int]:
        """Return the keys of the blocks that have triangles."""
        return self._meshes.keys()

    def _marched(self, changes: Changes) -> list[BlockMesh | None]:
        """Run marching cubes over blocks and return their meshes; None without triangles."""
        bits = np.empty((len(changes.field), changes.field.shape[2]), np.uint8)
        describe(changes.field, LEAST_WEIGHT, bits)
        meshes: list[BlockMesh | None] = []
        for first in range(0, len(changes.keys), BATCH):
            batch = slice(first, first + BATCH)
            meshes += self._batch(changes, changes.neighbours[batch], changes.index[batch], bits)
        return meshes

    def _batch(
        self, changes: Changes, neighbours: Int64, index: Int64, bits: UInt8
    ) -> list[BlockMesh | None]:
        """Return the meshes of some of the changed blocks; None without triangles."""
        config, num = self._blocks.config, len(index)
        side = config.voxels_per_side
        cases, counts = np.empty((num, side**3), np.uint8), np.empty(num, np.int64)
        content = side, changes.field
        find_cases(neighbours, *content, bits, config.mesh_max_step_m, cases, counts)
        starts = np.cumsum([0, *counts.tolist()])
        triangles = np.empty((starts[-1], 3), np.int32)
        edges = np.empty((3 * starts[-1], 4), np.int32)
        along, num_vertices = np.empty(3 * starts[-1]), np.empty(num, np.int64)
        march(neighbours, index, *content, cases, starts, triangles, edges, along, num_vertices)
        bounds = np.cumsum([0, *num_vertices.tolist()])
        edges, along = edges[: bounds[-1]].copy(), along[: bounds[-1]]
        vertices = edges[:, :3] + 0.5
        vertices[np.arange(len(edges)), edges[:, 3]] += along
        vertices *= config.voxel_size_m
        colors, labels = EMPTY.colors, EMPTY.labels
        if config.color or config.semantics != 'none':
            block = np.repeat(np.arange(num), num_vertices)
            ends = ends_of(edges, neighbours[block], index[block], side)
            labels = self._labels(changes, ends, along)
            colors = self._colors(changes, ends, along) if config.color else label_colors(labels)
        return [
            BlockMesh(
                vertices=vertices[bounds[i] : bounds[i + 1]],
                triangles=triangles[starts[i] : starts[i + 1]],
                colors=colors[bounds[i] : bounds[i + 1]],
                labels=labels[bounds[i] : bounds[i + 1]],
                edges=edges[bounds[i] : bounds[i + 1]],
            )
            if counts[i]
            else None
            for i in range(num)
        ]

    def _colors(self, changes: Changes, ends: tuple[Int64, Int64], along: Float64) -> UInt8:
        """Return colours interpolated between the voxels at the ends of edges."""
        rows, voxels = ends
        color = changes.color[rows, :, voxels].astype(np.float64)
        share = np.stack([1.0 - along, along], axis=1) * (color[..., 3] > 0.0)
        total = share.sum(axis=1, keepdims=True)
        share = np.divide(share, total, out=np.zeros_like(share), where=total > 0.0)
        mixed = (share[..., None] * color[..., :3]).sum(axis=1)
        return np.asarray(np.rint(mixed), np.uint8)

    def _labels(self, changes: Changes, ends: tuple[Int64, Int64], along: Float64) -> Int32:
        """Return the label at the nearer end of each edge that has one."""
        config = self._blocks.config
        if config.semantics == 'none':
            return np.empty(0, np.int32)
        votes = np.moveaxis(changes.votes[ends[0], :, ends[1]], -1, 0)
        labels, _ = labels_of(votes, config.label_lead)
        second = along > 0.5
        near = np.where(second, labels[:, 1], labels[:, 0])
        return np.where(near >= 0, near, np.where(second, labels[:, 0], labels[:, 1]))


def concatenated(meshes: Sequence[Mesh]) -> Mesh:
    """Return some meshes as one; it has colours, and labels, only if all of them have."""
    if not meshes:
        return EMPTY
    numbers = [len(mesh.vertices) for mesh in meshes]
    firsts = np.repeat(np.cumsum([0, *numbers[:-1]]), [len(mesh) for mesh in meshes])
    triangles = np.concatenate([mesh.triangles for mesh in meshes]) + firsts[:, None]

    def joined(name: str) -> npt.NDArray[Any]:
        arrays = [getattr(mesh, name) for mesh in meshes]
        is_whole = [len(array) for array in arrays] == numbers
        return np.concatenate(arrays) if is_whole else getattr(EMPTY, name)

    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        triangles=triangles.astype(np.int32),
        colors=joined('colors'),
        labels=joined('labels'),
    )


def label_colors(labels: Int32) -> UInt8:
    """Return a colour for each label (V,), (V, 3): hues a golden angle apart; grey for none."""
    hue = labels * 0.618034 % 1.0
    distance = np.abs((hue[:, None] * 6.0 - [0.0, 2.0, 4.0] + 3.0) % 6.0 - 3.0)
    colors = 70.0 + 180.0 * np.clip(2.0 - distance, 0.0, 1.0)
    return np.where(labels[:, None] < 0, 128.0, colors).astype(np.uint8)


def ends_of(edges: Int32, neighbours: Int64, index: Int64, side: int) -> tuple[Int64, Int64]:
    """Return rows and voxels of both ends of edges (V, 4) of blocks, (V, 2) each."""
    ends = np.repeat(edges[:, None, :3].astype(np.int64), 2, axis=1) - side * index[:, None]
    ends[np.arange(len(edges)), 1, edges[:, 3]] += 1
    above = ((ends // side) @ [1, 2, 4]).astype(np.int64)
    voxels = (ends % side) @ [1, side, side * side]
    return np.take_along_axis(neighbours, above, axis=1), voxels.astype(np.int64)
