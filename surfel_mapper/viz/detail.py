# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Levels of detail of a map: near tiles as they are, far ones as the exact coarser map.

A tile is a square column of voxels. Each is drawn at one level, that is, by the surfels that
``SurfelMap.coarsen(level)`` has in it, computed from the moments and so exact; no surfel is left
out at random. The level grows by one whenever the distance to the place looked at doubles, which
keeps the size on the screen, and the distance at which it begins is the largest for which all
discs together stay within a limit.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surfel_mapper.kernels import layout
from surfel_mapper.mapping.coarsening import coarse_keys, coarse_surfels
from surfel_mapper.mapping.moments import ScanMoments, unpack_keys
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import concatenated, Surfels
from surfel_mapper.threads import share, usable_cores

Array = npt.NDArray[np.float64]

LEVELS = 5
"""Coarser levels; a voxel of the last is 32 times larger."""

MOST_LEVEL = layout.INDEX_BITS - 1
"""The coarsest level of a map."""

MOST_TILES = 256
"""Limit of the tiles, each of which is an entity of the viewer."""

BLOCK = 1 << 16
"""Number of keys that are masked at a time; half a megabyte stays in the cache."""

STEPS = 60
"""Distances tried for the begin of the first coarser level, between a tile and the whole map."""


class DetailedMap:
    """
    A map in tiles that can be drawn at several levels.

    Parameters
    ----------
    moments : ScanMoments
        Those of a map, as ``SurfelMap.moments`` returns them. A map of 5 million surfels is drawn
        without its hash table, which takes longer to fill than all else, and only the tiles that
        are drawn are summed, each at its level.
    min_points : int
        Voxels with fewer points are no surfels.

    Attributes
    ----------
    tiles : (T, 2) int64
        Voxel indices in i and j of the tiles, shifted right by ``bits``.
    edge_m : float
        Edge of a tile.
    counts : (L, T) int64
        Number of surfels of each tile at each level.

    """

    def __init__(self, moments: ScanMoments, min_points: int) -> None:
        self._moments, self._min_points = moments, min_points
        last = min(LEVELS, MOST_LEVEL - moments.level)
        begin, columns = column_runs(moments.key, last)
        indices = unpack_keys(columns)[:, :2].astype(np.int64) >> last
        self.bits, self.tiles = tiles_of(indices, last)
        self.edge_m = moments.voxel_size_m * 2.0**self.bits
        tile = np.searchsorted(packed(self.tiles), packed(indices >> (self.bits - last)))
        order = np.argsort(tile, kind='stable')
        self._begin = begin[order]  # of the runs, in the order of their tiles
        self._length = np.diff(begin, append=len(moments))[order]
        self._ends = np.cumsum(np.bincount(tile, minlength=len(self.tiles)))
        self.counts: npt.NDArray[np.int64] = np.zeros((last + 1, len(self.tiles)), np.int64)
        fits = np.ones((last + 1, len(self.tiles)), bool)

        def count(chunk: slice) -> None:
            for number in range(chunk.start, chunk.stop):
                self._count(number, fits)

        share(count, len(self.tiles), usable_cores())
        self.counts = self.counts[fits.all(axis=1)]

    def __len__(self) -> int:
        """Return the number of tiles."""
        return len(self.tiles)

    def choose(self, target: npt.ArrayLike, at_most: int) -> npt.NDArray[np.int64]:
        """
        Return the level at which each tile is drawn, (T,).

        Parameters
        ----------
        target : (3,) float, m
            The position looked at, in the frame of the map.
        at_most : int
            Limit of the number of discs; exceeded only if the coarsest level of all tiles does.

        """
        distance = self._distances(np.asarray(target, np.float64))
        last = len(self.counts) - 1
        tiles = np.arange(len(self.tiles))
        if self.counts[0].sum() <= at_most:
            return np.zeros(len(tiles), np.int64)
        chosen = np.full(len(tiles), last)
        for least in range(last, -1, -1):  # level at the target itself
            for begin_m in np.geomspace(0.25 * self.edge_m, distance.max() + self.edge_m, STEPS):
                farther = np.log2(np.maximum(distance / begin_m, 0.5)) + 1.0
                level = np.clip(np.floor(farther).astype(np.int64) + least, least, last)
                if self.counts[level, tiles].sum() > at_most:
                    break
                chosen = level
        return chosen

    def surfels(self, tile: int, level: int) -> Surfels:
        """Return the surfels of a tile at a level."""
        return coarse_surfels(self._moments, level, self._voxels(tile), self._min_points)

    def all_surfels(self, level: npt.NDArray[np.int64]) -> list[Surfels]:
        """Return the surfels of all tiles, each at its level (T,)."""
        by_tile: dict[int, Surfels] = {}

        def sum_up(chunk: slice) -> None:
            for tile in range(chunk.start, chunk.stop):
                by_tile[tile] = self.surfels(tile, int(level[tile]))

        share(sum_up, len(self.tiles), usable_cores())
        return [by_tile[tile] for tile in range(len(self.tiles))]

    def _voxels(self, tile: int) -> npt.NDArray[np.int64]:
        """Return the rows of the moments in a tile."""
        runs = slice(self._ends[tile - 1] if tile else 0, self._ends[tile])
        length = self._length[runs]
        offsets = np.cumsum(length) - length
        return np.repeat(self._begin[runs] - offsets, length) + np.arange(length.sum())

    def _count(self, tile: int, fits: npt.NDArray[np.bool_]) -> None:
        """Count the surfels of a tile at each level; note the levels whose sums may overflow."""
        voxels = self._voxels(tile)
        key, count = self._moments.key[voxels], self._moments.count[voxels]
        for level in range(len(fits)):
            if level:
                key, parent = coarse_keys(key, 1)
                # float64 is exact below 2^53
                count = np.bincount(parent, count, len(key)).astype(np.int64)
                limit = layout.MAX_MAP_COUNT >> 2 * (self._moments.level + level)
                fits[level:, tile] &= count.max() <= limit
            self.counts[level, tile] = np.count_nonzero(count >= self._min_points)

    def _distances(self, target: Array) -> Array:
        """Return the horizontal distance of each tile from a target, (T,) m; 0 inside."""
        low = self.tiles * self.edge_m
        away = np.maximum(np.maximum(low - target[:2], target[:2] - low - self.edge_m), 0.0)
        return np.asarray(np.sqrt((away * away).sum(axis=1)))


def drawn_surfels(
    surfels: Surfels,
    surfel_map: SurfelMap,
    min_points: int,
    target: npt.ArrayLike,
    at_most: int,
) -> Surfels:
    """
    Return the surfels of a map by which it is drawn: adaptive ones, of parts if there are many.

    Parameters
    ----------
    surfels : Surfels
        The adaptive surfels of the map.
    surfel_map : SurfelMap
        The map.
    min_points : int
        Voxels with fewer points are no surfels.
    target : (3,) float, m
        The position around which the map has its full detail, in the frame of the map.
    at_most : int
        Limit of their number.

    """
    if len(surfels) <= at_most:
        return surfels
    detailed = DetailedMap(surfel_map.moments(), min_points)
    level = detailed.choose(target, at_most)
    return concatenated(detailed.all_surfels(level))


def tiles_of(columns: npt.NDArray[np.int64], level: int) -> tuple[int, npt.NDArray[np.int64]]:
    """Return the bits of a tile and the sorted tiles that hold some columns of a level, (T, 2)."""
    bits, tiles = level, columns
    while True:  # of one number each: np.unique of rows takes 50 times as long
        tiles = tiles[np.unique(packed(tiles), return_index=True)[1]]
        if len(tiles) <= MOST_TILES:
            return bits, tiles
        bits, tiles = bits + 1, tiles >> 1


def column_runs(
    key: npt.NDArray[np.int64], level: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """
    Return the first voxel of each run of voxels in one column of a level, and the columns' keys.

    Files have voxels in the order of their keys, some 60 of a column one after the other. The keys
    are taken in blocks, as memory for masks of all of them takes longer to get than to fill.
    """
    beyond = (np.int64(1) << level) - 1
    mask = ~(beyond << 2 * layout.INDEX_BITS | (beyond + 1 << layout.INDEX_BITS) - 1)
    begin, columns, previous = [], [], np.int64(-1)
    for start in range(0, len(key), BLOCK):
        column = key[start : start + BLOCK] & mask
        changes = np.flatnonzero(np.diff(column, prepend=previous))
        begin.append(changes + start)
        columns.append(column[changes])
        previous = column[-1]
    if not begin:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    return np.concatenate(begin), np.concatenate(columns)


def packed(tile: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return tiles (K, 2) as one number each, which sorts as they do."""
    return np.asarray((tile[:, 0] << 32) + tile[:, 1], np.int64)
