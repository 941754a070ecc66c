# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Columns: their names, how they are picked from rows, and how those of several points become one.

A descriptor of libpointmatcher is a column of the same name, so chains that name one run as they
are. A descriptor of one row is a column (N,), one of C rows a column (N, C). libpointmatcher's
times are ordinary columns here. Clouds often carry the normal as three fields; ``with_normals``
turns these into ``normals``.

Columns are picked lazily. A cloud carries intensity, ring and time, mostly unused: only the
coordinates are mapped. Picking one column from the bytes of the message costs as much as
filtering the coordinates (0.3 ms for 131,072 points), and that at every filter of a chain.

If points are merged, the kind of a column decides how it is averaged:

- directions (normals): mean, then scaled to unit length; if opposite ones cancel, the first;
- labels, identities, eigenvectors: the first, because a mean of them is none of them;
- colours packed into one number: the mean of each channel;
- integers of 64 bits, which are times: the mean towards zero, exact and without overflow;
- other integers: the mean, rounded; booleans: true if at least half are;
- all others: the mean, in float64.

Sums run over the points in their order.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
import enum
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.scan import Scan

Array = npt.NDArray[Any]

NORMALS = 'normals'
"""(N, 3) unit normals."""
OBSERVATION_DIRECTIONS = 'observationDirections'
"""(N, 3) from the point to the sensor, m, not unit length."""
DENSITIES = 'densities'
"""(N,) points per m^3 about the point."""
EIGEN_VALUES = 'eigValues'
"""(N, 3) of the covariance about the point, m^2, ascending."""
EIGEN_VECTORS = 'eigVectors'
"""(N, 9) unit eigenvectors of eigValues, one after another."""
INCIDENCE_ANGLES = 'incidenceAngles'
"""(N,) angle between normal and direction to the sensor, rad."""
MATCHED_IDS = 'matchedIds'
"""(N, K) indices of neighbours."""
MEAN_DISTS = 'meanDists'
"""(N,) mean distance to the neighbours, m."""
SENSOR_NOISE = 'simpleSensorNoise'
"""(N,) noise radius of the sensor, m."""


class Kind(enum.Enum):
    """The kind of a column, which decides how it is merged."""

    NUMBER = 'number'
    DIRECTION = 'direction'
    FIRST = 'first'
    COLOUR = 'colour'
    TIME = 'time'


KINDS = {
    NORMALS: Kind.DIRECTION,
    EIGEN_VECTORS: Kind.FIRST,
    MATCHED_IDS: Kind.FIRST,
    **dict.fromkeys(('rgb', 'rgba'), Kind.COLOUR),
    **dict.fromkeys(('label', 'labels', 'class', 'instance', 'object', 'id', 'tag'), Kind.FIRST),
    **dict.fromkeys(('ring', 'line', 'channel', 'laser_id', 'return_type'), Kind.FIRST),
}
"""Kind of columns by name; that of all others follows from their type."""

NORMAL_FIELDS = ('normal_x', 'normal_y', 'normal_z')
"""Fields of the normal in a PointCloud2."""


def kind_of(name: str, column: npt.NDArray[Any]) -> Kind:
    """Return the kind of a column."""
    if name in KINDS:
        return KINDS[name]
    if column.dtype.kind in 'fiub':
        return Kind.TIME if column.dtype in (np.int64, np.uint64) else Kind.NUMBER
    return Kind.FIRST


def with_normals(scan: Scan) -> Scan:
    """Return the scan with the column ``normals`` if it has the normal as three fields only."""
    if NORMALS in scan.columns or any(name not in scan.columns for name in NORMAL_FIELDS):
        return scan
    normals = np.column_stack([scan.columns[name] for name in NORMAL_FIELDS])
    others = {k: v for k, v in scan.columns.items() if k not in NORMAL_FIELDS}
    return replace(scan, columns={**others, NORMALS: normals})


class LazyColumns(Mapping[str, Array]):
    """
    Some rows of other columns, taken when first read, and further columns.

    Parameters
    ----------
    base : mapping of str to array
        Columns to take rows from; must not change while this is in use.
    rows : (K,) int, optional
        Rows to take; None: all.
    num_rows : int
        Number of rows.
    own : mapping of str to (K, ...) array
        Further columns; they replace those of the same name.

    """

    __slots__ = ('_base', '_own', '_rows', 'num_rows')

    def __init__(
        self,
        base: Mapping[str, Array],
        rows: npt.NDArray[np.int64] | None,
        num_rows: int,
        own: Mapping[str, Array] | None = None,
    ) -> None:
        self._base = base
        self._rows = rows
        self._own = dict(own or {})
        self.num_rows = num_rows

    def __getitem__(self, name: str) -> Array:
        """Return a column, the same array every time."""
        if name not in self._own:
            column, rows = self._origin(name)
            self._own[name] = column if rows is None else np.take(column, rows, axis=0)
        return self._own[name]

    def __contains__(self, name: object) -> bool:
        """Return whether the column exists, without taking it."""
        return name in self._own or name in self._base

    def __iter__(self) -> Iterator[str]:
        """Yield the names: those of the base, then the further ones."""
        yield from self._base
        yield from (name for name in self._own if name not in self._base)

    def __len__(self) -> int:
        """Return the number of columns."""
        return sum(1 for _ in self)

    def _origin(self, name: str) -> tuple[Array, npt.NDArray[np.int64] | None]:
        """Return the array that holds a column, and its rows in it; None: all rows."""
        if name in self._own:
            return self._own[name], None
        if not isinstance(self._base, LazyColumns):
            return self._base[name], self._rows
        column, rows = self._base._origin(name)
        if self._rows is None or rows is None:
            return column, rows if self._rows is None else self._rows
        return column, rows[self._rows]


@dataclass(frozen=True, slots=True, eq=False)
class PointGroups:
    """
    Sets of points that are merged into one point each.

    Attributes
    ----------
    rows : (N,) int
        Group of every point, 0 to K - 1; no group is empty.
    first : (K,) int
        First point of every group.
    count : (K,) int
        Number of points in every group.

    """

    rows: npt.NDArray[Any]
    first: npt.NDArray[Any]
    count: npt.NDArray[Any]

    @classmethod
    def of(cls, rows: npt.NDArray[Any], number: int) -> PointGroups:
        """Return the groups from the group of every point and the number of groups."""
        first = np.full(number, len(rows), np.int64)
        np.minimum.at(first, rows, np.arange(len(rows)))
        return cls(rows, first, np.bincount(rows, minlength=number))


class MergedColumns(Mapping[str, Array]):
    """
    The columns of merged points, (K,) or (K, C) each.

    Each is computed when first read: most never are.

    Parameters
    ----------
    columns : mapping of str to (N, ...) array
        Columns of the points before merging.
    groups : PointGroups
        The points that are merged.
    average : bool
        Whether to average columns by their kind; false keeps those of the first point.
    unit : bool
        Whether mean directions are scaled to unit length.

    """

    __slots__ = ('_average', '_columns', '_groups', '_made', '_unit', 'num_rows')

    def __init__(
        self,
        columns: Mapping[str, Array],
        groups: PointGroups,
        *,
        average: bool = True,
        unit: bool = True,
    ) -> None:
        self._columns = columns
        self._groups = groups
        self._average = average
        self._unit = unit
        self._made: dict[str, Array] = {}
        self.num_rows = len(groups.first)

    def __getitem__(self, name: str) -> Array:
        """Return a column, the same array every time."""
        if name not in self._made:
            column = self._columns[name]
            self._made[name] = merged(self._kind(name, column), column, self._groups)
        return self._made[name]

    def __contains__(self, name: object) -> bool:
        """Return whether the column exists, without computing it."""
        return name in self._columns

    def __iter__(self) -> Iterator[str]:
        """Yield the names."""
        return iter(self._columns)

    def __len__(self) -> int:
        """Return the number of columns."""
        return len(self._columns)

    def _kind(self, name: str, column: Array) -> Kind:
        """Return the kind by which a column is merged."""
        kind = kind_of(name, column) if self._average else Kind.FIRST
        return Kind.NUMBER if kind is Kind.DIRECTION and not self._unit else kind


def merged(kind: Kind, column: Array, groups: PointGroups) -> Array:
    """Return one column merged by its kind, in its own dtype."""
    if kind is Kind.FIRST:
        return np.asarray(column[groups.first])
    if kind is Kind.TIME:
        return by_component(mean_time, column, groups)
    if kind is Kind.COLOUR:
        return mean_colour(column, groups)
    means = by_component(mean, column, groups)
    if kind is Kind.DIRECTION:
        lengths = np.sqrt((means * means).sum(axis=1, keepdims=True))
        defined = lengths > 1e-6  # the rounding of opposite float32 directions is smaller
        units = np.divide(means, lengths, out=means, where=defined)
        return np.asarray(np.where(defined, units, column[groups.first]), column.dtype)
    if column.dtype.kind in 'iu':
        means = np.rint(means)
    if column.dtype.kind == 'b':
        return np.asarray(means >= 0.5)
    return np.asarray(means.astype(column.dtype))


def by_component(average: Any, column: Array, groups: PointGroups) -> Array:
    """Return the averages of a column, component by component."""
    if column.ndim == 1:
        return np.asarray(average(column, groups))
    parts = column.reshape(len(column), math.prod(column.shape[1:]))
    means = [average(parts[:, i], groups) for i in range(parts.shape[1])]
    shape = (len(groups.first), *column.shape[1:])
    return np.stack(means, axis=1).reshape(shape) if means else np.empty(shape, column.dtype)


def mean(values: Array, groups: PointGroups) -> npt.NDArray[np.float64]:
    """Return the means of values (N,), in float64."""
    total = np.bincount(groups.rows, weights=values, minlength=len(groups.first))
    return np.asarray(total / groups.count)


def mean_time(values: Array, groups: PointGroups) -> Array:
    """
    Return the means of 64-bit integers, rounded towards zero as in libpointmatcher.

    Their sum does not fit in 64 bits: seven stamps in ns since 1970 overflow. The upper and lower
    halves are summed separately, which is exact for up to 2^30 points.
    """
    upper, lower = np.zeros((2, len(groups.first)), values.dtype)
    np.add.at(upper, groups.rows, values >> 32)
    np.add.at(lower, groups.rows, values & 0xFFFFFFFF)
    count = groups.count.astype(values.dtype)
    whole, rest = np.divmod(upper, count)
    down, left = np.divmod((rest << 32) + lower, count)
    means = (whole << 32) + down
    return np.where((means < 0) & (left > 0), means + 1, means).astype(values.dtype)


def mean_colour(column: Array, groups: PointGroups) -> Array:
    """Return the mean colours of 32-bit values with one channel per byte."""
    if column.dtype.itemsize != 4 or column.ndim != 1:
        return by_component(mean, column, groups).astype(column.dtype)
    channels = np.ascontiguousarray(column).view(np.uint8).reshape(-1, 4)
    means = np.stack([mean(channels[:, i], groups) for i in range(4)], axis=1)
    return np.rint(means).astype(np.uint8).view(column.dtype).reshape(-1)


def as_fields(
    scan: Scan, *, is_flat: bool = False, has_int64: bool = False
) -> dict[str, npt.NDArray[Any]]:
    """
    Return the coordinates and columns of a scan as the fields of a cloud or a file.

    Parameters
    ----------
    scan : Scan
        Any scan.
    is_flat : bool
        Whether the target has no fields of several components: a column (N, C) becomes C fields,
        ``name_0`` to ``name_C-1``. ``normals`` always become normal_x, normal_y, normal_z, and
        ``rgb`` of three components red, green, blue.
    has_int64 : bool
        Whether the target has integers of 64 bits; if not, they become float64, exact up to 2^53
        and rounded to 256 for ns since 1970.

    Returns
    -------
    dict of str to (N,) or (N, C) array
        x, y, z first. Booleans become uint8, and a name that is taken already is left out.

    """
    fields = {name: np.asarray(scan.points[:, axis]) for axis, name in enumerate('xyz')}
    for name in scan.columns:
        column = scan.columns[name].reshape(len(scan), math.prod(scan.columns[name].shape[1:]))
        if column.dtype.kind == 'b':
            column = column.astype(np.uint8)
        if column.dtype in (np.int64, np.uint64) and not has_int64:
            column = column.astype(np.float64)
        if column.dtype.kind not in 'fiu':
            continue
        names = component_names(name, column.shape[1])
        if scan.columns[name].ndim == 1:
            fields.setdefault(name, column[:, 0])
        elif is_flat or names != [f'{name}_{i}' for i in range(column.shape[1])]:
            for i, each in enumerate(names):
                fields.setdefault(each, column[:, i])
        elif column.shape[1]:
            fields.setdefault(name, column)
    return fields


def component_names(name: str, number: int) -> list[str]:
    """Return the names of the components of a column as single fields."""
    if name == NORMALS and number == 3:
        return list(NORMAL_FIELDS)
    if name == 'rgb' and number == 3:
        return ['red', 'green', 'blue']
    return [f'{name}_{i}' for i in range(number)]
