# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filter, the base class of all filters, and the functions that make one scan of another.

A filter is a frozen dataclass whose fields are its parameters. It takes a scan and returns a
scan; the given scan is never changed. Most filters only select points (``keep``); those that make
or move points or add columns implement ``apply``.

A comparison with nan is false, and a point stays only if a comparison holds: a filter that
compares a coordinate drops the points for which it cannot decide.

Random numbers depend on the seed and the stamp of the scan alone, not on earlier scans, so that
node and replay keep the same points and any part of a bag is filtered as the whole is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
import functools
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_array, as_numbers
from surfel_mapper.config import setting, Settings
from surfel_mapper.errors import FilterError
from surfel_mapper.filters.columns import LazyColumns
from surfel_mapper.scan import Scan

Mask = npt.NDArray[np.bool_]

Array = npt.NDArray[Any]


parameter = setting
"""The name of ``setting`` in filters: libpointmatcher and the docs call these parameters."""


def taking_points(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method of a filter that also takes an array of points; see as_scan."""

    @functools.wraps(method)
    def wrapped(self: Any, scan: Scan | Array) -> Any:
        return method(self, as_scan(scan))

    return wrapped


def as_scan(points: Scan | npt.ArrayLike) -> Scan:
    """
    Return a scan of points; a scan itself is returned unchanged.

    Parameters
    ----------
    points : Scan or (N, 3) array_like, m
        float32 and float64 stay, other types become float64. Stamp 0, no columns, no poses.

    Raises
    ------
    ValueError
        If the shape is not (N, 3).

    """
    if isinstance(points, Scan):
        return points
    array = as_array('points', points)
    if array.dtype not in (np.float32, np.float64):
        array = as_numbers('points', array)
    return Scan(points=array.reshape(-1, 3) if array.size == 0 else array, stamp_ns=0, frame_id='')


@dataclass(frozen=True, slots=True, kw_only=True)
class Filter(Settings):
    """
    Base of all filters: checks every parameter against its declaration.

    A filter implements ``keep`` or ``apply``: ``register`` refuses one that does neither, and
    sets ``name`` and ``libpointmatcher``.
    """

    TAKES_TEXT: ClassVar[bool] = True

    name: ClassVar[str] = ''
    """Name in a chain."""

    libpointmatcher: ClassVar[str] = ''
    """Name in libpointmatcher; empty if it has no such filter."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Let ``keep`` and ``apply`` of a filter take an array of points in place of a scan."""
        super(Filter, cls).__init_subclass__(**kwargs)
        for method in ('keep', 'apply'):
            own = cls.__dict__.get(method)
            if own is not None and not hasattr(own, '__wrapped__'):
                setattr(cls, method, taking_points(own))

    def __post_init__(self) -> None:
        """Check every parameter, then conditions on several."""
        Settings.__post_init__(self)
        self.check()

    @classmethod
    def where(cls, key: str) -> str:
        """Return the name of a parameter with that of the filter."""
        return f'{cls.name or cls.__name__}: {key}'

    def check(self) -> None:
        """Check conditions on several parameters; raise ConfigError."""

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay, (N,) bool; not called for filters that have ``apply``."""
        # not abstract, because filters with apply have no keep; register refuses one with neither
        raise NotImplementedError(f'{type(self).__name__}: implement keep or apply')

    def apply(self, scan: Scan) -> Scan:
        """
        Return the scan filtered.

        Raises
        ------
        FilterError
            If the scan lacks a column that the filter needs, or its values are refused.

        """
        scan = as_scan(scan)
        return select(scan, self.keep(scan))

    def column(self, scan: Scan, name: str) -> Array:
        """
        Return a column that the filter needs.

        Raises
        ------
        FilterError
            If the scan has no column of this name.

        """
        if name in scan.columns:
            return scan.columns[name]
        have = ', '.join(scan.columns) or 'none'
        raise FilterError(f'needs the column {name!r}; the points have {have}')


@dataclass(frozen=True, slots=True, kw_only=True)
class FiniteFilter(Filter):
    """
    Base of the filters that group points or search neighbours.

    Points with a coordinate that is nan or infinite belong to no group and have no neighbours, so
    they are dropped first. A filter implements ``keep`` or ``apply_finite``.
    """

    def apply(self, scan: Scan) -> Scan:
        """Return the scan filtered, without points that are not finite."""
        return self.apply_finite(finite(scan))

    def apply_finite(self, scan: Scan) -> Scan:
        """Return the scan filtered; all its points are finite."""
        return select(scan, self.keep(scan))


def finite(scan: Scan) -> Scan:
    """Return the scan without the points that have a nan or infinite coordinate."""
    with np.errstate(all='ignore'):
        total = scan.points.sum()  # finite only if all are, for the price of one fast pass
    if np.isfinite(total):
        return scan
    return select(scan, np.isfinite(scan.points).all(axis=1))


def select(scan: Scan, rows: Array) -> Scan:
    """
    Return the scan with some of its points, their columns with them.

    Parameters
    ----------
    scan : Scan
        Returned itself if all points stay.
    rows : (N,) bool or (K,) int
        A mask over the points, or indices of points in the order wanted.

    """
    if rows.dtype == np.bool_:
        if rows.shape != (len(scan),):
            raise FilterError(f'mask of shape {rows.shape}, expected ({len(scan)},)')
        if rows.all():
            return scan
        rows = np.flatnonzero(rows)
    points = scan.points.T.take(rows, axis=1).T
    columns = LazyColumns(scan.columns, rows, len(points)) if scan.columns else {}
    times = scan.times and replace(scan.times, offsets=scan.times.offsets[rows])
    return replace(scan, points=points, columns=columns, times=times, msg=None)


def with_points(scan: Scan, points: Array, columns: Mapping[str, Array]) -> Scan:
    """Return the scan with its points replaced by others made from them, and their columns."""
    points = points.astype(scan.points.dtype, order='F', copy=False)
    return replace(scan, points=points, columns=columns, times=None, msg=None)


def with_columns(scan: Scan, **columns: Array) -> Scan:
    """
    Return the scan with columns added or replaced.

    Raises
    ------
    FilterError
        If a column does not have one row for each point.

    """
    for name, column in columns.items():
        if len(column) != len(scan):
            raise FilterError(f'column {name!r}: {len(column)} rows for {len(scan)} points')
    return replace(scan, columns=LazyColumns(scan.columns, None, len(scan), columns))


def generator(scan: Scan, seed: int) -> np.random.Generator:
    """Return random numbers that depend on the seed and the stamp of the scan alone."""
    return np.random.default_rng([seed % 2**64, scan.stamp_ns % 2**64])
