# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
EuclideanField: distances to the nearest obstacle, kept up to date with a block map (an ESDF).

The distances of a truncated signed distance field are measured along rays and end at the
truncation; planners need the Euclidean distance, farther out. Here every voxel of a block has the
squared distance, in voxels, to the nearest occupied voxel; row r belongs to row r of the map:

    squared  (R, N) uint16, FAR beyond ``max_m``
    marks    (R, N) uint8, occupied before and now; see kernels/euclidean.py

Blocks changed since the last update are compared with their former occupancy, and only voxels
whose distance may differ are computed again. Distances stay exact, those of a transform
of the whole (scipy.ndimage.distance_transform_edt), unlike those of wavefronts.

Peers: voxblox (Oleynikova et al. 2017) and FIESTA (Han et al. 2019) propagate wavefronts, nvblox
(Millane et al. 2024) sweeps whole blocks on the GPU; all are approximate.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_real
from surfel_mapper.errors import ConfigError
from surfel_mapper.kernels.layout import KEY
from surfel_mapper.mapping.storage import Slab
from surfel_mapper.tsdf.blocks import block_index, BlockMap, FIRST_ROWS, Int64
from surfel_mapper.tsdf.kernels import euclidean as kernels
from surfel_mapper.tsdf.kernels.blocks import FREE, FREE_VISITS, VERSION
from surfel_mapper.tsdf.queries import in_voxels

MANY = 128
"""Marked voxels of a block from which it is faster to compute the whole block."""

FULL = 3
"""Blocks of a cube of eight from which it is faster to compute all of them together."""


@dataclass(frozen=True, kw_only=True)
class KnownDistances:
    """
    Distances of the observed voxels about a place.

    Attributes
    ----------
    points : (P, 3) float64
        Centres of the voxels, map frame, m.
    distance : (P,) float32
        Distance to the nearest obstacle, m, at most ``max_m``; 0 in obstacles.

    """

    points: npt.NDArray[np.float64]
    distance: npt.NDArray[np.float32]


class EuclideanField:
    """
    Euclidean distances from voxels to the nearest occupied voxel, between their centres.

    Voxels up to half a voxel in front of a surface are occupied, as in ``tsdf.queries.states``.

    Attributes
    ----------
    max_m : float
        Distances are exact up to this, m.
    radius_m : float
        They are kept within this of the place given to ``update``, m; 0: everywhere.

    Parameters
    ----------
    blocks : BlockMap
        The map.
    max_m, radius_m : float
        As above.

    Raises
    ------
    ConfigError
        If max_m is not positive or more than 127 voxels.

    """

    def __init__(self, blocks: BlockMap, *, max_m: float = 2.0, radius_m: float = 0.0) -> None:
        size_m, voxels = blocks.config.voxel_size_m, blocks.voxels_per_block
        if not size_m <= as_real('esdf.max_m', max_m) <= kernels.MAX_REACH * size_m:
            raise ConfigError(
                f'esdf.max_m: {max_m}, expected {size_m} to {kernels.MAX_REACH * size_m:g}, that '
                f'is 1 to {kernels.MAX_REACH} voxels'
            )
        self.max_m, self.radius_m = max_m, radius_m
        self._blocks = blocks
        self._center: npt.NDArray[np.float64] = np.zeros(3)
        self._most = int((max_m / size_m) ** 2 * (1.0 + 1e-9))
        self._order = places_within(self._most)
        self._bits = blocks.config.voxels_per_side.bit_length() - 1
        self._squared, self._marks = (Slab(FIRST_ROWS, voxels * k // 8) for k in (2, 1))
        self._keys: Int64 = np.full(FIRST_ROWS, -1, np.int64)
        self._seen: Int64 = np.zeros(FIRST_ROWS, np.int64)
        self._occupied: Int64 = np.zeros(FIRST_ROWS, np.int64)

    def update(self, center: npt.ArrayLike | None = None) -> int:
        """
        Follow the changes of the map.

        Parameters
        ----------
        center : (3,) float, optional
            Place about which distances are kept, map frame, m; needed with ``radius_m``. Others
            are brought up to date when they come near.

        Returns
        -------
        int
            Number of voxels that became occupied or free.

        """
        if center is not None:
            self._center = np.asarray(center, np.float64)
        self._grow()
        num_raised = np.zeros(len(self._keys), np.int64)
        self._forget(num_raised)
        rows = self._changed()
        fresh = rows[self._keys[rows] < 0]
        counts = self._mark(rows)
        is_new = np.zeros(len(self._keys), bool)
        is_new[fresh] = True
        kept = (self._keys >= 0) & ~is_new
        self._spread(rows[counts[:, 0] > 0], kernels.OLD, kept, num_raised)
        self._search(num_raised, is_new)
        self._transform(np.flatnonzero(is_new))
        self._spread(rows[counts[:, 1] > 0], kernels.NEW, kept & ~is_new, num_raised)
        kernels.settle(rows[counts[:, :2].any(axis=1)], self._mark_rows)
        return int(counts[:, :2].sum())

    def sample(self, points: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """
        Return the distances of the voxels at points after the last update.

        Parameters
        ----------
        points : (P, 3) float
            In the map frame, m.

        Returns
        -------
        (P,) float32
            Distance to the nearest obstacle, m, at most ``max_m``; 0 in obstacles; nan if the
            voxel was not observed or is out of the radius.

        Raises
        ------
        ValueError
            If points are of another shape.

        """
        places, bits = in_voxels(self._blocks, points)
        near = np.abs(places).max(axis=1) < 1e12  # false for nan and for indices beyond int64
        voxel = np.floor(np.where(near[:, None], places, 0.0)).astype(np.int64)
        rows = np.where(near, self._blocks.find(voxel >> bits), -1)
        x, y, z = (voxel & ((1 << bits) - 1)).T
        numbers = x + ((y + (z << bits)) << bits)
        known = (rows >= 0) & (rows < len(self._keys))
        known[known] &= self._keys[rows[known]] == self._blocks.head[rows[known], KEY]
        known[known] &= self._within(rows[known])
        known[known] &= self._blocks.weight[rows[known], numbers[known]] > 0.0
        found = np.full(len(rows), np.nan, np.float32)
        found[known] = self._metres(self._squares[rows[known], numbers[known]])
        return found

    def known(self) -> KnownDistances:
        """Return the distances of all observed voxels within the radius."""
        rows = np.flatnonzero(self._keys >= 0)
        rows = rows[self._within(rows)]
        side, size_m = self._blocks.config.voxels_per_side, self._blocks.config.voxel_size_m
        local = np.indices((side, side, side)).reshape(3, -1)[::-1].T
        place, number = np.nonzero(self._blocks.weight[rows] > 0.0)
        voxels = block_index(self._keys[rows])[place] * side + local[number]
        return KnownDistances(
            points=np.asarray((voxels + 0.5) * size_m, np.float64),
            distance=self._metres(self._squares[rows[place], number]),
        )

    def _metres(self, squared: npt.NDArray[np.uint16]) -> npt.NDArray[np.float32]:
        metres = np.sqrt(squared.astype(np.float64)) * self._blocks.config.voxel_size_m
        return np.asarray(np.where(squared == kernels.FAR, self.max_m, metres), np.float32)

    def _within(self, rows: Int64, margin_m: float = 0.0) -> npt.NDArray[np.bool_]:
        """Return which blocks are within the radius, and a margin, of the last place."""
        if self.radius_m <= 0.0:
            return np.ones(len(rows), bool)
        centers = (self._blocks.index(rows) + 0.5) * self._blocks.config.block_size_m
        distance = np.linalg.norm(centers - self._center, axis=1)
        return np.asarray(distance <= self.radius_m + margin_m)

    @property
    def _squares(self) -> npt.NDArray[np.uint16]:
        view: npt.NDArray[np.uint16] = self._squared.array.view(np.uint16)
        return view

    @property
    def _mark_rows(self) -> npt.NDArray[np.uint8]:
        view: npt.NDArray[np.uint8] = self._marks.array.view(np.uint8)
        return view

    def _grow(self) -> None:
        """Add rows until there are as many as in the map."""
        number, before = len(self._blocks.head), len(self._keys)
        if number == before:
            return
        self._squared.grow(number)
        self._marks.grow(number)
        more = number - before
        self._keys = np.concatenate([self._keys, np.full(more, -1, np.int64)])
        self._seen, self._occupied = (np.pad(a, (0, more)) for a in (self._seen, self._occupied))

    def _forget(self, num_raised: Int64) -> None:
        """Forget blocks that have left the map; mark the voxels that were nearest to theirs."""
        head = self._blocks.head
        kept = (head[:, KEY] == self._keys) & (head[:, VERSION] != FREE)
        gone = np.flatnonzero((self._keys >= 0) & ~kept)
        if not len(gone):
            return
        marks = self._mark_rows
        marks[gone] &= kernels.OLD
        self._spread(gone, kernels.OLD, kept, num_raised)
        marks[gone] = 0
        self._keys[gone] = -1
        self._occupied[gone] = 0

    def _changed(self) -> Int64:
        """Return the rows of blocks to compare with the map."""
        rows = self._blocks.rows()
        version = self._blocks.head[rows, VERSION]
        rows = rows[(version > self._seen[rows]) | (self._keys[rows] < 0)]
        margin_m = self.max_m + math.sqrt(3.0) * self._blocks.config.block_size_m
        rows = rows[self._within(rows, margin_m)]
        head = self._blocks.head
        stays_free = (head[rows, FREE_VISITS] > 0) & (self._occupied[rows] == 0)
        stays_free &= self._keys[rows] >= 0
        self._seen[rows[stays_free]] = head[rows[stays_free], VERSION]
        changed: Int64 = rows[~stays_free]
        return changed

    def _mark(self, rows: Int64) -> Int64:
        """Compare occupancy with that before; return what kernels.mark_occupied counts."""
        blocks, counts = self._blocks, np.empty((len(rows), 3), np.int64)
        self._keys[rows] = blocks.head[rows, KEY]
        occupied = np.float32(0.5 * blocks.config.voxel_size_m)
        least = np.float32(np.finfo(np.float32).tiny)
        kernels.mark_occupied(rows, blocks.field, least, occupied, self._mark_rows, counts)
        self._seen[rows] = blocks.head[rows, VERSION]
        self._occupied[rows] = counts[:, 2]
        return counts

    def _spread(
        self, rows: Int64, flips: np.uint8, targets: npt.NDArray[np.bool_], num_raised: Int64
    ) -> None:
        """Follow voxels of some blocks that became occupied or free; see kernels.spread."""
        if not targets.any():
            return
        kernels.spread(
            rows,
            block_index(self._keys[rows]),
            flips,
            self._most,
            targets,
            self._bits,
            self._keys,
            self._blocks.lookup,
            self._mark_rows,
            self._squares,
            num_raised,
        )

    def _search(self, num_raised: Int64, is_new: npt.NDArray[np.bool_]) -> None:
        """Find the distances of marked voxels; blocks of many are left to the transform."""
        marked = np.flatnonzero(num_raised)
        many = marked[num_raised[marked] > MANY]
        is_new[many] = True
        self._mark_rows[many] &= ~kernels.RAISED
        few = marked[~is_new[marked]]
        kernels.search(
            few,
            block_index(self._keys[few]),
            *self._order,
            self._bits,
            self._keys,
            self._blocks.lookup,
            self._mark_rows,
            self._squares,
        )

    def _transform(self, rows: Int64) -> None:
        """Compute blocks as a whole, by eight if most of them are asked for."""
        index = block_index(self._keys[rows])
        tiles, place, number = np.unique(
            index // 2 * 2, axis=0, return_inverse=True, return_counts=True
        )
        for size, part in (
            (2, tiles[number >= FULL]),
            (1, index[number[place.reshape(-1)] < FULL]),
        ):
            kernels.transform(
                part[np.lexsort(part.T[::-1])],  # upwards: each tile knows blocks of the one below
                size,
                self._most,
                self._bits,
                self._keys,
                self._blocks.lookup,
                self._mark_rows,
                self._occupied,
                self._squares,
            )


def places_within(most: int) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.uint16], Int64]:
    """
    Return the voxels about a voxel in the order of their distance, for kernels.search.

    Parameters
    ----------
    most : int
        Largest squared distance, voxels.

    Returns
    -------
    places : (P, 3) int16
        Offsets.
    lengths : (P,) uint16
        Their squared lengths, ascending.
    firsts : (most + 1,) int64
        The first place of at least each squared length.

    """
    steps = np.arange(-math.isqrt(most), math.isqrt(most) + 1)
    places = np.stack(np.meshgrid(steps, steps, steps, indexing='ij'), axis=-1).reshape(-1, 3)
    squared = (places**2).sum(axis=1)
    order = np.argsort(squared, kind='stable')
    order = order[: np.searchsorted(squared[order], most, side='right')]
    lengths = squared[order]
    firsts = np.searchsorted(lengths, np.arange(most + 1)).astype(np.int64)
    return places[order].astype(np.int16), lengths.astype(np.uint16), firsts
