# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
SurfelMap: a hashed voxel map of exact, reversible surfels.

Points come in and are reduced to integer moments; surfels with normals go out, derived from the
moments of the voxels asked for. The moments themselves, their exact addition
and removal, and the limits of the map are in moment_map.py.

The work is done in moment_map, reducer, surfels and moments.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper import map_formats
from surfel_mapper.arguments import as_array, as_numbers, as_path, as_whole
from surfel_mapper.errors import MapLimitError
from surfel_mapper.kernels import layout
from surfel_mapper.mapping.adaptive import AdaptiveCut, LEVELS, MAX_THICKNESS_M
from surfel_mapper.mapping.channels import means
from surfel_mapper.mapping.coarsening import coarse_moments
from surfel_mapper.mapping.moment_map import MAX_LEVEL, MomentMap
from surfel_mapper.mapping.moments import (
    looks_like_other_unit,
    OTHER_UNIT,
    ScanMoments,
)
from surfel_mapper.mapping.reducer import Reducer
from surfel_mapper.mapping.surfel_index import SurfelIndex
from surfel_mapper.mapping.surfels import derive, Surfels

Box = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]
"""Lowest and highest voxel index, (3,) each."""


_log = logging.getLogger(__name__)


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


class SurfelMap(MomentMap):
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
    level : int
        The lattice unit is ``voxel_size_m / 2^(16 + level)``; not 0 only in maps that
        ``coarsen`` returned, to which no scan can be added.
    origin_m : (3,) float, m
        Place of the origin of the map in an outer frame, such as UTM, in which files are written.
        Points are given and surfels returned in the frame of the map. The digest does not
        depend on it. ``merge`` and ``subtract`` shift maps of another origin, exactly.

    Raises
    ------
    ValueError
        If the voxel size is not positive and finite, a column cannot be summed, the level is
        negative or beyond 15, or the origin is not finite.

    Examples
    --------
    >>> import numpy as np
    >>> floor = np.random.default_rng(0).uniform([0, 0, 0.2], [2, 2, 0.2], (1000, 3))
    >>> surfel_map = SurfelMap(0.5)
    >>> moments = surfel_map.add(floor, origin=[1, 1, 2])
    >>> surfel_map
    SurfelMap(0.5 m: 1,000 points in 16 voxels)
    >>> bool(np.allclose(surfel_map.surfels(min_points=5).normal, [0, 0, 1]))
    True
    >>> _ = surfel_map.remove(moments)  # the exact inverse
    >>> surfel_map
    SurfelMap(0.5 m: 0 points in 0 voxels)

    """

    def __init__(
        self,
        voxel_size_m: float = 0.5,
        *,
        columns: tuple[str, ...] = (),
        level: int = 0,
        origin_m: npt.ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        if isinstance(voxel_size_m, bool) or not isinstance(voxel_size_m, (int, float, np.number)):
            raise TypeError(
                f'voxel_size_m: {voxel_size_m!r}, expected a number of metres; settings belong '
                'to Mapper'
            )
        if not 0.0 < as_numbers('voxel_size_m', voxel_size_m) < math.inf:
            raise ValueError(f'voxel_size_m: {voxel_size_m}, expected positive and finite')
        super().__init__(float(voxel_size_m), columns, level, origin_m)
        self._reported = self.version
        self._warned_of_units = False
        self._reducer = Reducer(self.voxel_size_m, columns)

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
            T_map_sensor = as_numbers('T_map_sensor', T_map_sensor)
            if origin is None and T_map_sensor.shape == (4, 4):
                origin = T_map_sensor[:3, 3]
        moments = self.reduce(points, T_map_sensor, origin=origin, columns=columns)
        if not self._warned_of_units and looks_like_other_unit(moments):
            self._warned_of_units = True
            _log.warning(OTHER_UNIT)
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

        Does not access the voxels of the map.

        A point is quantised once, X = floor((((R0 x + R1 y) + R2 z) + t) 65536 / voxel size)
        in float64. The voxel index is X >> 16 and the place in the voxel (X & 65535) - 32768.

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

    def surfels(
        self, min_points: int = 1, at_most: int | None = None, *, covariance: bool = False
    ) -> Surfels:
        """
        Return the surfels of all voxels of at least min_points points, in unspecified order.

        Parameters
        ----------
        min_points : int
            Voxels with fewer points are skipped.
        at_most : int, optional
            Maximum number of surfels. A larger map is subsampled evenly in space, by a hash of
            the voxel: the selection changes little while the map grows.
        covariance : bool
            With the covariances of the points.

        Raises
        ------
        TypeError
            If a number is not whole.
        ValueError
            If at_most is negative.

        """
        min_points = as_whole('min_points', min_points)
        if at_most is None:
            return self._derive(self._table.occupied(min_points), covariance)
        if as_whole('at_most', at_most) < 0:
            raise ValueError(f'at_most: {at_most}, expected 0 or more')
        return self._derive(self._table.thinned(min_points, at_most), covariance)

    def num_surfels(self, min_points: int = 1) -> int:
        """Return the number of voxels of at least min_points points."""
        return len(self._table.occupied(as_whole('min_points', min_points)))

    def surfels_of(self, rows: npt.NDArray[np.int32], *, covariance: bool = False) -> Surfels:
        """Return the surfels of rows (K,) that ``find`` returned; IndexError for others."""
        return self._derive(self._table.checked(rows), covariance)

    def surfels_changed(
        self, since: int | None = None, min_points: int = 1, *, covariance: bool = False
    ) -> Surfels:
        """
        Return the surfels of the voxels that changed.

        Parameters
        ----------
        since : int, optional
            A ``version`` of the map; by default the version at the last call without ``since``.
        min_points : int
            Voxels with fewer points are skipped.
        covariance : bool
            With the covariances of the points.

        """
        if type(min_points) is not int:
            min_points = as_whole('min_points', min_points)
        if since is None:
            since, self._reported = max(self._reported, self.cleared_at), self.version
        elif type(since) is not int:
            since = as_whole('since', since)
        least = max(min_points, 1)
        changed = self._changes.since(since, self._table, least)
        if changed is None:
            changed = self._table.changed_after(since, least)
        return self._derive(changed, covariance)

    def adaptive(
        self, min_points: int = 1, *, covariance: bool = False, **settings: Any
    ) -> Surfels:
        """
        Return surfels of the size that fits: of the largest cell whose points lie on one plane.

        Every point is in one surfel: of a cell, or of its voxel. ``size`` tells which, and
        ``voxel_index`` is floor(point / size).

        Parameters
        ----------
        min_points : int
            Cells and voxels with fewer points are skipped.
        covariance : bool
            With the covariances of the points.
        **settings
            Those of ``adaptive_cut``.

        """
        cut = self.adaptive_cut(min_points, **settings)
        return cut.refresh(covariance=covariance).surfels

    def adaptive_cut(
        self,
        min_points: int = 1,
        *,
        levels: int = LEVELS,
        max_thickness_m: float = MAX_THICKNESS_M,
    ) -> AdaptiveCut:
        """
        Return the adaptive surfels as an object that follows this map and has a digest.

        Parameters
        ----------
        min_points : int
            Cells and voxels with fewer points are skipped.
        levels : int
            The largest cells have 2^levels voxels an axis; 1 to 6.
        max_thickness_m : float
            Maximum ``thickness`` of a cell, m.

        Raises
        ------
        TypeError, ValueError
            If a setting is of another type or out of range.

        """
        return AdaptiveCut(
            self, min_points=min_points, levels=levels, max_thickness_m=max_thickness_m
        )

    def index(self, min_points: int = 1) -> SurfelIndex:
        """Return a snapshot of the surfels of at least min_points points for spatial queries."""
        return SurfelIndex(self.surfels(min_points), self.voxel_size_m, level=self.level)

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
            this map and ``level`` together, is at most 15: a voxel holds 2 points then.
        within : two (3,) int, optional
            Lowest and highest voxel index to include; by default all voxels.

        Raises
        ------
        ValueError
            If the level is negative, or that of the result would be beyond 15, or ``within`` is
            not two voxels.
        MapLimitError
            If a voxel would hold more than 2^31 / 4^level points.

        """
        highest = MAX_LEVEL - self.level
        if not 0 <= as_whole('level', level) <= highest:
            raise ValueError(
                f'level: {level}, expected 0 to {highest} for a map of level {self.level}'
            )
        coarse = SurfelMap(
            self.voxel_size_m * 2**level,
            columns=self.columns,
            level=self.level + level,
            origin_m=self.origin_m,
        )
        if within is not None:
            box = as_array('within', within)
            if box.shape != (2, 3) or box.dtype.kind != 'i':
                raise ValueError(f'within: {within!r:.60}, expected two voxel indices, i j k')
            fine = self._moments_of(self._table.find(self._table.keys_in_box(*within)))
        else:
            fine = self._moments_of(self._table.occupied())
        coarse.insert(coarse_moments(fine, level))
        return coarse

    def at_origin(self, origin_m: npt.ArrayLike) -> SurfelMap:
        """
        Return the same points in a map of another origin, (3,) m in the outer frame.

        Raises
        ------
        MapError
            If the origins are not a whole number of voxels apart, or a voxel would be beyond the
            range of the indices.

        """
        shifted = self.emptied()
        shifted.origin_m = origin_m
        shifted.merge(self)
        return shifted

    def emptied(self) -> SurfelMap:
        """Return an empty map of the same voxels, columns and origin."""
        return SurfelMap(
            self.voxel_size_m, columns=self.columns, level=self.level, origin_m=self.origin_m
        )

    def copy(self) -> SurfelMap:
        """Return an independent copy."""
        copied = self.emptied()
        copied.insert(self.moments())
        return copied

    @classmethod
    def load(cls, path: str | Path) -> SurfelMap:
        """
        Return the map in a file, exactly as it was saved; without the scans of its window.

        Parameters
        ----------
        path : str or Path
            An .npz or .parquet file, or the output directory of a replay or a merge. Of the
            exact maps in it, also one in tiles, the one that was written last is read.

        Raises
        ------
        FileFormatError
            If the file cannot be read, is damaged or not exact.

        """
        surfel_map: SurfelMap = map_formats.registered('files').load_surfel_map(as_path(path))
        return surfel_map

    def save(self, path: str | Path) -> str:
        """
        Write the map to a file, atomically; return its digest.

        Parameters
        ----------
        path : str or Path
            The suffix decides: .npz and .parquet are exact, .ply, .pcd, .las and .laz hold the
            surfels.

        Raises
        ------
        FileFormatError
            If the suffix is another, or the file cannot be written.

        """
        digest: str = map_formats.registered('files').save_surfel_map(as_path(path), self)
        return digest

    def __reduce__(self) -> Any:
        """Pickle the exact state; ``copy`` and ``deepcopy`` use it too."""
        settings = {'columns': self.columns, 'level': self.level}
        return _rebuilt, (self.voxel_size_m, settings, self.origin_m, self.moments())

    def _derive(self, chosen: npt.NDArray[np.int32], covariance: bool = False) -> Surfels:
        bits = layout.BITS + self.level
        slabs = self._table.rows.array, self._table.stamps.array
        surfels = derive(slabs, chosen, self.voxel_size_m, bits, covariance)
        if not self._channel_names:
            return surfels
        sums = self._table.channels(chosen)
        return replace(surfels, channels=means(sums, surfels.num_points, self._channel_names))
