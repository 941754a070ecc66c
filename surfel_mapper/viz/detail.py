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
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import concatenated, Surfels

Array = npt.NDArray[np.float64]

LEVELS = 5
"""Coarser levels; a voxel of the last is 32 times larger."""

MOST_LEVEL = layout.INDEX_BITS - 1
"""The coarsest level of a map."""

MOST_TILES = 256
"""Limit of the tiles, each of which is an entity of the viewer."""

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
        Indices of the tiles along x and y.
    edge_m : float
        Edge of a tile.
    counts : (L, T) int64
        Number of surfels of each tile at each level.

    """

    def __init__(self, moments: ScanMoments, min_points: int) -> None:
        self._moments, self._min_points = moments, min_points
        last = min(LEVELS, MOST_LEVEL - moments.level)
        column = moments.voxel_index[:, :2].astype(np.int64)
        bits, self.tiles = tiles_of(column >> last, last)
        self.edge_m = moments.voxel_size_m * 2**bits
        tile = np.searchsorted(packed(self.tiles), packed(column >> bits))
        ends = np.cumsum(np.bincount(tile, minlength=len(self.tiles)))
        # numbers of 16 bits are sorted by radix
        self._voxels = np.split(np.argsort(tile.astype(np.uint16), kind='stable'), ends[:-1])
        key, count, counts = moments.key, moments.count, []
        for level in range(last + 1):
            if level:
                key, parent = coarse_keys(key, 1)
                tile_of = np.empty(len(key), np.int64)
                tile_of[parent] = tile
                # float64 is exact below 2^53
                count, tile = np.bincount(parent, count, len(key)).astype(np.int64), tile_of
            if count.max(initial=0) > layout.MAX_MAP_COUNT >> 2 * (moments.level + level):
                break
            counts.append(np.bincount(tile[count >= min_points], minlength=len(self.tiles)))
        self.counts: npt.NDArray[np.int64] = np.stack(counts)

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
        return coarse_surfels(self._moments, level, self._voxels[tile], self._min_points)

    def all_surfels(self, level: npt.NDArray[np.int64]) -> list[Surfels]:
        """Return the surfels of all tiles, each at its level (T,)."""
        return [self.surfels(tile, int(number)) for tile, number in enumerate(level)]

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


def packed(tile: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return tiles (K, 2) as one number each, which sorts as they do."""
    return np.asarray((tile[:, 0] << 32) + tile[:, 1], np.int64)
