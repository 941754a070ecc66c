# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
MomentMap: the exact moments of voxels, which scans enter and leave.

A voxel is a row of integers in a slab: count, sum and second moment of its points in units of
voxel_size / 65536 about the voxel centre, and the sum of the directions to the sensor. Adding a
scan is integer addition and removing it integer subtraction, so that after any sequence of both
the map equals, bit for bit, the map of the remaining scans. With float32 moments the smallest
eigenvalue is 2.5 to 6 % off at 1 km after 1e5 cycles.

Limits: voxel indices within 21 signed bits an axis (524 km each way at 0.5 m), 2^23 points of a
scan in a voxel, 2^31 points of the map in a voxel.

Points are reduced to moments and surfels derived from them in ``SurfelMap`` (surfel_map.py).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_array, as_numbers, as_whole
from surfel_mapper.errors import MapError, MapLimitError, NotInMapError
from surfel_mapper.kernels import layout
from surfel_mapper.mapping.channels import channel_names
from surfel_mapper.mapping.kernels.rows import read_rows
from surfel_mapper.mapping.moments import (
    check_arrays,
    check_possible,
    digest_of,
    pack_keys,
    ScanMoments,
    shifted_moments,
    whole_keys,
    within_reach,
)
from surfel_mapper.mapping.voxel_table import ChangeLog, VoxelTable

MAX_LEVEL = 15
"""Highest level: a voxel can hold 2^31 / 4^15 = 2 points, of the next no point."""

APART = 1e-3
"""Rounding of the distance of two origins, voxels: their coordinates have at most 16 digits."""


class MomentMap:
    """
    Moments of voxels: insert and remove, exactly; the part of SurfelMap that holds the state.

    Parameters
    ----------
    voxel_size_m : float
        Edge of a voxel, m.
    columns : tuple of str
        Columns of the points whose sums are kept: ``intensity``, ``rgb``.
    level : int
        The lattice unit is ``voxel_size_m / 2^(16 + level)``.
    origin_m : (3,) float, m
        Place of the origin of the map in an outer frame.

    Errors are those of SurfelMap.

    """

    def __init__(
        self,
        voxel_size_m: float,
        columns: tuple[str, ...],
        level: int,
        origin_m: npt.ArrayLike,
    ) -> None:
        if as_whole('level', level) not in range(MAX_LEVEL + 1):
            raise ValueError(f'level: {level}, expected 0 to {MAX_LEVEL}')
        self.voxel_size_m = voxel_size_m
        self.level = int(level)
        self.origin_m = origin_m
        self.version = 0
        self.columns = columns
        self._channel_names = channel_names(columns)
        self._reset()

    def _reset(self) -> None:
        self._table = VoxelTable(len(self._channel_names))
        self._changes = ChangeLog(self.version)
        self.cleared_at = self.version

    def __len__(self) -> int:
        """Return the number of voxels."""
        return self.num_voxels

    @property
    def origin_m(self) -> npt.NDArray[np.float64]:
        """Place of the origin of the map in the outer frame, (3,) m."""
        return self._origin_m

    @origin_m.setter
    def origin_m(self, value: npt.ArrayLike) -> None:
        origin: npt.NDArray[np.float64] = as_numbers('origin_m', value).copy()
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise ValueError(f'origin_m: {origin.tolist()}, expected x y z, finite')
        origin.setflags(write=False)
        self._origin_m = origin

    @property
    def num_voxels(self) -> int:
        """Number of voxels that hold at least one point."""
        return self._table.num_voxels

    @property
    def num_points(self) -> int:
        """Number of points in the map."""
        return self._table.num_points

    @property
    def nbytes(self) -> int:
        """Size of voxels and hash table in use, bytes."""
        return self._table.nbytes

    def insert(self, moments: ScanMoments) -> None:
        """
        Add moments.

        Raises
        ------
        MapError
            If their voxel size differs, no points can have these moments, or a voxel would hold
            more than 2^31 points (2^31 / 4^level in a coarser map). Nothing is changed.

        """
        self._check_lattice(moments)
        self._check_counts(moments)  # before the sums, which overflow beyond its limit
        if moments.num_reduced is None:
            check_possible(moments)
        self.version += 1
        try:
            rows = self._table.add(moments, self.version)
        except BaseException:
            self._changes.forget(self.version)
            raise
        self._changes.add(self.version, rows, self._table.num_voxels)
        object.__setattr__(moments, 'rows', rows)

    def remove(self, moments: ScanMoments, min_points: int = 1) -> npt.NDArray[np.int32]:
        """
        Subtract moments that were added before: the exact inverse.

        Parameters
        ----------
        moments : ScanMoments
            Moments that ``add`` returned.
        min_points : int
            Number of points of a surfel, for the result.

        Returns
        -------
        (E, 3) int32
            Indices of the voxels that held at least ``min_points`` before and hold fewer now.

        Raises
        ------
        MapError
            If their voxel size differs, or no points can have these moments.
        NotInMapError
            If a voxel holds fewer points, or equally many with other sums. Nothing is changed.
            Moments that were never added are detected unless every one of their voxels holds
            more points of other scans.

        """
        self._check_lattice(moments)
        if moments.num_reduced is None:
            check_possible(moments)
        least = as_whole('min_points', min_points)
        self.version += 1
        try:
            missing, rows, fallen = self._table.remove(moments, self.version, least)
        except BaseException:
            self._changes.forget(self.version)
            raise
        if missing >= 0:
            self._changes.forget(self.version)
            index = moments.voxel_index[missing].tolist()
            raise NotInMapError(
                f'voxel {index} does not hold the {moments.count[missing]} points to be '
                'removed; were these moments added to this map, and only removed once?'
            )
        self._changes.add(self.version, rows, self._table.num_voxels)
        return fallen

    def merge(self, other: MomentMap) -> None:
        """
        Add all points of another map of equal voxel size: the exact union.

        Raises
        ------
        MapError
            If the voxel sizes differ, the origins are not a whole number of voxels apart, or a
            voxel would hold too many points; see ``insert``.

        """
        self.insert(self._moments_here(other))

    def subtract(self, other: MomentMap) -> None:
        """
        Remove all points of another map of equal voxel size: the exact inverse of ``merge``.

        Raises
        ------
        MapError
            If the voxel sizes differ.
        NotInMapError
            If this map does not hold all of them. Nothing is changed.

        """
        self.remove(self._moments_here(other))

    def _moments_here(self, other: MomentMap) -> ScanMoments:
        """Return the moments of another map in the voxels of this one."""
        if not isinstance(other, MomentMap):
            raise TypeError(f'a {type(other).__name__}, expected another SurfelMap')
        moments = other.moments()
        if np.array_equal(self.origin_m, other.origin_m):
            return moments
        apart = (other.origin_m - self.origin_m) / self.voxel_size_m
        voxels = np.rint(apart)
        if np.abs(apart - voxels).max() > APART:
            raise MapError(
                f'map with origin_m {other.origin_m.tolist()}, expected one a whole number of '
                f'voxels of {self.voxel_size_m:g} m from {self.origin_m.tolist()}'
            )
        return shifted_moments(moments, voxels.astype(np.int64))

    def __eq__(self, other: object) -> bool:
        """Return whether two maps are equal, to the bit, and have one origin."""
        if not isinstance(other, MomentMap):
            return NotImplemented
        if not np.array_equal(self.origin_m, other.origin_m):
            return False
        return self.num_voxels == other.num_voxels and self.digest() == other.digest()

    __hash__ = None  # type: ignore[assignment]  # a map is mutable

    def moments(self, voxel_index: npt.NDArray[Any] | None = None) -> ScanMoments:
        """
        Return the exact moments of voxels, sorted by voxel; a copy.

        Parameters
        ----------
        voxel_index : (K, 3) int, optional
            The voxels; those that the map does not contain are skipped. By default all.

        Raises
        ------
        ValueError
            If the voxels are not integers (K, 3).

        """
        if voxel_index is None:
            chosen = self._table.occupied()
            return self._moments_of(chosen[np.argsort(self._table.keys(chosen))])
        index = as_array('voxel_index', voxel_index)
        if index.dtype.kind not in 'iu' or index.ndim != 2 or index.shape[1] != 3:
            kind = f'{index.dtype} {index.shape}'
            raise ValueError(f'voxel_index: {kind}, expected integers (K, 3)')
        keys = np.unique(pack_keys(index[within_reach(index)]))  # in this order: by voxel
        chosen = self._table.find(keys)
        return self._moments_of(chosen[chosen >= 0])

    def _moments_of(self, chosen: npt.NDArray[Any]) -> ScanMoments:
        """Return the moments of rows, in the given order; a copy."""
        shapes = ((), (), (3,), (6,), (3,))
        arrays = tuple(np.empty((len(chosen), *shape), np.int64) for shape in shapes)
        read_rows(self._table.rows.array, chosen, arrays)
        key, count, total, product, view = arrays
        return ScanMoments(
            voxel_size_m=self.voxel_size_m,
            level=self.level,
            key=key,
            count=count,
            total=total,
            product=product,
            view=view,
            channel_names=self._channel_names,
            channels=self._table.channels(chosen),
        )

    def digest(self) -> str:
        """
        Return the SHA-256 of the state in hexadecimal.

        It covers voxel size, level, voxel indices and integer moments, sorted by voxel: equal
        digests mean equal maps, independent of the order of insertion. ``digest_of`` in
        mapping/moments.py specifies the hashed bytes.

        """
        moments = self.moments()
        return digest_of(
            self.voxel_size_m,
            self.level,
            len(moments),
            self.columns,
            lambda name: [getattr(moments, name)],
        )

    def keys(self, min_points: int = 1) -> npt.NDArray[np.int64]:
        """Return the keys (K,) of the voxels of at least min_points points, in any order."""
        return self._table.keys(self._table.occupied(as_whole('min_points', min_points)))

    def keys_within(
        self, low: npt.NDArray[np.int64], high: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.int64]:
        """Return the keys (K,) of the voxels with indices from low to high (3,), in any order."""
        return self._table.keys_in_box(low, high)

    def find(self, key: npt.NDArray[np.int64]) -> npt.NDArray[np.int32]:
        """Return the row of each voxel key (K,), -1 if not found; valid until the map changes."""
        return self._table.find(whole_keys(key))

    def keys_of(self, rows: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
        """Return the voxel keys of rows (K,), -1 for empty rows."""
        rows = self._table.checked(rows)
        return np.where(self._table.counts(rows) > 0, self._table.keys(rows), -1)

    def rows_changed(self, since: int) -> npt.NDArray[np.int32]:
        """
        Return the rows (K,) that changed after a version, each once, including emptied ones.

        Rows from before the map was cleared (``cleared_at``, a version) are not included.
        """
        since = as_whole('since', since)
        changed = self._changes.since(since, self._table, 0)
        return self._table.changed_after(since, 0) if changed is None else changed

    def clear(self) -> None:
        """Remove all voxels."""
        self.version += 1
        self._reset()

    def __repr__(self) -> str:
        """Return size and counts of the map."""
        level = f', level {self.level}' if self.level else ''
        return (
            f'SurfelMap({self.voxel_size_m:g} m{level}: {self.num_points} points in '
            f'{self.num_voxels} voxels)'
        )

    def _check_lattice(self, moments: ScanMoments) -> None:
        if not isinstance(moments, ScanMoments):
            raise TypeError(
                f'a {type(moments).__name__}, expected the ScanMoments that add or reduce '
                'returned; points are added by add'
            )
        if (moments.voxel_size_m, moments.level) != (self.voxel_size_m, self.level):
            raise MapError(
                f'moments of voxel size {moments.voxel_size_m:g} m, level {moments.level}; '
                f'this map has {self.voxel_size_m:g} m, level {self.level}'
            )
        if moments.num_reduced is None:
            check_arrays(moments)
        if moments.channel_names != self._channel_names:
            raise MapError(
                f'moments with the channels {moments.channel_names}; '
                f'this map has {self._channel_names}'
            )

    def _check_counts(self, moments: ScanMoments) -> None:
        """Raise MapLimitError if a voxel would hold more points than the integers allow."""
        limit = layout.MAX_MAP_COUNT >> (2 * self.level)
        if self._table.num_points + moments.num_points <= limit:
            return  # usual: even all points in one voxel would be allowed
        rows = self._table.find(moments.key)
        largest = int((self._table.counts(rows) + moments.count).max(initial=0))
        if largest > limit:
            raise MapLimitError(
                f'a voxel would hold {largest} points; at most {limit}: use smaller voxels '
                'or a window'
            )
