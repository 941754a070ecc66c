# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The mesh of a distance field as one marker, or as markers that are updated tile by tile.

A tile is a cube of TILE blocks a side and one marker, so viewers replace only changed tiles.
The triangles are made while the messages are iterated, in any thread. Changed blocks are copied
before, by the owner of the map: in steps between scans, and the rest when messages are asked for.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import numpy.typing as npt

from surfel_mapper.layers.layer import Moment
from surfel_mapper.messages.markers import (
    DELETE_ALL,
    Marker,
    marker_array,
    marker_bytes,
    TRIANGLE_LIST,
)
from surfel_mapper.messages.surfel_markers import mesh_marker
from surfel_mapper.tsdf.blocks import block_index, BlockMap
from surfel_mapper.tsdf.mesh import Changes, Mesher, PORTION

TILE = 8
"""Blocks along the edge of a tile: 12.8 m with voxels of 0.2 m, some 200 tiles about a lidar."""

MAX_BYTES = 4 << 20
"""A message is sent when its markers exceed this; larger ones are lost by readers more easily."""

CORNER_BYTES = 40
"""Bytes of a corner of a triangle: three float64, four float32."""

Tile = tuple[int, int, int]


class CopiedMesh:
    """
    The mesh of copies of the blocks of a field, of which changed ones are copied in steps.

    Parameters
    ----------
    blocks : BlockMap
        The field.

    """

    def __init__(self, blocks: BlockMap) -> None:
        self._mesher = Mesher(blocks, visible_only=True)
        self._portions: Iterator[Changes] | None = None
        self._copied: list[Changes] = []

    @property
    def nbytes(self) -> int:
        """Bytes used by the triangles."""
        return self._mesher.nbytes

    def prepare(self) -> bool:
        """Copy some of the changed blocks; return True once all are; called by the map's owner."""
        if self._portions is None:
            self._portions = self._mesher.portions(PORTION)
        changes = next(self._portions, None)
        if changes is not None:
            self._copied.append(changes)
        return changes is None

    def _take(self) -> list[Changes]:
        """Copy the rest; return all since the last call."""
        while not self.prepare():
            pass
        copied, self._copied, self._portions = self._copied, [], None
        return copied


class LiveMesh(CopiedMesh):
    """
    Messages that keep a viewer's mesh up to date.

    The results of ``changed`` and ``complete`` must be iterated in the order in which they were
    made, by one thread at a time.
    """

    def __init__(self, blocks: BlockMap) -> None:
        super().__init__(blocks)
        self._tiles: dict[Tile, dict[int, None]] = {}
        self._numbers: dict[Tile, int] = {}
        self._is_known = False

    def changed(self, moment: Moment) -> Iterable[bytes]:
        """Return MarkerArrays of the tiles that have changed; called by the owner of the map."""
        return self._messages(self._take(), moment, is_complete=False)

    def complete(self, moment: Moment) -> Iterable[bytes]:
        """Return MarkerArrays of all tiles, which replace any before."""
        return self._messages(self._take(), moment, is_complete=True)

    def _messages(
        self, changes: list[Changes], moment: Moment, *, is_complete: bool
    ) -> Iterator[bytes]:
        tiles = self._apply(changes)
        markers, size = [], 0
        if is_complete or not self._is_known:  # a viewer may show tiles of an earlier map
            self._is_known = True
            tiles = [tile for tile, keys in self._tiles.items() if keys]
            markers.append(clearing(moment))
        for tile in tiles:
            mesh = self._mesher.parts(self._tiles[tile])
            number = self._numbers.setdefault(tile, len(self._numbers))
            markers.append(mesh_marker(mesh, number=number, **moment.header))
            size += 3 * len(mesh) * CORNER_BYTES
            if size > MAX_BYTES:
                yield marker_array(markers)
                markers, size = [], 0
        if markers:
            yield marker_array(markers)

    def _apply(self, changes: list[Changes]) -> list[Tile]:
        """Update the triangles; return the tiles that have changed."""
        keys = sorted({key for change in changes for key in self._mesher.apply(change)})
        meshed, touched = self._mesher.keys(), dict[Tile, None]()
        for key, tile in zip(keys, tiles_of(keys), strict=True):
            touched[tile] = None
            content = self._tiles.setdefault(tile, {})
            if key in meshed:
                content[key] = None
            else:
                content.pop(key, None)
        return list(touched)


class WholeMesh(CopiedMesh):
    """
    The mesh as one marker; its blocks are marched only if they have changed.

    The results of ``messages`` must be iterated as those of LiveMesh.
    """

    def messages(self, moment: Moment) -> Iterable[bytes]:
        """Return one Marker; called by the owner of the map."""
        return self._marker(self._take(), moment)

    def _marker(self, changes: list[Changes], moment: Moment) -> Iterator[bytes]:
        for change in changes:
            self._mesher.apply(change)
        mesh = self._mesher.parts()
        yield marker_bytes(mesh_marker(mesh, number=0, **moment.header))


def tiles_of(keys: list[int]) -> list[Tile]:
    """Return the tile of each block; the tile 0, 0, 0 is about the origin."""
    index = block_index(np.array(keys, np.int64))
    tiles: npt.NDArray[np.int64] = (index + TILE // 2) // TILE
    return [(x, y, z) for x, y, z in tiles.tolist()]


def clearing(moment: Moment) -> Marker:
    """Return the marker that deletes all others."""
    return Marker(ns='mesh', id=0, type=TRIANGLE_LIST, action=DELETE_ALL, **moment.header)
