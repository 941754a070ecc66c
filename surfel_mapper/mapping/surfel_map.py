# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
SurfelMap: a hashed voxel map of exact, reversible surfels.

A voxel is a row of integers in a slab: count, sum and second moment of its points in units of
voxel_size / 65536 about the voxel centre, and the sum of the directions to the sensor. Adding a
scan is integer addition and removing it integer subtraction, so that after any sequence of both
the map equals, bit for bit, the map of the remaining scans. With float32 moments the smallest
eigenvalue is 2.5 to 6 % off at 1 km after 1e5 cycles.

Limits: voxel indices within 21 signed bits an axis (524 km each way at 0.5 m), 2^23 points of a
scan in a voxel, 2^31 points of the map in a voxel.

(One module of 700 lines because it is one class, the main one; most of it is the description of
its methods. The work is done in voxel_table, reducer, surfels and moments.)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
import logging
import math
import operator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import MapError, MapLimitError, NotInMapError
from surfel_mapper.kernels import layout
from surfel_mapper.mapping.channels import channel_names, means
from surfel_mapper.mapping.kernels.surfels import derive_covariances
from surfel_mapper.mapping.kernels.voxels import first_impossible
from surfel_mapper.mapping.moments import (
    coarse_moments,
    digest_of,
    looks_like_millimetres,
    MILLIMETRES,
    pack_keys,
    ScanMoments,
    shifted_moments,
    unpack_keys,
)
from surfel_mapper.mapping.reducer import Reducer
from surfel_mapper.mapping.surfel_index import SurfelIndex
from surfel_mapper.mapping.surfels import derive, Surfels
from surfel_mapper.mapping.voxel_table import ChangeLog, VoxelTable

Box = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]
"""Lowest and highest voxel index, (3,) each."""


APART = 1e-3
"""Rounding of the distance of two origins, voxels: their coordinates have at most 16 digits."""


_log = logging.getLogger(__name__)


def _files() -> Any:
    """
    Return the module that saves and loads maps.

    Files are above this level of the package; it is named here, as the package names the homes of
    its public names, so that the class has the methods that users look for.
    """
    return import_module('surfel_mapper.files.maps')


def _rebuilt(
    voxel_size_m: float,
    settings: dict[str, Any],
    origin_m: npt.NDArray[np.float64],
    moments: ScanMoments,
) -> SurfelMap:
    """Return the map of a pickle."""
    surfel_map = SurfelMap(voxel_size_m, origin_m=origin_m, **settings)
    surfel_map.insert(moments)
    return surfel_map


class SurfelMap:
    """
    A map of surfels with exact addition and removal of scans.

    Not thread-safe: one thread uses the map; others may read the arrays that its methods
    returned.

    Parameters
    ----------
    voxel_size_m : float
        Edge of a voxel, m.
    columns : tuple of str
        Columns of the points to sum exactly as well: ``intensity``, ``rgb``.
    threads : int
        Number of threads that share the work; results do not depend on it.
    level : int
        The lattice unit is ``voxel_size_m / 2^(16 + level)``; not 0 only in maps that
        ``coarsen`` returned, to which no scan can be added.
    origin_m : (3,) float, m
        Place of the origin of the map in an outer frame, such as UTM, in which files are written.
        Points are given and surfels returned in the frame of the map, and the digest does not
        depend on it; ``merge`` and ``subtract`` shift maps of another origin, exactly.

    Raises
    ------
    ValueError
        If the voxel size is not positive and finite, a column cannot be summed, threads is less
        than 1, the level is negative or beyond 20, or the origin is not finite.

    """

    def __init__(
        self,
        voxel_size_m: float = 0.5,
        *,
        columns: tuple[str, ...] = (),
        threads: int = 1,
        level: int = 0,
        origin_m: npt.ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        if isinstance(voxel_size_m, bool) or not isinstance(voxel_size_m, (int, float, np.number)):
            raise TypeError(
                f'voxel_size_m: {voxel_size_m!r}, expected a number of metres; settings belong '
                'to Mapper'
            )
        if not 0.0 < voxel_size_m < math.inf:
            raise ValueError(f'voxel_size_m: {voxel_size_m}, expected positive and finite')
        if threads < 1:
            raise ValueError(f'threads: {threads}, expected 1 or more')
        if level not in range(layout.INDEX_BITS):
            raise ValueError(f'level: {level}, expected 0 to {layout.INDEX_BITS - 1}')
        self.voxel_size_m = float(voxel_size_m)
        self.level = operator.index(level)
        self.origin_m = origin_m
        self.version = 0
        self.columns = columns
        self._channel_names = channel_names(columns)
        self._threads = threads
        self._warned_of_units = False
        self._reducer = Reducer(self.voxel_size_m, columns)
        self._reset()

    def _reset(self) -> None:
        self._table = VoxelTable(len(self._channel_names))
        self._changes = ChangeLog(self.version)
        self._reported = self.cleared_at = self.version

    def __len__(self) -> int:
        """Return the number of voxels."""
        return self.num_voxels

    @property
    def origin_m(self) -> npt.NDArray[np.float64]:
        """Place of the origin of the map in the outer frame, (3,) m."""
        return self._origin_m

    @origin_m.setter
    def origin_m(self, value: npt.ArrayLike) -> None:
        origin = np.array(value, np.float64)
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

    def add(
        self,
        points: npt.ArrayLike,
        origin: npt.ArrayLike | None = None,
        *,
        T_map_sensor: npt.ArrayLike | None = None,
        columns: Mapping[str, npt.NDArray[Any]] | None = None,
    ) -> ScanMoments:
        """
        Add points and return their moments, which ``remove`` takes.

        Parameters
        ----------
        points : (N, 3) float, m
            In the frame of the map, or of the sensor if its pose is given. Points with nan or inf
            are left out and counted in ``left_out`` of the result.
        origin : (3,) float, m, optional
            Position of the sensor in the map; normals turn towards it. Default: that of the pose.
        T_map_sensor : (4, 4) float, optional
            Pose of the sensor in the map.
        columns : mapping of str to (N,) array, optional
            Further columns of the points; required if the map has columns.

        Raises
        ------
        ValueError
            If shapes or types are wrong.
        MapLimitError
            If a point lies beyond the voxel indices, or a voxel would hold too many points.
            Nothing is changed.

        """
        if T_map_sensor is not None:
            T_map_sensor = np.asarray(T_map_sensor, np.float64)
            if origin is None and T_map_sensor.shape == (4, 4):
                origin = T_map_sensor[:3, 3]
        moments = self.reduce(points, T_map_sensor, origin=origin, columns=columns)
        if not self._warned_of_units and looks_like_millimetres(moments):
            self._warned_of_units = True
            _log.warning(MILLIMETRES)
        beyond = moments.left_out.get('beyond_map', 0)
        if beyond:
            limit = layout.INDEX_OFFSET * self.voxel_size_m
            raise MapLimitError(
                f'{beyond} of {len(np.asarray(points))} points lie outside of '
                f'[{-limit:g}, {limit:g}) m; subtract a point near the robot from points and '
                'poses (map.origin in a configuration)'
            )
        self.insert(moments)
        return moments

    def reduce(
        self,
        points: npt.ArrayLike,
        T_map_sensor: npt.NDArray[np.float64] | None = None,
        *,
        origin: npt.ArrayLike | None = None,
        min_range_m: float = 0.0,
        max_range_m: float = math.inf,
        columns: Mapping[str, npt.NDArray[Any]] | None = None,
    ) -> ScanMoments:
        """
        Return the moments that points have in this map, without adding them.

        Does not access the voxels of the map, so another thread may reduce the next scan while
        this one is inserted.

        A point is quantised once, X = floor((((R0 x + R1 y) + R2 z) + t) 65536 / voxel size)
        in float64; the voxel index is X >> 16 and the place in the voxel (X & 65535) - 32768.

        Parameters
        ----------
        points : (N, 3) float, m
            In the frame of the sensor.
        T_map_sensor : (4, 4) float64, optional
            Pose of the sensor; by default the points are in the frame of the map.
        origin : (3,) float, m, optional
            Position of the sensor in the frame of the map.
        min_range_m, max_range_m : float
            Range of distances from the origin of the points' frame; other points are left out.
        columns : mapping of str to (N,) array, optional
            Further columns of the points; required if the map has columns.

        Raises
        ------
        ValueError
            If shapes or types are wrong, or T_map_sensor is not a rigid transform.

        """
        return self._reducer.reduce(
            points,
            T_map_sensor,
            origin=origin,
            min_range_m=min_range_m,
            max_range_m=max_range_m,
            columns=columns,
        )

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
        self._check_possible(moments)
        self._check_counts(moments)
        self.version += 1
        rows = self._table.add(moments, self.version)
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
            If their voxel size differs.
        NotInMapError
            If a voxel holds fewer points, or equally many with other sums. Nothing is changed.
            Moments that were never added are detected unless every one of their voxels holds
            more points of other scans.

        """
        self._check_lattice(moments)
        missing, rows, fallen = self._table.remove(moments, self.version + 1, min_points)
        if missing >= 0:
            index = moments.voxel_index[missing].tolist()
            raise NotInMapError(
                f'voxel {index} does not hold the {moments.count[missing]} points to be '
                'removed; were these moments added to this map, and only removed once?'
            )
        self.version += 1
        self._changes.add(self.version, rows, self._table.num_voxels)
        return unpack_keys(fallen)

    @classmethod
    def load(cls, path: str | Path) -> SurfelMap:
        """
        Return the map in a file, exactly as it was saved; without the scans of its window.

        Parameters
        ----------
        path : str or Path
            An .npz or .parquet file, or the output directory of a replay.

        Raises
        ------
        FileFormatError
            If the file cannot be read, is damaged or not exact.

        """
        found: SurfelMap = _files().load_surfel_map(Path(path))
        return found

    def save(self, path: str | Path) -> str:
        """
        Write the map to a file, atomically; return its digest.

        Parameters
        ----------
        path : str or Path
            The suffix decides: .npz and .parquet are exact, .ply and .pcd hold the surfels.

        Raises
        ------
        FileFormatError
            If the suffix is another, or the file cannot be written.

        """
        return str(_files().save_surfel_map(Path(path), self))

    def __repr__(self) -> str:
        """Return size and counts of the map."""
        level = f', level {self.level}' if self.level else ''
        return (
            f'SurfelMap({self.voxel_size_m:g} m{level}: {self.num_points} points in '
            f'{self.num_voxels} voxels)'
        )

    def __reduce__(self) -> Any:
        """Pickle the exact state; ``copy`` and ``deepcopy`` use it too."""
        settings = {'columns': self.columns, 'level': self.level, 'threads': self._threads}
        return _rebuilt, (self.voxel_size_m, settings, self.origin_m, self.moments())

    def merge(self, other: SurfelMap) -> None:
        """
        Add all points of another map of equal voxel size: the exact union.

        Raises
        ------
        MapError
            If the voxel sizes differ, the origins are not a whole number of voxels apart, or a
            voxel would hold too many points; see ``insert``.

        """
        self.insert(self._moments_here(other))

    def subtract(self, other: SurfelMap) -> None:
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

    def _moments_here(self, other: SurfelMap) -> ScanMoments:
        """Return the moments of another map in the voxels of this one."""
        if not isinstance(other, SurfelMap):
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

    def at_origin(self, origin_m: npt.ArrayLike) -> SurfelMap:
        """
        Return the same points in a map of another origin, (3,) m in the outer frame.

        Raises
        ------
        MapError
            If the origins are not a whole number of voxels apart, or a voxel would be beyond the
            range of the indices.

        """
        other = SurfelMap(
            self.voxel_size_m, columns=self.columns, level=self.level, origin_m=origin_m
        )
        other.merge(self)
        return other

    def __eq__(self, other: object) -> bool:
        """Return whether two maps are equal, to the bit, and have one origin."""
        if not isinstance(other, SurfelMap):
            return NotImplemented
        if not np.array_equal(self.origin_m, other.origin_m):
            return False
        return self.num_voxels == other.num_voxels and self.digest() == other.digest()

    __hash__ = None  # type: ignore[assignment]  # a map is mutable

    def coarsen(self, level: int, within: Box | None = None) -> SurfelMap:
        """
        Return the map with voxels 2^level times larger, computed from the moments of this map.

        The lattice unit remains that of the finer map, so count, sum and second moment are
        exactly those of the quantised points in the larger voxels. View sums, which refer to
        the centres of the finer voxels, are added unchanged.

        Parameters
        ----------
        level : int
            1 doubles the edge of a voxel; 0 copies the map. The level of the result, that of
            this map and ``level`` together, is at most 20.
        within : two (3,) int, optional
            Lowest and highest voxel index to include; by default all voxels.

        Raises
        ------
        ValueError
            If the level is negative, or that of the result would be beyond 20.
        MapLimitError
            If a voxel would hold more than 2^31 / 4^level points.

        """
        highest = layout.INDEX_BITS - 1 - self.level
        if not 0 <= level <= highest:
            raise ValueError(
                f'level: {level}, expected 0 to {highest} for a map of level {self.level}'
            )
        coarse = SurfelMap(
            self.voxel_size_m * 2**level,
            columns=self.columns,
            level=self.level + level,
            origin_m=self.origin_m,
        )
        if within:
            fine = self._moments_of(self._table.find(self._table.keys_in_box(*within)))
        else:
            fine = self._moments_of(self._table.changed_after(-1, 1))
        coarse.insert(coarse_moments(fine, level))
        return coarse

    def copy(self) -> SurfelMap:
        """Return an independent copy."""
        other = SurfelMap(
            self.voxel_size_m, columns=self.columns, level=self.level, origin_m=self.origin_m
        )
        other.insert(self.moments())
        return other

    def surfels(self, min_points: int = 1, at_most: int | None = None) -> Surfels:
        """
        Return the surfels of all voxels of at least min_points points, in unspecified order.

        Parameters
        ----------
        min_points : int
            Voxels with fewer points are skipped.
        at_most : int, optional
            Maximum number of surfels; a larger map is subsampled evenly in space, by a hash of
            the voxel, so that the selection changes little while the map grows.

        """
        if at_most is None:
            return self._derive(self._table.changed_after(-1, min_points))
        return self._derive(self._table.thinned(min_points, at_most))

    def num_surfels(self, min_points: int = 1) -> int:
        """Return the number of voxels of at least min_points points."""
        return len(self._table.changed_after(-1, min_points))

    def keys(self, min_points: int = 1) -> npt.NDArray[np.int64]:
        """Return the keys (K,) of the voxels of at least min_points points, in any order."""
        rows = self._table.changed_after(-1, min_points)
        return np.asarray(self._table.rows.array[rows, layout.KEY])

    def find(self, key: npt.NDArray[np.int64]) -> npt.NDArray[np.int32]:
        """Return the row of each voxel key (K,), -1 if not found; valid until the map changes."""
        return self._table.find(key)

    def surfels_of(self, rows: npt.NDArray[np.int32]) -> Surfels:
        """Return the surfels of rows (K,) that ``find`` returned."""
        return self._derive(rows)

    def covariances_of(self, rows: npt.NDArray[np.int32]) -> npt.NDArray[np.float64]:
        """Return the covariances of rows (K,): (K, 6), xx xy xz yy yz zz, m^2."""
        found = np.empty((len(rows), 6))
        bits = layout.BITS + self.level
        derive_covariances(self._table.rows.array, rows, self.voxel_size_m, bits, found)
        return found

    def keys_of(self, rows: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
        """Return the voxel keys of rows (K,), -1 for empty rows."""
        slab = self._table.rows.array
        keys = np.where(slab[rows, layout.COUNT] > 0, slab[rows, layout.KEY], -1)
        return np.asarray(keys, np.int64)

    def rows_changed(self, since: int) -> npt.NDArray[np.int32]:
        """
        Return the rows (K,) that changed after a version, each once, including emptied ones.

        Rows from before the map was cleared (``cleared_at``, a version) are not included.
        """
        changed = self._changes.since(since, self._table.rows.array, 0)
        return self._table.emptied_or_changed_after(since) if changed is None else changed

    def index(self, min_points: int = 1) -> SurfelIndex:
        """Return a snapshot of the surfels of at least min_points points for spatial queries."""
        return SurfelIndex(self.surfels(min_points), self.voxel_size_m, level=self.level)

    def surfels_changed(self, since: int | None = None, min_points: int = 1) -> Surfels:
        """
        Return the surfels of the voxels that changed.

        Parameters
        ----------
        since : int, optional
            A ``version`` of the map; by default the version at the last call without ``since``.
        min_points : int
            Voxels with fewer points are skipped.

        """
        if since is None:
            since, self._reported = self._reported, self.version
        changed = self._changes.since(since, self._table.rows.array, max(min_points, 1))
        if changed is None:
            changed = self._table.changed_after(since, min_points)
        return self._derive(changed)

    def moments(self, voxel_index: npt.NDArray[Any] | None = None) -> ScanMoments:
        """
        Return the exact moments of voxels, sorted by voxel; a copy.

        Parameters
        ----------
        voxel_index : (K, 3) int, optional
            The voxels; those that the map does not contain are skipped. By default all.

        """
        if voxel_index is None:
            chosen = self._table.changed_after(-1, 1)
        else:
            chosen = self._table.find(np.unique(pack_keys(voxel_index)))
            chosen = chosen[chosen >= 0]
        return self._moments_of(chosen[np.argsort(self._table.rows.array[chosen, layout.KEY])])

    def _moments_of(self, chosen: npt.NDArray[Any]) -> ScanMoments:
        """Return the moments of rows, in the given order; a copy."""
        rows = self._table.rows.array[chosen]
        return ScanMoments(
            voxel_size_m=self.voxel_size_m,
            level=self.level,
            key=rows[:, layout.KEY].copy(),
            count=rows[:, layout.COUNT].copy(),
            total=rows[:, layout.SUM : layout.SUM + 3].copy(),
            product=rows[:, layout.PRODUCT : layout.PRODUCT + 6].copy(),
            view=rows[:, layout.VIEW : layout.VIEW + 3].copy(),
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

    def clear(self) -> None:
        """Remove all voxels."""
        self.version += 1
        self._reset()

    def _derive(self, chosen: npt.NDArray[np.int32]) -> Surfels:
        bits = layout.BITS + self.level
        surfels = derive(self._table.rows.array, chosen, self.voxel_size_m, bits, self._threads)
        if not self._channel_names:
            return surfels
        sums = self._table.channels(chosen)
        return replace(surfels, channels=means(sums, surfels.num_points, self._channel_names))

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
        if moments.channel_names != self._channel_names:
            raise MapError(
                f'moments with the channels {moments.channel_names}; '
                f'this map has {self._channel_names}'
            )

    def _check_possible(self, moments: ScanMoments) -> None:
        """Raise MapError if no points of a voxel can have these moments."""
        key, count, total, product, view = moments.arrays
        row = first_impossible(key, count, total, product, view, moments.view_is_sum, self.level)
        if row >= 0:
            raise MapError(
                f'row {row} of the moments: key {moments.key[row]}, {moments.count[row]} points, '
                f'sums {moments.total[row].tolist()}, products {moments.product[row].tolist()}, '
                f'views {moments.view[row].tolist()}; expected those of points in a voxel'
            )

    def _check_counts(self, moments: ScanMoments) -> None:
        """Raise MapLimitError if a voxel would hold more points than the integers allow."""
        limit = layout.MAX_MAP_COUNT >> (2 * self.level)
        if self._table.num_points + moments.num_points <= limit:
            return  # usual: even all points in one voxel would be allowed
        found = self._table.find(moments.key)
        held = np.where(found >= 0, self._table.rows.array[found, layout.COUNT], 0)
        largest = int((held + moments.count).max(initial=0))
        if largest > limit:
            raise MapLimitError(
                f'a voxel would hold {largest} points; at most {limit}: use smaller voxels '
                'or a window'
            )
