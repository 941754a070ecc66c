# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The mesh of a field and of all blocks that have left it, one region of the archive at a time.

A region is meshed from its own blocks and those of the regions above it that touch it. Regions
are visited from the highest to the lowest, so these have been read before, and only their lowest
layers of blocks are kept, as long as they are needed. Vertices between regions are welded by their
edges. The mesh is that of all blocks together; memory is bounded by one region and the borders of
two slabs of regions, not by the length of a drive.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from surfel_mapper.files.tsdf_archive import BlockArchive, REGION, Region
from surfel_mapper.kernels.layout import KEY
from surfel_mapper.tsdf.blocks import BlockMap, Blocks
from surfel_mapper.tsdf.mesh import BlockMesh, Int64, Mesh, Mesher

ABOVE = [offset for offset in product((0, 1), repeat=3) if any(offset)]

Edge = tuple[int, int, int, int]


def surface_parts(blocks: BlockMap, archive: BlockArchive) -> Iterator[Mesh]:
    """
    Iterate over the mesh of a field and its archive.

    Parameters
    ----------
    blocks : BlockMap
        The field; its own blocks are merged with those of the archive.
    archive : BlockArchive
        The blocks that have left it.

    Returns
    -------
    iterator of Mesh
        One or more parts; the triangles of each count the vertices of all parts so far.

    Raises
    ------
    FileFormatError
        If a file of the archive cannot be read.

    """
    borders: dict[Region, Blocks] = {}
    numbers: dict[Edge, int] = {}
    num_vertices, is_empty = 0, True
    for region, found in merged_regions(blocks, archive):
        is_empty = False
        own = found.rows()
        keys = found.head[own, KEY].tolist()
        borders = {near: border for near, border in borders.items() if near[0] <= region[0] + 1}
        borders[region] = found.copied(own[(found.index(own) % REGION == 0).any(axis=1)])
        insert_above(found, region, borders)
        mesher = Mesher(found)
        mesher.update()
        part = continued(mesher.welded(keys), blocks.config.voxels_per_side, numbers, num_vertices)
        num_vertices += len(part.vertices)
        numbers = {
            edge: number for edge, number in numbers.items() if is_ahead(edge, region, blocks)
        }
        yield part
    if is_empty:
        yield Mesher(blocks).mesh()


def merged_regions(blocks: BlockMap, archive: BlockArchive) -> Iterator[tuple[Region, BlockMap]]:
    """
    Iterate over the regions of a field and its archive, from the highest to the lowest.

    Each comes with the blocks in it; those that are in the archive several times, or in the field
    as well, are merged.
    """
    rows = blocks.rows()
    places = blocks.index(rows) // REGION
    regions = archive.regions() | {(x, y, z) for x, y, z in np.unique(places, axis=0).tolist()}
    for region in sorted(regions, reverse=True):
        found = BlockMap(blocks.config)
        for archived in archive.region(region):
            found.merge(archived)
        found.merge(blocks.copied(rows[(places == region).all(axis=1)]))
        yield region, found


def merged_parts(blocks: BlockMap, archive: BlockArchive) -> Iterator[Blocks]:
    """Iterate over the blocks of a field and its archive, each once, region by region."""
    for _, found in merged_regions(blocks, archive):
        yield found.copied(found.rows())


def insert_above(found: BlockMap, region: Region, borders: dict[Region, Blocks]) -> None:
    """Add the blocks of the regions above a region that touch it."""
    for offset in ABOVE:
        near = tuple(np.add(region, offset).tolist())
        border = borders.get(near)
        if border is None:
            continue
        touches = ((border.index % REGION == 0) | (np.array(offset) == 0)).all(axis=1)
        found.insert(border.part(np.flatnonzero(touches)))


def continued(mesh: BlockMesh, side: int, numbers: dict[Edge, int], num_before: int) -> Mesh:
    """
    Return a mesh without the vertices that earlier parts have.

    Parameters
    ----------
    mesh : BlockMesh
        Welded triangles of a region.
    side : int
        Voxels along the edge of a block.
    numbers : dict
        Number of the vertex on each edge between regions; updated.
    num_before : int
        Number of vertices of earlier parts.

    """
    number: Int64 = np.empty(len(mesh.vertices), np.int64)
    is_new = np.ones(len(number), bool)
    between = (mesh.edges[:, :3] % (REGION * side) == 0) & (
        np.arange(3) != mesh.edges[:, 3:]
    )  # cubes on both sides of the border use these edges
    shared = np.flatnonzero(between.any(axis=1))
    edges: list[Edge] = [(x, y, z, axis) for x, y, z, axis in mesh.edges[shared].tolist()]
    for vertex, edge in zip(shared.tolist(), edges, strict=True):
        if edge in numbers:
            is_new[vertex], number[vertex] = False, numbers[edge]
    number[is_new] = num_before + np.arange(is_new.sum())
    numbers.update(zip(edges, number[shared].tolist(), strict=True))
    return Mesh(
        vertices=mesh.vertices[is_new],
        triangles=number[mesh.triangles].astype(np.int32),
        colors=mesh.colors[is_new] if len(mesh.colors) else mesh.colors,
        labels=mesh.labels[is_new] if len(mesh.labels) else mesh.labels,
    )


def is_ahead(edge: Edge, region: Region, blocks: BlockMap) -> bool:
    """Return whether regions that follow may have a vertex on an edge."""
    return edge[0] <= (region[0] + 1) * REGION * blocks.config.voxels_per_side
